"""The one chamber that benchmarks time alone: V_C = 1600 filled to V_0 = 2.42, its engines, and what is known of it."""

from __future__ import annotations  # so that importing this loads no part of the package: `first_diagram.py` times that

import dielectric_jax as dj

#: voltages of the snap and of breakdown, from a spectral-element discretisation of the energy that shares no code
FOLD, BREAKDOWN = 0.0764953595449, 0.100970094106
PARAMETERS = {"chamber_volume": 1600.0, "initial_volume": 2.42, "stretch_limit": 270.0, "prestretch": 1.0}


def scene() -> dj.Scene:
    """The default membrane on the chamber."""
    air = dj.Chamber(volume=1600.0, initial_volume=2.42, atmospheric_pressure=50.0)
    return dj.Scene(membrane=dj.Membrane(material=dj.Gent(270.0)), loading=air)


def engines(surface: dj.Surface) -> dict:
    """Our ways to draw one diagram, as functions without arguments."""
    own = scene()
    return {
        "continuation": lambda: dj.voltage_volume(own),
        "surface, certified": lambda: dj.voltage_volume(own, surface=surface),
        "surface alone": lambda: dj.voltage_volume(own, surface=surface, certify=False, extend=False),
        "glance": lambda: dj.glance(own, surface),
    }


def voltages(found) -> dict:
    """The voltages of the first snap and of breakdown on the way up, of a diagram or a glance."""
    up = [e for e in found.events if e.direction == "up"]
    return {name: next(e.state.voltage for e in up if e.event == name) for name in ("snap", "breakdown")}


def errors(snap: float, breakdown: float) -> dict:
    """How far these voltages are from the known ones."""
    return {"fold_error": abs(snap - FOLD), "breakdown_error": abs(breakdown - BREAKDOWN)}
