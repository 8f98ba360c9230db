"""What happens on a ramp, in a line of HTML below the explorer's picture."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from ..diagram import Diagram, regime_of_diagram
from ..model import Event, PointKind, RampEvent, Regime
from ..plot import viewed, voltage_text

__all__ = ["story"]

_WHOLE = "Press “whole diagram” to follow it by shooting."


def story(seen: Any) -> str:
    """The events of the ramp, or the folds of the pressure, as a line of HTML."""
    view, units = viewed(seen)
    if seen.kind == "pressure-volume":
        name = "" if units is None else f" {units.read_name('pressure')}"
        folds = [p for p in view.special_points if p.kind == PointKind.fold]
        folds_in_words = [f"p = {p.pressure:.6g}{name} at V = {p.volume:.5g}" for p in folds]
        return (
            "Folds of the pressure: " + "; ".join(folds_in_words) + "."
            if folds_in_words
            else "The pressure has no fold."
        )
    pairs = itertools.zip_longest(view.events, view.events[1:])
    parts = [words for event, following in pairs if (words := _words(event, following, units))]
    whole = isinstance(seen, Diagram)
    regime = regime_of_diagram(seen) if whole else seen.regime
    if regime == Regime.start_unstable:
        return "The ramp cannot start: the state at zero voltage is not stable."
    if seen.area_strain is not None and np.isfinite(seen.area_strain):
        parts.append(f"area strain {seen.area_strain:.5g}")
    if regime not in (Regime.undetermined, Regime.not_decided):
        parts.append(f"regime: <b>{regime.words}</b>")
    if not whole and regime == Regime.not_decided:
        parts.append(f"the surface alone cannot decide this ramp. {_WHOLE}")
    elif not whole and seen.several:
        parts.append(f"the curve has gaps where several states have the same apex stretch. {_WHOLE}")
    text = "; ".join(parts)
    return text[:1].upper() + text[1:]


def _words(event: Event, following: Event | None, units: Any) -> str:
    """An event in words."""
    state = event.state
    landed = following is not None and following.event == RampEvent.landing
    if event.event in (RampEvent.snap, RampEvent.snap_back):
        to = f" from V = {state.volume:.4g} to {following.state.volume:.4g}" if landed and following else ""
        ratio = (
            f" (E/E_EB = {following.state.breakdown_ratio:.3g})"
            if landed and following and event.event == RampEvent.snap
            else ""
        )
        return f"{event.event.replace('_', ' ').replace('snap', 'snaps', 1)} at {voltage_text(state.voltage, units)}{to}{ratio}"
    if event.event == RampEvent.breakdown:
        return f"breaks down at {voltage_text(state.voltage, units)}"
    return ""
