"""The rule of a ramp on a curve whose events are known in closed form: q = x³ − 3x + 3, with x for the volume.

It turns at x = −1 (q = 5) and x = 1 (q = 1) and is stable where it rises. At q = 5 it also passes through x = 2, at q = 1
through x = −2, and it is zero at x = −2.1038.
"""

import numpy as np
import pytest

from dielectric_jax.diagram.ramp import Stop, follow
from dielectric_jax.model import PointKind

ZERO = float(np.roots([1.0, 0.0, -3.0, 3.0]).real.min())


class Cubic:
    """The curve up to x = `top`, broken from x = `breaks` on; a mode is unstable from x = `bulges` on."""

    def __init__(self, breaks: float = 2.5, top: float = 10.0, bulges: float = np.inf):
        self.breaks, self.top, self.bulges = breaks, top, bulges

    def next_stop(self, here: float, rising: bool) -> Stop:
        side = 1.0 if (3 * here**2 - 3 > 0) == rising else -1.0
        known = [(PointKind.fold, -1.0), (PointKind.fold, 1.0)]
        known += [(PointKind.mode, self.bulges)]
        known += [(PointKind.breakdown, self.breaks)] if rising else [(PointKind.zero_voltage, ZERO)]
        ahead = [(side * (x - here), kind, x) for kind, x in known if side * (x - here) > 1e-9 and x <= self.top]
        if not ahead:
            return Stop(None, here, side)
        _, kind, x = min(ahead)
        return Stop(kind, x, side)

    def landing(self, fold: Stop):
        load = fold.at**3 - 3 * fold.at + 3
        roots = np.roots([1.0, 0.0, -3.0, 3 - load]).real
        stable = [x for x in roots if 3 * x**2 - 3 > 1e-3 and fold.side * (x - fold.at) > 1e-3 and x <= self.top]
        return min(stable, key=lambda x: abs(x - fold.at), default=None)

    def is_broken(self, landing: float) -> bool:
        return landing >= self.breaks

    def loss(self, here: float) -> str | None:
        return "bulges" if here >= self.bulges else None


def places_of(steps) -> list[tuple]:
    """Events and places of a ramp; at the window's edge the place it was left from."""
    return [(s.event.value, s.at.at if isinstance(s.at, Stop) else s.at) for s in steps]


@pytest.mark.parametrize(
    ("curve", "events", "reason"),
    [
        (Cubic(2.5), [("snap", -1), ("landing", 2), ("breakdown", 2.5)], "breakdown on the branch"),
        (Cubic(1.9), [("snap", -1), ("landing", 2), ("breakdown", 2)], "breakdown in the snap"),
        (Cubic(-1.5), [("breakdown", -1.5)], "breakdown on the branch"),
        (Cubic(1.9, top=1.5), [("snap", -1), ("no_landing", -1)], "no landing"),
        (Cubic(20.0), [("snap", -1), ("landing", 2), ("end", 2)], "window"),
        (Cubic(bulges=-1.5), [("end", -1.5)], "bulges"),
        (Cubic(bulges=2.2), [("snap", -1), ("landing", 2), ("end", 2.2)], "bulges"),
        (Cubic(bulges=1.5), [("snap", -1), ("landing", 2), ("end", 2)], "bulges"),
        (Cubic(1.9, bulges=1.5), [("snap", -1), ("landing", 2), ("breakdown", 2)], "breakdown in the snap"),
        (Cubic(bulges=-3.0), [("end", ZERO)], "bulges"),
    ],
)
def test_the_way_up(curve, events, reason):
    """Along the rising branch to its fold, to the stable state at the same load, on to breakdown or out of the window."""
    steps = follow(curve, ZERO, rising=True)
    assert [name for name, _ in places_of(steps)] == [name for name, _ in events]
    np.testing.assert_allclose([at for _, at in places_of(steps)], [at for _, at in events], rtol=1e-7)
    assert steps[-1].reason == reason
    assert all(step.reason is None for step in steps[:-1])


def test_the_way_down():
    """It snaps back at the other fold and ends where it began."""
    steps = follow(Cubic(), 2.5, rising=False)
    assert [name for name, _ in places_of(steps)] == ["snap_back", "landing", "end"]
    np.testing.assert_allclose([at for _, at in places_of(steps)], [1.0, -2.0, ZERO], rtol=1e-7)
    assert steps[-1].reason == "zero voltage"


def test_as_many_jumps_as_are_allowed():
    """It ends at the last fold from which it jumped."""
    steps = follow(Cubic(), ZERO, rising=True, most=1)
    assert [name for name, _ in places_of(steps)] == ["snap", "landing", "end"]
    assert (steps[-1].at, steps[-1].reason) == (-1.0, "too many jumps")
