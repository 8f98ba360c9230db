"""Diagrams of many scenes by continuation, side by side in the lanes of a few compiled programs.

The chain is that of a single diagram: the state at zero voltage, continuation up to breakdown, special points between the
traced points, the ramp. Lanes share programs, not fates: each has its own step and its own end, a lane that has ended makes
room for the next, and one that fails says why.
"""

import concurrent.futures
import dataclasses
import functools
import typing
from collections.abc import Sequence

import jax
import numpy as np
from scipy.interpolate import make_interp_spline

from ..model import (
    LANES,
    SCALE,
    SCANNED_LOAD,
    Chamber,
    ClosingEquation,
    ConstantPressure,
    ConstantVoltage,
    Corrected,
    FoldAhead,
    LoadingCondition,
    Membrane,
    Outcome,
    Scene,
    SceneBatch,
    calls,
    locking_stretch,
    map_nodes,
    other_loading,
    padded,
    pick,
    stretch_shares,
)
from ..numerics import Code, cores
from .batch_ramps import RampArrays, assemble, have_others, ramps_on_lines
from .landings import Landing, folds_ahead, landings
from .polylines import Polylines
from .ramps import APEX, LOAD, Ramps, Slot, ramps_of
from .resolution import (
    BATCH_BLOCK,
    BATCH_LENGTHS,
    BATCH_LOAD_LIMITS,
    BATCH_MOST_POINTS,
    BATCH_TRACE_STEPS,
    SAME_LANDING,
    START_LINE,
)
from .states import check_request
from .tracing import TraceGrid, march_program, new_walks

__all__ = ["Batch", "condition_of", "continue_scenes", "stacked", "starts"]


class Batch(typing.NamedTuple):
    """Diagrams of many scenes: their ramps and special points, how each line ended, and the lines.

    `ramps` as from `chamber_ramps`, but the places of folds are less exact than their loads: the error of a `Point` holds
    both. `code` (scenes,) says why the continuation from the start ended: `Code.breakdown`, or `Code.apex_cone` where the
    load swings towards a limit below breakdown. `branches` (scenes, points, 3) holds λa, p, q of that branch, NaN after its
    end: the start and the folds exact, between them traced points on a coarse grid, good enough to draw.
    """

    ramps: Ramps
    code: np.ndarray
    branches: np.ndarray


def continue_scenes(scenes: Sequence[Scene], *, tolerance: float = 1e-8) -> Batch:
    """Voltage–volume diagrams of many scenes from zero voltage to breakdown: branch, special points and ramp of each.

    The scenes may differ in everything: membrane, chamber, filling, pressure; each membrane is scanned once for other
    branches, which takes some tenths of a second, a scene of a known one milliseconds. What a lane's continuation does not decide has
    outcome `Outcome.unresolved`, NaN, and a `code`; `voltage_volume` decides it. Raises ValueError for bad input.

    `tolerance` holds for p, V and q at their λa, so for every voltage. Where on its branch a fold lies is known less well, to 1e-4
    of its volume at worst: its `error` counts that.

    >>> from dielectric_jax import Chamber, Membrane
    >>> film = Membrane()
    >>> batch = continue_scenes([Scene(film, Chamber(volume=v, initial_volume=2.42)) for v in (800.0, 1600.0)])
    >>> [round(float(v), 9) for v in batch.ramps.snap.voltage[:, 0]]
    [0.097199007, 0.07649536]
    """
    check_request(8, tolerance)
    for scene in scenes:
        if not isinstance(scene, Scene) or not isinstance(scene.loading, (Chamber, ConstantPressure)):
            raise ValueError(f"`scenes` must be scenes with a Chamber or a ConstantPressure, but one is {scene!r}.")
    if not scenes:
        raise ValueError("`scenes` must hold at least one scene, but is empty.")
    groups: dict = {}
    for key, own in by_membrane(scenes).items():
        key.membrane.check_breaks_at_apex()
        groups.setdefault(jax.tree.structure(key.membrane), []).append(own)
    groups = {tree: np.sort(np.concatenate(parts)) for tree, parts in groups.items()}
    share = min(BATCH_BLOCK, max(LANES, -(-len(scenes) // cores())))
    blocks = [own[i : i + share] for own in groups.values() for i in range(0, len(own), share)]
    with concurrent.futures.ThreadPoolExecutor(cores()) as pool:  # blocks wait for the threads of the map
        done = list(pool.map(lambda own: _block([scenes[i] for i in own], tolerance), blocks))
    order = np.argsort(np.concatenate(blocks))
    most = max(part.branches.shape[1] for part in done)
    branches = [
        np.pad(p.branches, ((0, 0), (0, most - p.branches.shape[1]), (0, 0)), constant_values=np.nan) for p in done
    ]
    parts = [p._replace(branches=b) for p, b in zip(done, branches, strict=True)]
    return jax.tree.map(lambda *v: np.concatenate(v)[order], *parts)


@dataclasses.dataclass(frozen=True)
class MembraneKey:
    """A membrane identified by its numbers, as a key of caches."""

    membrane: Membrane = dataclasses.field(compare=False, hash=False)
    numbers: tuple

    @staticmethod
    def of(membrane: Membrane) -> "MembraneKey":
        """The key of a membrane."""
        leaves, tree = jax.tree.flatten(membrane)
        return MembraneKey(membrane, (tree, *(np.asarray(v).item() for v in leaves)))


def by_membrane(scenes: Sequence[Scene]) -> dict[MembraneKey, np.ndarray]:
    """Which scenes have one membrane: their indices by its key."""
    same: dict = {}
    for i, scene in enumerate(scenes):
        same.setdefault(id(scene.membrane), []).append(i)
    groups: dict = {}
    for own in same.values():  # few membranes are looked into where scenes share them
        groups.setdefault(MembraneKey.of(scenes[own[0]].membrane), []).extend(own)
    return {key: np.sort(own) for key, own in groups.items()}


def stacked(modules) -> typing.Any:
    """One module whose leaves are columns of those of many alike."""
    distinct = {id(module): module for module in modules}
    place = {key: i for i, key in enumerate(distinct)}
    which = np.array([place[id(module)] for module in modules])
    leaves, tree = zip(*map(jax.tree.flatten, distinct.values()), strict=True)
    return jax.tree.unflatten(tree[0], [np.array(column, float)[which] for column in zip(*leaves, strict=True)])


@functools.lru_cache(maxsize=64)
def _zero_line(key: MembraneKey):
    """Interpolants on the line of states at zero voltage: of log(λa − λ0), log p, log V by the place on it."""
    membrane = key.membrane
    rim, high = float(membrane.prestretch), membrane.lock_up_stretch()[0]
    share = stretch_shares(1e-6, START_LINE)
    p, v, slope = map_nodes(membrane.material, rim + (high - rim) * share, 0.0, rim, 48.0)
    with np.errstate(all="ignore"):
        logs = np.log(np.stack([(high - rim) * share, p, v]))
    good = np.isfinite(logs).all(axis=0) & (slope < 0)
    return make_interp_spline(np.flatnonzero(good).astype(float), logs[:, good], k=5, axis=1)


def _first_place(line, row: int, wanted: np.ndarray) -> np.ndarray:
    """Where the interpolant of log p (row 1) or log V (row 2) first reaches the wanted values; NaN where it never does."""
    fine = np.linspace(line.t[0], line.t[-1], 12 * START_LINE)
    values = line(fine)[row]
    peak = np.maximum.accumulate(values)
    i = np.searchsorted(peak, np.log(wanted))
    inside = (i > 0) & (i < len(fine))
    i = np.clip(i, 1, len(fine) - 1)
    share = (np.log(wanted) - values[i - 1]) / (values[i] - values[i - 1])
    return np.where(inside, fine[i - 1] + np.clip(share, 0, 1) * (fine[i] - fine[i - 1]), np.nan)


def starts(scenes: list[Scene], scene_batch: SceneBatch, tolerance: float) -> Corrected:
    """The states of smallest volume at zero voltage."""
    lanes = len(scenes)
    u, rows = np.full((lanes, 3), np.nan), np.zeros((lanes, 3))
    rows[:, 1] = 1.0
    targets, kinds = np.ones(lanes), np.full(lanes, ClosingEquation.level)
    groups = by_membrane(scenes)
    for i, scene in enumerate(scenes):
        loading = scene.loading
        if isinstance(loading, ConstantPressure):
            targets[i] = float(loading.pressure)
        elif not isinstance(loading, Chamber):
            raise other_loading(loading, Chamber, ConstantPressure)
        elif loading.initial_volume is not None:
            targets[i], kinds[i] = float(loading.initial_volume), ClosingEquation.volume
        else:
            targets[i] = float(typing.cast(float, loading.initial_pressure))
    with np.errstate(all="ignore"):
        for key, own in groups.items():
            line = _zero_line(key)
            for row, kind in ((2, ClosingEquation.volume), (1, ClosingEquation.level)):
                which = own[kinds[own] == kind]
                place = _first_place(line, row, targets[which])
                stretch, pressure, _ = np.exp(line(np.nan_to_num(place, nan=line.t[0])))
                rim = scene_batch.membrane.prestretch[which]
                u[which] = np.where(
                    np.isfinite(place)[:, None], np.stack([rim + stretch, pressure, 0 * rim], axis=1), np.nan
                )
    flat = dataclasses.replace(
        scene_batch, condition=jax.tree.map(lambda v: np.full(lanes, float(v)), ConstantVoltage(0.0).condition())
    )
    corrected = Corrected.nothing(lanes)
    same: dict = {}  # scenes that begin in one state share it
    for key, own in groups.items():
        for i in own.tolist():
            if np.isfinite(u[i]).all():
                same.setdefault((key, kinds[i], targets[i]), []).append(i)
    if same:
        first = np.array([own[0] for own in same.values()])
        given = u[first], rows[first], targets[first], kinds[first]
        found = flat.correct(first, *given, tolerance=tolerance / 10, reach=0.5)
        which = np.concatenate([np.array(own) for own in same.values()])
        source = np.repeat(np.arange(len(same)), [len(own) for own in same.values()])
        for store, values in zip(corrected, found, strict=True):
            store[which] = values[source]
    return corrected._replace(index=_index_under_loading(scenes, corrected))


def _index_under_loading(scenes: list[Scene], corrected: Corrected) -> np.ndarray:
    """The index of states at zero voltage under the loadings of their scenes, from that under prescribed pressure.

    A gas of stiffness k takes one from it where 1 + k dV/dp < 0.
    """
    pressure, volume = (np.where(corrected.ok, v, 1.0) for v in (corrected.u[:, 1], corrected.volume))
    stiffness = np.asarray(_contours_of(scenes, pressure, volume).gas_stiffness(volume))
    with np.errstate(all="ignore"):
        gain = 1 + stiffness * corrected.volume_rate / (corrected.tangent[:, 1] * SCALE[1])
    return np.where(corrected.ok & (gain < 0), corrected.index - 1, corrected.index)


def condition_of(scene: Scene, pressure: float, volume: float) -> LoadingCondition:
    """The condition of a scene's loading, with the filling of a chamber."""
    if isinstance(scene.loading, Chamber):
        return scene.loading.condition(pressure, volume)
    return scene.loading.condition()


def _contours_of(scenes: list[Scene], pressure: np.ndarray, volume: np.ndarray) -> LoadingCondition:
    """The same of many scenes, as columns."""
    loadings = [s.loading for s in scenes]
    kinds: dict = {}
    for i, loading in enumerate(loadings):
        kinds.setdefault(jax.tree.structure(loading), []).append(i)
    parts = []
    for own in kinds.values():
        columns = stacked([loadings[i] for i in own])
        filling = (pressure[own], volume[own]) if isinstance(columns, Chamber) else ()
        parts.append(jax.tree.map(lambda v, own=own: np.broadcast_to(v, len(own)), columns.condition(*filling)))
    back = np.argsort(np.concatenate(list(kinds.values())))
    return jax.tree.map(lambda *v: np.concatenate(v)[back], *parts)


@dataclasses.dataclass
class _March:
    """Traced lines under way: points and tangents in scaled unknowns, and why they ended."""

    scene_batch: SceneBatch
    limits: np.ndarray
    owner: np.ndarray

    def __post_init__(self):
        lines = len(self.owner)
        self.points, self.tangents = (np.full((lines, BATCH_MOST_POINTS, 3), np.nan) for _ in range(2))
        self.count = np.zeros(lines, int)
        self.code = np.full(lines, int(Code.not_converged))
        self.left = np.zeros(lines, bool)  # whether the line ends where it leaves the scanned window

    def run(self, u: np.ndarray, headings: np.ndarray) -> None:
        """Follows every line from u (lines, 3) towards `headings`, on finer grids where a coarse one ends."""
        peak = np.zeros(len(self.owner))
        todo = np.flatnonzero(np.isfinite(u).all(axis=1))
        for level, steps in enumerate(BATCH_TRACE_STEPS):
            walk = new_walks(u, headings)
            self.code[todo] = int(Code.ok)
            going = todo
            while len(going):
                for now in calls(going):
                    self._advance(now, walk, peak, steps, np.array(BATCH_LOAD_LIMITS[level]))
                full = going[self.count[going] >= BATCH_MOST_POINTS - 8]
                self.code[full[self.code[full] == int(Code.ok)]] = int(Code.too_many_points)
                going = going[self.code[going] == int(Code.ok)]
            unfinished = np.isin(self.code[todo], (int(Code.beyond_tolerance), int(Code.step_too_small)))
            todo = todo[unfinished]
            if not len(todo) or level + 1 == len(BATCH_TRACE_STEPS):
                break
            begun = self.count[todo] > 1
            self.count[todo[begun]] -= 1  # on from the last point inside
            again, last = todo[begun], self.count[todo[begun]] - 1
            u, headings = u.copy(), headings.copy()
            u[again], headings[again] = self.points[again, last] * SCALE, self.tangents[again, last] * SCALE
            self.count[again] -= 1
        # what a coarser grid found further on is not part of the line
        beyond = np.arange(BATCH_MOST_POINTS) >= self.count[:, None]
        self.points[beyond], self.tangents[beyond] = np.nan, np.nan

    def go_on(self) -> None:
        """Follows the lines that broke down before any fold further, to their next fold or out of the scanned window."""
        held = np.arange(self.points.shape[1]) < self.count[:, None]
        with np.errstate(invalid="ignore"):
            rising = ((self.tangents[..., 2] > 0) | ~held).all(axis=1)
        lanes = np.flatnonzero((self.code == int(Code.breakdown)) & rising & (self.count > 1))
        if not len(lanes):
            return
        u, headings = np.full((len(self.owner), 3), np.nan), np.tile([0.0, 0.0, 1.0], (len(self.owner), 1))
        last = self.count[lanes] - 1
        u[lanes], headings[lanes] = self.points[lanes, last] * SCALE, self.tangents[lanes, last] * SCALE
        self.count[lanes] -= 1
        walk, peak = new_walks(u, headings), np.full(len(self.owner), np.inf)
        self.code[lanes] = int(Code.ok)
        going = lanes
        while len(going):
            for now in calls(going):
                self._advance(now, walk, peak, BATCH_TRACE_STEPS[-1], np.array(BATCH_LOAD_LIMITS[-1]))
            at = np.maximum(self.count[going] - 1, 0)
            points = self.points[going, at] * SCALE
            with np.errstate(invalid="ignore"):
                turned = self.tangents[going, at, 2] <= 0
                left = (
                    points[:, 2]
                    > SCANNED_LOAD * self.scene_batch.limits(np.nan_to_num(points[:, 0], nan=2.0), going)[2]
                )
            beyond = points[:, 0] > self.limits[going, 1]  # the last step may leave the window of the stretch
            left = (left & ~turned) | beyond
            out = np.isin(self.code[going], (int(Code.window_stretch), int(Code.window_load), int(Code.lock_up)))
            self.left[going] = left | out
            full = self.count[going] >= BATCH_MOST_POINTS - 8
            going = going[~(turned | left | full) & (self.code[going] == int(Code.ok))]
        self.code[lanes] = int(Code.breakdown)

    def _advance(self, now, walk, peak, steps, load_limits) -> None:
        lanes, count = padded(now), len(now)
        own = self.owner[lanes]
        membrane, condition = pick(self.scene_batch.membrane, own), pick(self.scene_batch.condition, own)
        begin = pick(walk, lanes), peak[lanes], TraceGrid(steps, load_limits, BATCH_LENGTHS)
        found, new_peak, passed = march_program(membrane, condition, self.limits[own], *begin)
        for store, values in zip(walk, found, strict=True):
            store[now] = np.asarray(values)[:count]
        peak[now] = np.asarray(new_peak)[:count]
        base, tangent, accepted = (np.asarray(v)[:, :count] for v in passed)
        for k in range(len(base)):
            new = now[accepted[k]]
            self.points[new, self.count[new]] = base[k, accepted[k]]
            self.tangents[new, self.count[new]] = tangent[k, accepted[k]]
            self.count[new] += 1
        self.code[now] = walk.code[now]


def _block(scenes: list[Scene], tolerance: float) -> Batch:
    """`continue_scenes` of scenes with membranes of one kind."""
    membrane = stacked([s.membrane for s in scenes])
    windows, limits = {}, []
    for scene in scenes:
        key = id(scene.membrane), scene.window.apex_stretch, scene.window.load_fraction
        if key not in windows:
            windows[key] = scene.limits(), locking_stretch(scene.membrane)
        limits.append(windows[key])
    locks = np.array([lock for _, lock in limits])
    nothing = jax.tree.map(lambda v: np.full(len(scenes), float(v)), ConstantVoltage(0.0).condition())
    start = starts(scenes, SceneBatch(membrane, nothing, locks), tolerance)
    filled = (np.where(start.ok, values, 1.0) for values in (start.u[:, 1], start.volume))
    condition = _contours_of(scenes, *filled)
    scene_batch = SceneBatch(membrane, condition, locks)
    box = np.array([[*stretch, *load, lock] for (stretch, _, load), lock in limits])
    box[:, 0] += 1e-8 * (box[:, 1] - box[:, 0])
    march = _March(scene_batch, box, np.arange(len(scenes)))
    heading = np.tile([0.0, 0.0, 1.0], (len(scenes), 1))
    march.code[np.isnan(start.u[:, 0])] = int(Code.no_equilibrium)
    march.run(np.where(start.ok[:, None], start.u, np.nan), heading)
    march.go_on()
    most = max(int(march.count.max()), 2)
    lines = Polylines(march.points[:, :most], march.tangents[:, :most], march.count)
    began = np.flatnonzero(start.ok & (march.count > 0))
    lines.points[began, 0] = start.u[began] / SCALE  # the traced one lies on the coarse grid
    found = assemble(scene_batch, march.owner, lines, tolerance)
    last = lines.points[np.arange(len(scenes)), np.maximum(march.count - 1, 0), 0] * SCALE[0]
    march.code[(march.code == int(Code.beyond_tolerance)) & (last < locks)] = int(Code.apex_cone)
    arrays = ramps_on_lines(scene_batch, march.owner, found, start, march)
    ended = np.isin(march.code, (int(Code.breakdown), int(Code.apex_cone)))
    for key, own in by_membrane(scenes).items():
        alone = ~have_others(key.membrane, own, scene_batch, lines)
        _settle(scene_batch, key.membrane, own, arrays, ended[own], alone)
    ends = np.stack([lines.points[:, 0, 0] * SCALE[0], last], axis=1)
    at_landings = arrays.events[:, APEX, Slot.landings]
    own = np.repeat(np.arange(len(scenes)), 2)
    loads = scene_batch.limits(np.nan_to_num(at_landings, nan=2.0).ravel(), own)[0].reshape(at_landings.shape)
    ramps = ramps_of(lambda _: loads, arrays._replace(reach=ends))
    return Batch(ramps, march.code, found.lines.points * SCALE)


def _settle(
    scene_batch: SceneBatch,
    membrane: Membrane,
    own: np.ndarray,
    arrays: RampArrays,
    ended: np.ndarray,
    alone: np.ndarray,
) -> None:
    """Settles in place what the lines of scenes `own`, all of one `membrane`, leave open.

    A landing beyond breakdown may lie on any branch of the window. A landing below it decides only where the line is known
    to its end (`ended`) and no other branch lies below breakdown (`alone`).
    """
    outcome, snaps, events = arrays.outcome, arrays.snaps, arrays.events
    follows = (snaps[own] > 1) | ((snaps[own] == 1) & (outcome[own] == Outcome.breakdown_on_branch))
    open_ = follows & ~(ended & alone)
    landing = np.isin(outcome[own], (int(Outcome.no_landing), int(Outcome.breakdown_in_snap))) & ~open_
    ends = own[landing]
    if len(ends):
        last = snaps[ends]
        seen = events[ends, :, Slot.landings.start - 1 + last]
        folds = events[ends, :, last]
        found = landings(scene_batch, membrane, ends, folds, exact=False)
        # the line's own landing is exact; the scan only has to show the same
        with np.errstate(invalid="ignore"):
            same = (outcome[ends] == Outcome.breakdown_in_snap) & (
                np.abs(found.guess[:, 0] / seen[:, 0] - 1) < SAME_LANDING
            )
        same |= (outcome[ends] == Outcome.breakdown_in_snap) & (found.kind == Landing.unknown) & alone[landing]
        same |= found.kind == Landing.none
        rest = np.flatnonzero(~same)
        if len(rest):
            exact = landings(scene_batch, membrane, ends[rest], folds[rest], exact=True)
            outcome[ends[rest[exact.kind == Landing.broken]]] = Outcome.breakdown_in_snap
            events[ends[rest], :, Slot.landings.start - 1 + last[rest]] = exact.state
            lost = (exact.kind == Landing.unknown) | (exact.kind == Landing.unbroken)
            open_[np.flatnonzero(landing)[rest[lost]]] = True
        none = (found.kind == Landing.none) & (outcome[ends] == Outcome.breakdown_in_snap)
        open_[np.flatnonzero(landing)[none]] = True  # two ways that contradict each other
    breaks = own[(outcome[own] == Outcome.breakdown_on_branch) & (snaps[own] == 0)]
    breaks = breaks[arrays.ahead[breaks] == FoldAhead.unknown]
    if len(breaks):
        at = events[breaks, APEX, Slot.breakdown], events[breaks, LOAD, Slot.breakdown]
        arrays.ahead[breaks] = folds_ahead(membrane, pick(scene_batch.condition, breaks), *at)
    lanes = own[open_]
    events[lanes], snaps[lanes], outcome[lanes] = np.nan, 0, Outcome.unresolved
