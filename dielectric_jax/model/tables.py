"""Records as small HTML tables, for notebooks."""

import html
import math
from collections.abc import Sequence
from typing import Any

__all__ = ["html_table"]


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    return html.escape(f"{value:.6g}" if isinstance(value, float) else str(value))


def html_table(heads: Sequence[str], rows: Sequence[Sequence[Any]], caption: str = "") -> str:
    """A table with its heads; numbers with six digits, what is missing as a dash.

    >>> html_table(["kind", "pressure"], [["fold", 1.9086848]])
    '<table><thead><tr><th>kind</th><th>pressure</th></tr></thead><tbody><tr><td>fold</td><td>1.90868</td></tr></tbody></table>'
    """
    head = "".join(f"<th>{_cell(h)}</th>" for h in heads)
    body = "".join("<tr>" + "".join(f"<td>{_cell(v)}</td>" for v in row) + "</tr>" for row in rows)
    title = f"<caption>{_cell(caption)}</caption>" if caption else ""
    return f"<table>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
