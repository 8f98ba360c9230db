"""Maps of two parameters: which regime each design is in, and the exact curves between them.

Regimes are found on a coarse grid that is refined beside every change; on each edge of the fine grid between two regimes the
boundary is then located by the equations of `boundaries`, or by bisection where none are known.
"""

import dataclasses
import typing

import jax
import numpy as np
import scipy.ndimage

from ..diagram import Ramps
from ..model import Change, Outcome, Regime, Scene, change_of, describe_in_units, plain
from ..numerics import LARGEST, check_whole, shown
from ..surface import Surface, SurfaceFamily
from .boundaries import LANDING_LOST, completed, guesses, has_event, kind_between, located, with_landing
from .designs import (
    Designs,
    by_continuation,
    by_diagrams,
    check_loading,
    designs_on_surfaces,
    surface_for,
    surface_over,
)
from .resolution import (
    BISECTIONS,
    COARSE,
    EVEN_IN_LOG,
    FEW_BISECTIONS,
    ISLAND,
    MANY_EDGES,
    MAP_PASSES,
    MAP_POINTS,
    MAP_POINTS_WITH_SURFACES,
    MOST_POINTS,
    VAGUE,
)

__all__ = ["Boundary", "RegimeEdge", "RegimeMap", "beside_change", "chains", "changes", "regime_edges", "regime_map"]


def beside_change(whole: np.ndarray, reach: int) -> np.ndarray:
    """Designs within `reach` of a change of the regime, along both axes."""
    change = np.zeros(whole.shape, bool)
    across = whole[:, 1:] != whole[:, :-1]
    along = whole[1:] != whole[:-1]
    change[:, 1:] |= across
    change[:, :-1] |= across
    change[1:] |= along
    change[:-1] |= along
    for axis in (0, 1):
        total = np.cumsum(np.pad(change, [(reach + 1, reach) if k == axis else (0, 0) for k in (0, 1)]), axis=axis)
        width = 2 * reach + 1
        lead, stretch_change = (
            np.take(total, np.arange(start, start + whole.shape[axis]), axis=axis) for start in (width, 0)
        )
        change = lead > stretch_change
    return change


def changes(whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The ends (row, column) of all edges of the grid between two regimes: first those along rows."""
    i, j = np.nonzero(whole[:, 1:] != whole[:, :-1])
    k, m = np.nonzero(whole[1:] != whole[:-1])
    one = np.stack([np.concatenate([i, k]), np.concatenate([j, m])], axis=1)
    other = np.stack([np.concatenate([i, k + 1]), np.concatenate([j + 1, m])], axis=1)
    return one, other


def chains(links: list) -> list[list[int]]:
    """Joins links between points into chains; a chain ends at a point with one link or more than two."""
    beside: dict = {}
    for a, b in links:
        beside.setdefault(a, set()).add(b)
        beside.setdefault(b, set()).add(a)
    left = {frozenset(pair) for pair in links if pair[0] != pair[1]}
    chains = []
    ends = [k for k, near in beside.items() if len(near) != 2]
    for begin in [*ends, *beside]:
        for following in sorted(beside[begin]):
            if frozenset((begin, following)) not in left:
                continue
            chain = [begin, following]
            left.discard(frozenset(chain))
            while len(beside[chain[-1]]) == 2:
                onward = [k for k in beside[chain[-1]] if frozenset((chain[-1], k)) in left]
                if not onward:
                    break
                left.discard(frozenset((chain[-1], onward[0])))
                chain.append(onward[0])
            chains.append(chain)
    return chains


class RegimeEdge(typing.NamedTuple):
    """A change of regime along one parameter: its value, the regimes below and above, the event that separates them, the error.

    `error` is relative; `kind` is "" if the value was found by bisection.
    """

    value: float
    below: Regime
    above: Regime
    kind: str
    error: float


class Boundary(typing.NamedTuple):
    """A curve between two regimes: points (n, 2) in the two parameters, in order, and the relative error of each.

    Except where three regimes meet, every point lies on a line of the grid and was located by the equations that `kind` names;
    `kind` is "" if the points were found by bisection.
    """

    regimes: tuple[Regime, Regime]
    kind: str
    points: np.ndarray
    error: np.ndarray


@dataclasses.dataclass(frozen=True)
class RegimeMap:
    """Regimes (n_y, n_x) of designs over two parameters, `values` along each, and the curves between them.

    `classified` is the number of designs that were computed; the others lie inside cells whose corners and neighbours agree.
    """

    scene: Scene
    names: tuple[str, str]
    values: tuple[np.ndarray, np.ndarray]
    regimes: np.ndarray
    boundaries: list[Boundary]
    classified: int

    def at(self, x: float, y: float) -> Regime:
        """The regime of the nearest design of the grid."""
        j, i = (int(np.argmin(np.abs(v - w))) for v, w in zip(self.values, (x, y), strict=True))
        return Regime(int(self.regimes[i, j]))

    def plot(self, *, ax=None, **options):
        """Draws the map; see `plot.plot_regime_map`."""
        from ..plot import plot_regime_map

        return plot_regime_map(self, ax=ax, **options)

    def to_json(self) -> dict:
        """The JSON document of `dielectric-jax regimes`."""
        curves = [
            {"regimes": [r.name for r in b.regimes], "kind": b.kind, "error_estimate": b.error}
            | dict(zip(self.names, b.points.T, strict=True))
            for b in self.boundaries
        ]
        return plain(
            describe_in_units(self.scene)
            | {
                "over": list(self.names),
                "values": dict(zip(self.names, self.values, strict=True)),
                "names": {int(r): r.name for r in Regime},
                "regimes": self.regimes,
                "boundaries": curves,
                "classified": self.classified,
            }
        )


def even(name: str, limits, count: int) -> np.ndarray:
    """Evenly spaced values of a parameter from its lower to its upper limit; logarithmic over wide ranges."""
    low, high = check_range(name, limits)
    if low > 0 and np.log10(high / low) > EVEN_IN_LOG:
        values = np.geomspace(low, high, count)
    else:
        values = np.linspace(low, high, count)
    values[0], values[-1] = low, high
    return values


def check_range(name: str, limits, scene: Scene | None = None) -> tuple[float, float]:
    """A valid range (low, high) of a parameter of the `scene`, a number that it has."""
    if scene is not None:
        scene.check_varies(name)
    if scene is not None and isinstance(limits, (list, tuple)):
        scene.check_in_si({name: [v for v in limits if isinstance(v, (int, float))]})
        limits = scene.numbers_of(name, limits)
    try:
        low, high = (float(v) for v in limits)
    except (TypeError, ValueError, OverflowError):
        low = high = np.nan
    if not (abs(low) <= LARGEST and abs(high) <= LARGEST and low < high):
        raise ValueError(
            f"`{name}` must range over two finite numbers (low, high) with low < high, but is {shown(limits)}."
        )
    return low, high


def _ranges(scene: Scene, over: dict) -> dict[str, tuple[float, float]]:
    """The ranges of parameters of a scene whose ramps the surface knows, as numbers."""
    check_loading(scene)
    return {name: check_range(name, limits, scene) for name, limits in over.items()}


class _Known:
    """The designs classified so far, with their regimes and ramps."""

    def __init__(self, scene: Scene, over: dict, surface, *, diagrams: bool = False):
        self.scene, self.names = scene, tuple(over)
        self.surface = surface_over(scene, over, surface)
        self.parts: list[Designs] = []
        self.values = np.empty((0, len(over)))
        self.regime = np.empty(0, int)
        self.diagrams = diagrams  # whether whole diagrams decide the remaining designs

    def add(self, values: np.ndarray) -> np.ndarray:
        """Classifies designs (n, parameters) and returns their numbers."""
        parameters = dict(zip(self.names, values.T, strict=True))
        found = designs_on_surfaces(self.scene, parameters, surface=self.surface)
        by_continuation(found)
        if self.diagrams:
            by_diagrams(found)
        self.parts.append(found)
        first = len(self.regime)
        self.values = np.concatenate([self.values, values])
        self.regime = np.concatenate([self.regime, found.regime])
        return np.arange(first, len(self.regime))

    def designs(self) -> Designs:
        """All of them together."""
        ramps: Ramps = jax.tree.map(lambda *v: np.concatenate(v), *[d.ramps for d in self.parts])
        return Designs(self.scene, self.regime, ramps, np.zeros(len(self.regime), int))


def _edges(known: _Known, one: np.ndarray, other: np.ndarray):
    """Where the regime changes between pairs of designs, given by number: values (n, parameters), kinds, errors."""
    begin, end = known.values[one], known.values[other]
    share, error = np.full(len(one), np.nan), np.full(len(one), np.nan)
    kinds = np.array(
        [kind_between(a, b) or "" for a, b in zip(known.regime[one], known.regime[other], strict=True)], object
    )
    varying = [change_of(n) in (Change.PRESTRETCH, Change.MATERIAL) for n in known.names]
    same_surface = ~np.any((begin != end)[:, varying], axis=1) if any(varying) else np.ones(len(one), bool)
    designs = known.designs()
    for kind in sorted(set(kinds[same_surface]) - {""}):
        own = np.flatnonzero((kinds == kind) & same_surface)
        has = has_event(kind, known.regime)  # start from there
        source = np.where(has[other[own]], other[own], one[own])
        guess = completed(guesses(kind, designs, source), known.values[source])
        far = kind == LANDING_LOST  # located by shooting
        # a side that the surface did not decide may be slightly off
        vague = designs.ramps.outcome == Outcome.unresolved
        beyond = np.where(vague[one[own]] | vague[other[own]] | far, VAGUE, 0.0)
        keys = [tuple(begin[k, varying]) for k in own]
        for key in dict.fromkeys(keys):
            group = np.array([i for i, k in enumerate(keys) if k == key])
            some = own[group]
            at = dict(zip(known.names, begin[some[0]], strict=True))
            surface = surface_for(known.scene.with_values(**at).membrane, known.surface)
            began = guess[group]
            if far:
                began = with_landing(surface, known.scene, known.names, known.values[source[group]], began)
            share[some], error[some] = located(
                kind, surface, known.scene, known.names, begin[some], end[some], began, beyond[group]
            )
    kinds[np.isnan(share)] = ""
    _bisect(known, one, other, share, error)
    values = begin + share[:, None] * (end - begin)
    size = np.max(np.abs(end - begin) / np.maximum(np.abs(begin), 1e-300), axis=1)
    return values, kinds, error * size


def _bisect(known: _Known, one, other, share, error) -> None:
    """Fills in the positions that no equations gave, by bisection with the regimes of intermediate designs."""
    todo = np.flatnonzero(np.isnan(share))
    low, high = np.zeros(len(todo)), np.ones(len(todo))
    if not len(todo):
        return
    below = known.regime[one[todo]]
    begin, end = known.values[one[todo]], known.values[other[todo]]
    steps = BISECTIONS if len(todo) <= MANY_EDGES else FEW_BISECTIONS
    for _ in range(steps):
        middle = (low + high) / 2
        values = begin + middle[:, None] * (end - begin)
        parameters = dict(zip(known.names, values.T, strict=True))
        found = designs_on_surfaces(known.scene, parameters, surface=known.surface)
        by_continuation(found)
        same = found.regime == below
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    share[todo], error[todo] = (low + high) / 2, (high - low) / 2


def regime_edges(
    scene: Scene,
    over: dict,
    *,
    points: int = 400,
    surface: Surface | SurfaceFamily | None = None,
) -> list[RegimeEdge]:
    """Every value of one parameter at which the regime changes, in order.

    Args:
        scene: a chamber or a constant pressure.
        over: the parameter and its range, `{"chamber_volume": (200.0, 25000.0)}`.
        points: number of designs to classify; a regime narrower than their distance may be missed.
        surface: that of the scene's membrane; built if not given.

    Raises:
        ValueError: for a parameter or range that the scene does not have.

    >>> from dielectric_jax import Chamber, Membrane
    >>> scene = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))
    >>> edges = regime_edges(scene, {"chamber_volume": (400.0, 2000.0)})
    >>> [(round(e.value, 5), e.above.name) for e in edges]
    [(467.85018, 'returns'), (484.04966, 'no_snap'), (551.39914, 'returns'), (1455.89626, 'stays')]
    """
    if len(over) != 1:
        raise ValueError(f"`over` must name one parameter, but names {len(over)}.")
    over = _ranges(scene, over)
    known, names = _Known(scene, over, surface, diagrams=True), tuple(over)
    number = known.add(even(names[0], over[names[0]], points)[:, None])
    change = np.flatnonzero(np.diff(known.regime[number]))
    if not len(change):
        return []
    values, kinds, error = _edges(known, number[change], number[change + 1])
    sides = known.regime[number[change]], known.regime[number[change + 1]]
    return [
        RegimeEdge(float(v[0]), Regime(int(a)), Regime(int(b)), str(k), float(e))
        for v, a, b, k, e in zip(values, *sides, kinds, error, strict=True)
    ]


def regime_map(
    scene: Scene,
    over: dict,
    *,
    points: int | tuple[int, int] | None = None,
    surface: Surface | SurfaceFamily | None = None,
) -> RegimeMap:
    """The regimes of designs over two parameters, and the exact curves between them.

    Args:
        scene: a chamber or a constant pressure.
        over: the two parameters and their ranges, `{"chamber_volume": (200.0, 25000.0), "initial_volume": (2.0, 2.9)}`.
        points: designs along each, by default 400; 25 along a parameter that changes the surface (prestretch and the
            constants of the material) or the breakdown law, because each value needs its own surface.
        surface: that of the scene's membrane, or a family if the prestretch varies; built if not given.

    Raises:
        ValueError: for parameters or ranges that the scene does not have.
    """
    names = typing.cast("tuple[str, str]", tuple(over))
    if len(names) != 2:
        raise ValueError(f"`over` must name two parameters, but names {len(names)}.")
    counts, over = _counts(names, points), _ranges(scene, over)
    x, y = (even(n, over[n], count) for n, count in zip(names, counts, strict=True))
    known = _Known(scene, over, surface)
    number = np.full((len(y), len(x)), -1)

    def classify(rows, columns):
        new = np.unique(np.stack([rows, columns], axis=1), axis=0)
        new = new[number[new[:, 0], new[:, 1]] < 0]
        if len(new):
            number[new[:, 0], new[:, 1]] = known.add(np.stack([x[new[:, 1]], y[new[:, 0]]], axis=1))

    def ticks(name, count, stride):
        return np.unique([*range(0, count, 1 if change_of(name) is not Change.LOADING else stride), count - 1])

    stride = COARSE
    rows, columns = (ticks(n, c, stride) for n, c in zip(names[::-1], (len(y), len(x)), strict=True))
    classify(*(v.ravel() for v in np.meshgrid(rows, columns, indexing="ij")))
    whole = _filled(known, number, rows, columns)
    while stride > 1:
        stride //= 2
        rows, columns = (ticks(n, c, stride) for n, c in zip(names[::-1], (len(y), len(x)), strict=True))
        for _ in range(MAP_PASSES):  # continue into cells that turn out to contain a change
            near = beside_change(whole, stride)[np.ix_(rows, columns)]
            near &= number[np.ix_(rows, columns)] < 0
            if not near.any():
                break
            at = np.nonzero(near)
            classify(rows[at[0]], columns[at[1]])
            known_here = number >= 0
            whole[known_here] = known.regime[number[known_here]]
    # both ends of every edge of the fine grid
    for _ in range(2):
        a, b = changes(whole)
        classify(*np.concatenate([a, b]).T)
        known_here = number >= 0
        whole[known_here] = known.regime[number[known_here]]
        _join_islands(known, number, whole)
    a, b = changes(whole)
    classify(*np.concatenate([a, b]).T)
    count = len(known.regime)
    one, other = number[tuple(a.T)], number[tuple(b.T)]
    boundaries = _curves(known, a, b, one, other) if len(a) else []
    return RegimeMap(scene, names, (x, y), whole, boundaries, count)


def _join_islands(known: _Known, number, whole) -> None:
    """Gives isolated designs that no engine decides, in the sliver where two folds merge, the regime around them."""
    unsure = np.zeros(whole.shape, bool)
    there = number >= 0
    unsure[there] = known.regime[number[there]] == Regime.not_decided
    for regime in np.unique(whole[unsure]):
        labels, _ = typing.cast("tuple[np.ndarray, int]", scipy.ndimage.label(whole == regime))
        sizes = np.bincount(labels.ravel())
        for part in np.unique(labels[unsure & (whole == regime)]):
            own = labels == part
            if sizes[part] <= ISLAND and unsure[own].all():
                about = whole[scipy.ndimage.binary_dilation(own) & ~own]
                whole[own] = np.bincount(about).argmax()
                known.regime[number[own]] = whole[own]


def _counts(names, points) -> tuple[int, int]:
    if points is None:
        first, second = (MAP_POINTS_WITH_SURFACES if change_of(n) is not Change.LOADING else MAP_POINTS for n in names)
        return first, second
    counts = tuple(points) if isinstance(points, (tuple, list)) else (points, points)
    if len(counts) != 2:
        raise ValueError(f"`points` must be a whole number, or two of them, but is {shown(points)}.")
    for count in counts:
        check_whole("points", count, 3, MOST_POINTS)
    return int(counts[0]), int(counts[1])


def _filled(known: _Known, number, rows, columns) -> np.ndarray:
    """Gives every design the regime of the nearest one on a coarse grid."""
    nearest = [
        ticks[np.argmin(np.abs(np.arange(n)[:, None] - ticks[None]), axis=1)]
        for n, ticks in zip(number.shape, (rows, columns), strict=True)
    ]
    return known.regime[number[np.ix_(*nearest)]]


def _curves(known: _Known, a, b, one, other) -> list[Boundary]:
    """The edges between two regimes, joined cell by cell into curves."""
    values, kinds, error = _edges(known, one, other)
    across = a[:, 0] == b[:, 0]
    cells: dict = {}
    for k, (row, column) in enumerate(a):
        beside = [(row - 1, column), (row, column)] if across[k] else [(row, column - 1), (row, column)]
        for cell in beside:
            cells.setdefault(cell, []).append(k)
    pairs = [tuple(sorted((int(known.regime[m]), int(known.regime[n])))) for m, n in zip(one, other, strict=True)]
    links: dict = {}
    points, errors = list(values), list(error)
    for own in cells.values():
        by_pair: dict = {}
        for k in own:
            by_pair.setdefault(pairs[k], []).append(k)
        if len(own) == 2 and len(by_pair) == 1:
            links.setdefault(pairs[own[0]], []).append(tuple(own))
        elif len(own) > 2:
            # three or more regimes: their curves join somewhere in the cell
            points.append(np.mean(values[own], axis=0))
            errors.append(float(np.max(np.ptp(values[own], axis=0) / np.abs(points[-1]))))
            for pair, ends in by_pair.items():
                links.setdefault(pair, []).extend((k, len(points) - 1) for k in ends)
    made = []
    for pair, joined in links.items():
        for chain in chains(joined):
            named = [str(kinds[k]) for k in chain if k < len(kinds)]
            kind = max(set(named), key=named.count) if named else ""
            ends = typing.cast("tuple[Regime, Regime]", tuple(Regime(r) for r in pair))
            made.append(
                Boundary(ends, kind, np.array([points[k] for k in chain]), np.array([errors[k] for k in chain]))
            )
    return made
