"""A scene as the lines of Python that make it."""

from __future__ import annotations

import dataclasses
import textwrap
from typing import Any

import equinox as eqx
import numpy as np

from .. import model
from ..model import ConstantVoltage, Membrane, Scene, VHBBreakdown, Window

__all__ = ["code_of"]

_DIGITS = 12  # more would show how a slider's value was rounded


def code_of(scene: Scene, *, diagram: bool = True) -> str:
    """The lines that make `scene`, and its diagram, with numbers of 12 digits, in SI if the scene carries units.

    Raises ValueError for a material or a breakdown law that is not of this package, or is made of functions.

    >>> from dielectric_jax import Chamber
    >>> print(code_of(Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))))
    import jax
    <BLANKLINE>
    jax.config.update("jax_enable_x64", True)
    <BLANKLINE>
    import dielectric_jax as dj
    from dielectric_jax.model import Chamber, Gent, Membrane, Scene, VHBBreakdown
    <BLANKLINE>
    membrane = Membrane(material=Gent(), breakdown=VHBBreakdown())
    loading = Chamber(volume=1600.0, initial_volume=2.42)
    scene = Scene(membrane, loading)
    diagram = dj.voltage_volume(scene)
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    membrane, loading, units = scene.membrane, scene.loading, scene.units
    used: set[str] = {"Scene"}
    window = "" if eqx.tree_equal(scene.window, Window()) else f", window={_text(scene.window, used)}"
    if units is None:
        last = f"scene = Scene(membrane, loading{window})"
        made = [("membrane", membrane), ("loading", loading)]
    else:
        # Scene.from_si gives the law of VHB the modulus and the permittivity of the units
        law = membrane.breakdown
        law = VHBBreakdown(law.scale) if isinstance(law, VHBBreakdown) else units.to_si(law)
        film = Membrane(membrane.material, membrane.prestretch, law)
        last = f"scene = Scene.from_si(membrane, loading, units{window})"
        made = [("membrane", film), ("loading", units.to_si(loading)), ("units", units)]
    lines = [f"{name} = {_text(value, used)}" for name, value in made] + [last]
    if diagram and isinstance(loading, ConstantVoltage):
        lines.append("diagram = dj.pressure_volume(scene.membrane, voltage=float(scene.loading.voltage))")
    elif diagram:
        lines.append("diagram = dj.voltage_volume(scene)")
    head = f"""\
        import jax

        jax.config.update("jax_enable_x64", True)

        import dielectric_jax as dj
        from dielectric_jax.model import {", ".join(sorted(used))}
        """
    return "\n".join([textwrap.dedent(head), *lines])


def _text(value: Any, used: set[str]) -> str:
    """A value as Python writes it; the names of its classes are added to `used`."""
    if isinstance(value, tuple):
        return f"({', '.join(_text(v, used) for v in value)}{',' if len(value) == 1 else ''})"
    if not isinstance(value, eqx.Module):
        return _number(value)
    kind = type(value)
    if getattr(model, kind.__name__, None) is not kind:
        raise ValueError(f"`scene` must be made of the package's own classes, but has a {kind.__name__}.")
    used.add(kind.__name__)
    given = {f.name: getattr(value, f.name) for f in dataclasses.fields(kind) if not _is_default(f, value)}
    return f"{kind.__name__}({', '.join(f'{name}={_text(own, used)}' for name, own in given.items())})"


def _number(value: Any) -> str:
    if callable(value) or np.ndim(value):
        raise ValueError("`scene` must be made of numbers, but has a function or an array.")
    return repr(float(f"{float(value):.{_DIGITS}g}"))


def _is_default(field: Any, module: Any) -> bool:
    """Whether a field is left out: it is None, or a number that its class has anyway."""
    value = getattr(module, field.name)
    if isinstance(value, (eqx.Module, tuple)) or callable(value):
        return False
    return value is None or (field.default is not dataclasses.MISSING and float(value) == field.default)
