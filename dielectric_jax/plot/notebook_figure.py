"""The class of figures that notebooks show once; apart from the other modules because it needs matplotlib when it is defined."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

__all__ = ["NotebookFigure"]


class NotebookFigure(Figure):
    """A figure of pyplot that a notebook shows once, also as the value of a cell.

    Matplotlib's inline backend shows every open figure at the end of a cell, in addition to the value of the cell. A figure that is
    shown as a value is closed here, so that it is not shown again. Scripts are unaffected: `plt.show()` shows it.
    """

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        """No representation of its own: IPython goes on to the picture, in the formats that the user has chosen."""
        import matplotlib
        import matplotlib.pyplot as plt

        if "inline" in matplotlib.get_backend():
            plt.close(self)
        return {}
