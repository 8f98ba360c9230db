"""The searches for critical points, run on the host for many scenes at once; a code says why a point does not exist.

Nothing here is differentiated: the points are exact already, and `point_systems` adds their derivatives. A scene is represented by
the leaves of its pytree, so that a transformed function passes a batch of scenes in one call to the host.
"""

import typing

import jax
import jax.numpy as jnp
import numpy as np

from ..diagram import (
    Ramps,
    TraceGrid,
    branch_problem,
    chamber_ramps,
    condition_of,
    continue_scenes,
    equilibrium,
    first_folds_on,
    loading_arrays,
    pressure_ramps,
    stacked,
    starts,
    voltage_volume,
)
from ..model import (
    SCALE,
    Chamber,
    ConstantVoltage,
    Corrected,
    Membrane,
    Outcome,
    PointKind,
    Scene,
    SceneBatch,
    State,
    locking_stretch,
)
from ..numerics import Code, SceneError, advance, begin, cached_jit
from ..surface import Surface
from .host_scenes import Scenes
from .point_systems import Conditions, correction
from .resolution import CLIMB_GRIDS, CLIMB_STEPS, HIDDEN_FOLDS, MANY, STEPS, TOLERANCE
from .rim import ShotRim, jets

__all__ = ["EVENTS", "filling_state", "first_folds", "first_folds_on_surface", "ramp_events"]

#: the events that a search returns, each as λa, p, q, V, error, code
EVENTS = ("start", "snap", "landing", "breakdown", "snap_back", "landing_back", "rest")


@cached_jit
def _climb_program(membrane, condition, limits, seed, grid: TraceGrid):
    """The branch from a state at zero voltage until q no longer rises: the last two points, their tangents, and the reason.

    The last number is the smallest rate at which q rose on any earlier interval, from the slopes at its ends.
    """
    problem = branch_problem(membrane.material, membrane.prestretch, condition, limits, grid, CLIMB_STEPS)
    walk = begin(problem, seed, jnp.array([0.0, 0.0, 1.0]))
    shares = jnp.linspace(0.0, 1.0, 9)[1:-1]

    def slowest(x0, x1, t0, t1):
        gap = jnp.linalg.norm(x1 - x0)
        rise, s = (x1[2] - x0[2]) / gap, shares
        slope = t0[2] * (1 - 4 * s + 3 * s**2) + t1[2] * (3 * s**2 - 2 * s) + 6 * rise * s * (1 - s)
        return jnp.min(slope) / (jnp.abs(t0[2]) + jnp.abs(t1[2]))

    def going(state):
        walk, _, passed, _ = state
        return (walk.code == int(Code.ok)) & ~passed

    def step(state):
        walk, before, _, least = state
        new, accept = advance(problem, walk)
        accept &= walk.count > 0
        passed = accept & (new.tangent[2] <= 0)
        here = walk.base, walk.tangent
        before = jax.tree.map(lambda a, b: jnp.where(accept, a, b), here, before)
        rising = accept & ~passed
        found = slowest(walk.base, new.base, walk.tangent, new.tangent)
        return new, before, passed, jnp.where(rising, jnp.minimum(least, found), least)

    first = walk, (walk.base, walk.tangent), jnp.asarray(False), jnp.asarray(1.0)
    walk, before, passed, least = jax.lax.while_loop(going, step, first)
    return before, (walk.base, walk.tangent), passed, walk.code, least


def _turn(before, after):
    """Point, unit tangent and d(dq)/ds where the cubic through two points and tangents turns in q; scaled unknowns."""
    (x0, t0), (x1, t1) = before, after
    gap = np.linalg.norm(x1 - x0)
    # derivative by the fraction s: quadratic a + b s + c s²
    a, chord = t0 * gap, x1 - x0
    b, c = 6 * chord - (4 * t0 + 2 * t1) * gap, (3 * t0 + 3 * t1) * gap - 6 * chord
    roots = np.roots([c[2], b[2], a[2]])
    roots = roots[np.isreal(roots) & (roots.real >= 0) & (roots.real <= 1)].real
    s = float(roots[0]) if len(roots) else float(t0[2] / (t0[2] - t1[2]))
    rate = a + b * s + c * s**2
    size = np.linalg.norm(rate)
    return x0 + a * s + b * s**2 / 2 + c * s**3 / 3, rate / size, (b + 2 * c * s)[2] / size**2


def _on_finer_grid(membrane, condition, u, volume, way, slope: float):
    """A fold moved along its branch to where q turns according to the tangent on a finer grid.

    `slope` is d(dq)/ds along the unit tangent `way`, in scaled unknowns.
    """
    (_, slopes), _ = jets(ShotRim(np.asarray(STEPS[0])), membrane, u, 0, ())
    slopes = np.array(slopes)
    by_p, by_v, by_q = (float(v) for v in condition.slopes(volume))
    rows = np.stack([slopes[0] + [1.0, 0.0, 0.0], by_v * slopes[1] + [0.0, by_p, by_q]]) * SCALE
    tangent = np.cross(*rows) / np.linalg.norm(np.cross(*rows))
    tangent *= np.sign(tangent @ way)
    move = -tangent[2] / slope * tangent * SCALE
    move = np.where(np.abs(move).max() < 1e-4, move, 0.0)  # otherwise the search and this grid refer to different folds
    return u + move, volume + slopes[1] @ move


def _box(scene: Scene) -> np.ndarray:
    (low, high), _, load = scene.limits()
    return np.array([low + 1e-8 * (high - low), high, *load, locking_stretch(scene.membrane)])


def _point(u, volume, error) -> np.ndarray:
    return np.array([u[0], u[1], u[2], volume, error, float(Code.ok)])


def _no(code: Code) -> np.ndarray:
    return np.array([np.nan] * 5 + [float(code)])


def _start(scene: Scene) -> Corrected:
    """The state of smallest volume at zero voltage, in arrays of one."""
    nothing = stacked([ConstantVoltage(0.0).condition()])
    return starts([scene], _batch_of_one(scene.membrane, nothing), TOLERANCE)


def _batch_of_one(membrane: Membrane, condition) -> SceneBatch:
    return SceneBatch(stacked([membrane]), condition, np.array([locking_stretch(membrane)]), sizes=(1,))


def filling_state(scene: Scene) -> list[np.ndarray]:
    """The state that fills a chamber at zero voltage, a row (1, 7), whatever the ramp from it meets."""
    start, loading = _start(scene), typing.cast(Chamber, scene.loading)
    if start.ok[0]:
        row = _point(start.u[0], start.volume[0], start.error[0])
    else:  # near the peak of the pressure
        name = "volume" if loading.initial_volume is not None else "pressure"
        held = {name: float(getattr(loading, f"initial_{name}"))}
        row = _of_state(equilibrium(scene.membrane, voltage=0.0, tolerance=TOLERANCE, **held))  # pyright: ignore[reportArgumentType]
    return [np.append(row, np.nan)]


def _first_fold(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The start of one scene, and the first fold of q on the stable branch from it."""
    start = _start(scene)
    if not start.ok[0]:
        return _by_diagram(scene)
    at = _point(start.u[0], start.volume[0], start.error[0])
    if start.index[0] != 0:
        return at, _no(Code.start_unstable)
    condition = condition_of(scene, start.u[0, 1], start.volume[0])
    scene_batch = _batch_of_one(scene.membrane, stacked([condition]))
    limits, lengths = _box(scene), np.array([CLIMB_STEPS.smallest, CLIMB_STEPS.largest, CLIMB_STEPS.largest])
    for accuracy, top in CLIMB_GRIDS:
        grid = TraceGrid(accuracy, np.array(top), lengths)
        climbed = _climb_program(scene.membrane, condition, limits, start.u[0], grid)
        before, after, passed, code, least = jax.tree.map(np.asarray, climbed)
        if passed and least > HIDDEN_FOLDS:
            place, tangent, slope = _turn(before, after)
            found = scene_batch.correct_folds(
                np.zeros(1, int),
                (place * SCALE)[None],
                tangent[None],
                np.array([slope]),
                tolerance=TOLERANCE,
                reach=0.3,
            )
            if found.ok[0]:
                u, volume = _on_finer_grid(scene.membrane, condition, found.u[0], found.volume[0], tangent, slope)
                return at, _point(u, volume, found.error[0])
        if least <= HIDDEN_FOLDS:
            break
        if Code(int(code)) in (Code.window_stretch, Code.window_load, Code.lock_up):
            return at, _no(Code.no_fold)
    return _by_diagram(scene)


def first_folds(scenes: Scenes) -> dict[str, np.ndarray]:
    """Starts and first folds of the ramp up, also past breakdown, of many scenes: arrays (scenes, 6)."""
    table = {name: np.tile(_no(Code.not_converged), (len(scenes), 1)) for name in ("start", "snap")}
    todo = range(len(scenes))
    if len(scenes) >= MANY:
        events = ramp_events(scenes, None, alone=False)
        for name in table:
            table[name][:] = events[name]
        todo = np.flatnonzero(~np.isfinite(table["snap"][:, 0]) & (table["snap"][:, 5] != int(Code.start_unstable)))
    for i in todo:
        table["start"][i], table["snap"][i] = guarded(_first_fold, scenes[i])
    return table


def guarded(search, scene: Scene, rows: int = 2, width: int = 6):
    """A search for rows of numbers whose errors become codes, so that a failing scene does not affect the others."""
    try:
        return search(scene)
    except SceneError as error:
        code = error.code
    except ValueError:
        code = Code.no_equilibrium
    return [np.pad(_no(code), (0, width - 6), constant_values=np.nan)] * rows


def _of_state(state: State) -> np.ndarray:
    u = state.apex_stretch, state.pressure, state.voltage_squared
    return _point(u, state.volume, state.error_estimate)


def _diagram_events(scene: Scene, surface: Surface | None) -> dict[str, np.ndarray]:
    """The events of one scene from its diagram."""
    diagram = voltage_volume(scene, surface=surface, tolerance=TOLERANCE)
    if float(diagram.branches[0].pressure.max()) == 0:
        raise SceneError(Code.flat_film)
    up, down = diagram._up, diagram._down
    assert up is not None
    table = {name: _no(Code.not_converged) for name in EVENTS}
    if not up.events:
        return table
    table["start"] = _of_state(up.events[0].state)
    unstable = up.area_strain_reason == "start_unstable"
    missing = {
        "snap": Code.no_fold,
        "landing": Code.no_landing if up["snap"] else Code.no_fold,
        "breakdown": Code.no_landing if up["no_landing"] else Code.no_breakdown,
        "snap_back": Code.no_snap_back,
        "landing_back": Code.no_snap_back,
        "rest": Code.no_zero_voltage_state,
    }
    for name, code in missing.items():
        table[name] = _no(Code.start_unstable if unstable else code)
    for name in ("snap", "landing", "breakdown"):
        if up[name]:
            table[name] = _of_state(up[name][0].state)
    if not up["snap"] and not unstable:
        # the branch may still fold past breakdown
        position = next(
            p for p in diagram.special_points if p.kind == PointKind.zero_voltage and _same(p, table["start"])
        )
        ahead = [p for p in diagram.special_points if p.kind == PointKind.fold and p.branch == position.branch]
        rising = _rising(diagram.branches[position.branch], position)
        ahead = [p for p in ahead if (p.position - position.position) * rising > 0]
        if ahead:
            table["snap"] = _of_state(min(ahead, key=lambda p: abs(p.position - position.position)))
    if down is not None:
        if down["snap_back"]:
            table["snap_back"] = _of_state(down["snap_back"][0].state)
        if down["landing"]:
            table["landing_back"] = _of_state(down["landing"][0].state)
        if down.events[-1].reason == "zero voltage":
            table["rest"] = _of_state(down.events[-1].state)
    return table


def _same(state: State, row: np.ndarray) -> bool:
    return abs(state.apex_stretch / row[0] - 1) < 1e-7


def _rising(branch, at) -> float:
    """The direction of arclength in which q rises from a state at zero voltage."""
    i = int(np.argmin(np.abs(branch.apex_stretch - at.apex_stretch) + np.abs(branch.voltage_squared)))
    q = branch.voltage_squared
    j = min(i + 1, len(q) - 1)
    return 1.0 if q[j] > q[max(j - 2, 0)] else -1.0


def _by_diagram(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The start of one scene and its first fold, by its diagram."""
    table = _diagram_events(scene, None)
    return table["start"], table["snap"]


_COLUMNS = {"start": None, "snap": 0, "landing": 0, "breakdown": None, "snap_back": 0, "landing_back": 0, "rest": None}


def _table_of(ramps: Ramps) -> dict[str, np.ndarray]:
    """The events of ramps, with codes for missing ones."""
    outcome = np.asarray(ramps.outcome)
    table = {}
    for name, column in _COLUMNS.items():
        values = [v if column is None else v[..., column] for v in getattr(ramps, name)]
        table[name] = np.stack([*values, np.zeros_like(values[0])], axis=-1)
    broken = outcome == Outcome.breakdown_in_snap
    # with breakdown in the snap it happens at the landing
    table["breakdown"][broken] = table["landing"][broken]
    unstable = outcome == Outcome.start_unstable
    missing = {"snap": Code.no_fold, "landing": Code.no_fold, "breakdown": Code.no_breakdown}
    missing |= {"snap_back": Code.no_snap_back, "landing_back": Code.no_snap_back, "rest": Code.no_zero_voltage_state}
    for name, values in table.items():
        none = ~np.isfinite(values[..., 0])
        values[none, :5] = np.nan
        values[none, 5] = int(missing.get(name, Code.not_converged))
        values[none & unstable, 5] = int(Code.start_unstable)
    for name in ("landing", "breakdown"):
        table[name][outcome == Outcome.no_landing, 5] = int(Code.no_landing)
    return table


def first_folds_on_surface(scenes: Scenes, surface: Surface) -> dict[str, np.ndarray]:
    """`first_folds` of scenes of one membrane on its surface; shooting decides where the surface cannot."""
    found = first_folds_on(surface, loading_arrays(scenes.stacked().loading, surface))
    code = np.full((*found.shape[:-1], 1), float(Code.ok))
    found = np.concatenate([found, code], axis=-1)
    unknown = np.flatnonzero(~np.isfinite(found[:, 1, 0]))
    table = {"start": found[:, 0], "snap": found[:, 1]}
    if len(unknown):
        rest = first_folds(scenes[unknown])
        for name in table:
            table[name][unknown] = rest[name]
    return table


def _settled_fold(scene: Scene, start: np.ndarray, fold: np.ndarray) -> np.ndarray:
    """A fold whose load is already accurate, moved to its exact state."""
    condition = condition_of(scene, float(start[1]), float(start[3]))
    theta = Conditions(scene.membrane, condition, np.asarray(0.0))
    engine = ShotRim(np.asarray(STEPS[0]))
    _, move, _ = correction(PointKind.fold, engine, fold[:3], theta)
    move = np.asarray(move)
    if not np.abs(move / SCALE).max() < 1e-3:  # its grid is too coarse for this state
        return fold
    ((_, volume), *_), _ = jets(engine, scene.membrane, fold[:3] + move, 0, ())
    # the load is that of the search, which used the finer grid
    return np.array([fold[0] + move[0], fold[1] + move[1], fold[2], float(volume), *fold[4:]])


def ramp_events(scenes: Scenes, surface: Surface | None = None, *, alone: bool = True) -> dict[str, np.ndarray]:
    """All events of many scenes' ramps, a dictionary of arrays (scenes, 6).

    With `alone`, scenes that neither batch nor surface decides are decided by their own diagrams.
    """
    if surface is None:
        ramps = continue_scenes(list(scenes)).ramps
    else:
        given = loading_arrays(scenes.stacked().loading, surface)
        ramps = pressure_ramps(surface, **given) if "pressure" in given else chamber_ramps(surface, **given)
    table = _table_of(ramps)
    unknown = ramps.outcome == Outcome.unresolved
    # the surface determines that there is a landing, but not where
    unknown |= (ramps.outcome == Outcome.breakdown_in_snap) & ~np.isfinite(table["landing"][:, 0])
    for i in np.flatnonzero(unknown) if alone else ():
        try:
            events: dict[str, typing.Any] = _diagram_events(scenes[i], surface)
        except SceneError as error:
            events = dict.fromkeys(EVENTS, _no(error.code))
        except ValueError:
            events = dict.fromkeys(EVENTS, _no(Code.no_equilibrium))
        for name in EVENTS:
            table[name][i] = events[name]
    for name in ("snap", "snap_back") if surface is None and alone else ():
        for i in np.flatnonzero(table[name][:, 5] == int(Code.ok)):
            if table["start"][i, 5] == int(Code.ok):
                table[name][i] = _settled_fold(scenes[i], table["start"][i], table[name][i])
    return table
