"""The design of largest area strain: chamber, filling and prestretch by gradients, with margins as constraints.

A coarse scan of the designs finds the structure of their ramps. From the best design of every connected region SciPy's SLSQP
maximises with exact values and gradients for that structure; the best result is checked by its regime and its whole diagram.
"""

import dataclasses
import itertools
import typing

import numpy as np
import scipy.ndimage
import scipy.optimize

from ..diagram import Diagram, voltage_volume
from ..model import Outcome, Regime, Scene, describe_in_units, place_of, plain
from ..numerics import check_whole
from ..surface import Surface, SurfaceFamily
from .constrained_search import Axis, Climb, Kind, Requirements, axis_of, begin_of, inwards, scan_designs
from .designs import check_loading, classify_designs, surface_for
from .regime_maps import even
from .resolution import ACTIVE, INWARD, MOST_SOUGHT, SEEDS, STRAIN_SCAN
from .scenarios import scenarios_of

__all__ = ["Design", "maximise_area_strain"]


@dataclasses.dataclass(frozen=True)
class Design:
    """A best design: its parameters, its area strain, and its active constraints.

    `active` names the constraints that hold with equality, bounds as in "chamber_volume_upper"; `multipliers` are the rates at
    which the area strain would grow if each were relaxed: by one unit of a parameter, of a margin, or of q for the way down.
    `slack` is the slack of every constraint. `regime`, and `diagram` if requested, are those of the design moved inwards by
    1e-7 of the ranges, because they are ambiguous on the boundary of a regime. `scan` compares with a scan of many designs.
    For a robust design `area_strain` is the worst case, or the quantile.
    """

    parameters: dict[str, float]
    area_strain: float
    active: tuple[str, ...]
    multipliers: dict[str, float]
    slack: dict[str, float]
    regime: Regime
    scene: Scene
    diagram: Diagram | None
    evaluations: int
    scan: dict | None = None

    def to_json(self) -> dict:
        """The JSON document of `dielectric-jax optimise`."""
        return plain(
            describe_in_units(self.scene)
            | {
                "parameters": self.parameters,
                "area_strain": self.area_strain,
                "active": list(self.active),
                "multipliers": self.multipliers,
                "slack": self.slack,
                "regime": self.regime.name,
                "evaluations": self.evaluations,
                "scan": self.scan,
                "diagram": None if self.diagram is None else self.diagram.to_json(self.scene.units),
            }
        )


def maximise_area_strain(
    scene: Scene,
    over: dict,
    *,
    survival_margin: float = 0.0,
    operating_margin: float = 0.0,
    must_snap: bool = False,
    way_down: str | None = None,
    uncertain: dict | None = None,
    quantile: float | None = None,
    surface: Surface | SurfaceFamily | None = None,
    compare: int = 0,
    check: bool = True,
) -> Design:
    """The design of largest area strain.

    Args:
        scene: a chamber, or a constant pressure, with every parameter that is not optimised.
        over: the parameters to optimise and their ranges, `{"chamber_volume": (500.0, 25000.0)}`; any of those that
            do not change the material.
        survival_margin: m, so that E/E_EB ≤ 1 − m at every landing.
        operating_margin: the strain is taken where E/E_EB is 1 minus this margin, and landings lie below that.
        must_snap: whether the ramp must snap.
        way_down: "stays" or "returns", the required regime.
        uncertain: relative uncertainties of parameters, `{"initial_volume": 0.02, "stretch_limit": 0.1}`; the margins hold
            at the corners and the centre of that box, and the strain is the worst of these. The uncertainty of a parameter
            that is optimised is relative to the value chosen.
        quantile: the fraction of 32 evenly spread samples of the box that may fail or fall short, instead of the worst case.
        surface: that of the scene's membrane, or a family over the prestretch if it is optimised; built if not given.
        compare: the least number of designs to scan for a comparison.
        check: whether to compute the diagram of the result.

    Raises:
        ValueError: for invalid arguments, or if no design of the scan satisfies the constraints.

    >>> from dielectric_jax import Chamber, Membrane
    >>> scene = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.3))
    >>> best = maximise_area_strain(scene, over={"chamber_volume": (500.0, 25000.0)}, check=False)
    >>> round(best.parameters["chamber_volume"], 4), round(best.area_strain, 6), best.active
    (7699.2058, 23.480988, ('survival_margin',))
    """
    if not over:
        raise ValueError("`over` must name at least one parameter, but is empty.")
    if len(over) > MOST_SOUGHT:
        raise ValueError(f"`over` must name at most {MOST_SOUGHT} parameters, but names {len(over)}.")
    check_loading(scene)
    check_whole("compare", compare, 0, 10_000_000)
    required = Requirements(survival_margin, operating_margin, must_snap, way_down)
    axes = [axis_of(name, limits, scene) for name, limits in over.items()]
    names = tuple(over)
    for name in names:
        if place_of(name)[:2] == ("membrane", "material"):
            raise ValueError(f"`{name}` must be held, because every value of it needs its own surface.")
    scenes = scenarios_of(scene, axes, uncertain or {}, quantile, surface, operating_margin)
    share = 0.0 if quantile is None else quantile
    counts, values = _scan_of(axes, len(scenes))
    strain, nominal = scan_designs(scenes, names, values, required, share)
    best, evaluations = None, 0
    for number in _seeds(strain, nominal, counts):
        z = np.array([i / (n - 1) for i, n in zip(np.unravel_index(number, counts), counts, strict=True)])
        kind = Kind(int(nominal.ramps.snaps[number]), way_down is not None and nominal.ramps.snaps[number] > 0)
        begin = begin_of(kind, nominal.ramps, np.array([number]))
        x = values[number]
        for _ in range(1 if quantile is None else 3):  # other scenarios may be the worst at the design that was found
            held = _held(scenes, names, x, required, share)
            climb = Climb(kind, scenes, axes, required, held)
            if not climb.seed(z, [begin] * len(scenes)):
                break
            found = climb.run(z)
            evaluations += climb.evaluations
            least = -np.inf if best is None else best[1] + 1e-9
            if found is None or found[1] <= least:
                break
            if not _is_true(climb, found[0], names):
                # the search left the structure of its ramp: keep the design it began with
                rows = climb.rows(z) if np.isfinite(strain[number]) else None
                if rows is None or rows[0][held].min() <= least:
                    break
                found = z, float(rows[0][held].min())
            best = found[0], found[1], held, climb
            x = climb.place(found[0])[0]
    if best is None:
        raise ValueError("`over` must contain a design that satisfies the constraints, but none was found there.")
    return _answer(scene, best, evaluations, compare, check, share)


def _scan_of(axes: list[Axis], scenarios: int) -> tuple[tuple[int, ...], np.ndarray]:
    """How many designs the scan that begins a climb takes along each axis, and those designs (n, parameters)."""
    count = len(axes)
    if scenarios == 1:
        counts = STRAIN_SCAN.get(count, (7,) * count)
    else:
        counts = (max(5, 40 // count**2),) * count
    ticks = [even(a.name, (a.low, a.high), n) for a, n in zip(axes, counts, strict=True)]
    return counts, np.stack([g.ravel() for g in np.meshgrid(*ticks, indexing="ij")], axis=1)


def _held(scenes, names, x, required, share) -> np.ndarray:
    """Which scenarios must satisfy the constraints: all but the worst fraction at a design."""
    if share == 0:
        return np.ones(len(scenes), bool)
    strains = np.array(
        [float(np.nan_to_num(scan_designs([s], names, x[None], required)[0][0], nan=-1.0)) for s in scenes]
    )
    held = np.ones(len(scenes), bool)
    held[np.argsort(strains, kind="stable")[: int(np.floor(share * len(scenes)))]] = False
    return held


def _seeds(strain: np.ndarray, nominal, counts) -> list[int]:
    """The best designs of every connected region with the same structure of ramp, and those closest to being feasible."""
    ramps = nominal.ramps
    survives = np.isin(ramps.outcome, (Outcome.breakdown_on_branch, Outcome.breakdown_in_snap)) & np.isfinite(
        ramps.landing.apex_stretch[:, 0]
    )
    best = []
    for snaps in (0, 1, 2):
        for regime in (Regime.no_snap, Regime.breaks_before_snap, Regime.stays, Regime.returns, Regime.not_decided):
            own = np.isfinite(strain) & (ramps.snaps == snaps) & (nominal.regime == int(regime))
            for part in _parts(own, counts):
                best.append((-strain[part].max(), int(part[np.argmax(strain[part])])))
    chosen = [k for _, k in sorted(best)[:SEEDS]]
    # thin regions between the designs of the scan
    landed = np.where(survives, np.nan_to_num(ramps.landing_ratio, nan=0.0).max(axis=-1), np.inf)
    excess = np.where(np.isfinite(strain), np.inf, landed)
    near = [k for k in np.argsort(excess)[:2].tolist() if np.isfinite(excess[k])]
    return chosen + [k for k in near if k not in chosen]


def _parts(mask: np.ndarray, counts) -> typing.Iterator[np.ndarray]:
    """The connected parts of a set of designs of the scan, as their numbers."""
    labels, found = typing.cast(
        "tuple[np.ndarray, int]", scipy.ndimage.label(mask.reshape(counts), structure=np.ones((3,) * len(counts)))
    )
    for part in range(1, found + 1):
        yield np.flatnonzero(labels.ravel() == part)


def _is_true(climb: Climb, z: np.ndarray, names: tuple) -> bool:
    """Whether the ramps of the design have the structure that was optimised, according to an independent search."""
    moved = np.clip(z + 10 * INWARD * inwards(climb, z), 0.0, 1.0)
    if climb.rows(moved) is None:
        return False
    for j in np.flatnonzero(climb.held):
        scenario = climb.scenes[j]
        given = dict(zip(names, (climb.place(moved)[0] * scenario.factors)[:, None], strict=True))
        ramps = classify_designs(scenario.real, given, surface=scenario.surface, whole=False).ramps
        mine = climb.unknowns(moved)[j][: 1 + 3 * climb.kind.snaps]
        if ramps.outcome[0] == Outcome.unresolved:
            values = {n: float(v[0]) for n, v in given.items()}
            other = _events_of(scenario.real.with_values(**values))
        elif ramps.outcome[0] == Outcome.breakdown_on_branch and ramps.snaps[0] == climb.kind.snaps:
            other = begin_of(climb.kind, ramps, np.array([0]))[0][: len(mine)]
        else:
            return False
        if len(other) != len(mine) or not np.allclose(mine, other, rtol=1e-5, atol=0):
            return False
    return True


def _events_of(scene: Scene) -> np.ndarray:
    """The start, and (λa, q) of every snap with λa of its landing, of a ramp to breakdown on the branch, by its diagram."""
    up = voltage_volume(scene).ramp()
    if up.area_strain_reason != "breakdown on the branch":
        return np.empty(0)
    jumps = [
        (snap.state.apex_stretch, snap.state.voltage_squared, landing.state.apex_stretch)
        for snap, landing in zip(up["snap"], up["landing"], strict=True)
    ]
    return np.array([up.events[0].state.apex_stretch, *itertools.chain(*jumps)])


def _answer(scene: Scene, best, evaluations: int, compare: int, check: bool, share: float) -> Design:
    """The record of the best design, its active constraints and multipliers, checked by its diagram."""
    z, growth, held, climb = best
    growths, by_z, limits = climb.rows(z)
    x, rate = climb.place(z)
    wish = climb.required
    entries = []
    for name, j, value, slope in limits:
        if held[j]:
            # margins in units of E/E_EB, the way down in units of q
            scale = {
                "survival_margin": 0.5 * (1 - wish.survival_margin),
                "operating_margin": 0.5 * (1 - wish.operating_margin),
            }
            unit = scale.get(name, 0.01 if name in ("stays", "returns") else 1.0)
            entries.append((name, value * unit, slope * unit))
    for i, axis in enumerate(climb.axes):
        side = np.eye(len(z))[i] * rate[i]
        entries += [(f"{axis.name}_lower", x[i] - axis.low, side), (f"{axis.name}_upper", axis.high - x[i], -side)]
    worst = int(np.flatnonzero(held)[np.argmin(growths[held])])
    slack: dict = {}
    for name, value, _ in entries:
        slack[name] = min(float(value), slack.get(name, np.inf))
    widths = {f"{a.name}_{side}": a.high - a.low for a in climb.axes for side in ("lower", "upper")}
    active = [(n, s) for n, v, s in entries if abs(v) <= ACTIVE * widths.get(n, 1.0)]
    multipliers: dict = {}
    if active:
        # of the area strain: its gradient is balanced by those of the active constraints
        target = -np.exp(growth) * by_z[worst]
        found = scipy.optimize.nnls(np.array([s for _, s in active]).T, target)[0]
        for (name, _), value in zip(active, found, strict=True):
            multipliers[name] = multipliers.get(name, 0.0) + float(value)
    moved = np.clip(z + INWARD * inwards(climb, z), 0.0, 1.0)
    near = dict(zip(climb.names, climb.place(moved)[0].tolist(), strict=True))
    regime = classify_designs(scene, {n: [v] for n, v in near.items()}, surface=climb.scenes[0].given).regime[0]
    diagram = None
    if check:
        checked = scene.with_values(**near)
        surface = climb.scenes[0].given
        own = None if isinstance(surface, SurfaceFamily) else surface_for(checked.membrane, surface)
        diagram = voltage_volume(checked, surface=own)
    parameters = dict(zip(climb.names, x.tolist(), strict=True))
    scan = _compared(climb, compare, float(np.expm1(growth)), share) if compare else None
    return Design(
        parameters,
        float(np.expm1(growth)),
        tuple(dict.fromkeys(name for name, _ in active)),
        multipliers,
        slack,
        Regime(int(regime)),
        scene.with_values(**parameters),
        diagram,
        evaluations,
        scan,
    )


def _compared(climb: Climb, count: int, reached: float, share: float) -> dict:
    """The best of an evenly spaced scan of at least `count` designs."""
    each = int(np.ceil(count ** (1 / len(climb.axes)) - 1e-9))
    ticks = [even(a.name, (a.low, a.high), each) for a in climb.axes]
    best, where = -np.inf, None
    for block in _blocks(ticks):
        values = np.array(block)[:, ::-1]
        strain = scan_designs(climb.scenes, climb.names, values, climb.required, share)[0]
        if np.isfinite(strain).any():
            k = int(np.nanargmax(strain))
            if strain[k] > best:
                best, where = float(strain[k]), values[k]
    found = None if where is None else dict(zip(climb.names, where.tolist(), strict=True))
    total = each ** len(climb.axes)
    return {"designs": total, "area_strain": best, "parameters": found, "gain": reached - best}


def _blocks(ticks) -> typing.Iterator[list]:
    """All designs of a grid, twenty thousand at a time."""
    every = itertools.product(*ticks[::-1])
    while block := list(itertools.islice(every, 20000)):
        yield block
