"""Critical points of a ramp as differentiable functions of every continuous parameter of its scene.

A search on the host finds the point (`searches`), and the implicit function theorem gives its derivatives (`point_systems`): jvp,
grad, jacobian, hessian and vmap work, also under jit. Outside transformations a point that does not exist raises `SceneError`;
inside, or with `throw=False`, its numbers are NaN and its `code` says why.
"""

import math
import typing
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..diagram import MembraneKey, filling
from ..model import (
    Chamber,
    ConstantPressure,
    ConstantVoltage,
    PointKind,
    Scene,
    difficulty,
    field_ratio_squared,
    is_concrete,
    largest_load,
    locking_stretch,
    other_loading,
)
from ..numerics import Code, SceneError
from ..surface import Surface
from .host_scenes import Scenes
from .point_systems import Conditions, Solution, attach, attach_free
from .resolution import STEPS, TOLERANCE
from .rim import AbstractRim, ShotRim, SurfaceRim
from .searches import first_folds, first_folds_on_surface, guarded, ramp_events

__all__ = [
    "CriticalPoint",
    "area_strain",
    "breakdown_point",
    "breakdown_voltage",
    "landing_point",
    "snap_back_point",
    "snap_back_voltage",
    "snap_point",
    "snap_voltage",
]


class CriticalPoint(eqx.Module):
    """A critical point, dimensionless; NaN if there is none, and then `code`, an integer of `Code`, says why.

    `error_estimate` comes from the search: the error of the located quantity, or of p, V and q. `parameter` is the critical
    value of the parameter at a cusp or at the onset of bistability.
    """

    apex_stretch: Float[Array, ""]
    pressure: Float[Array, ""]
    voltage_squared: Float[Array, ""]
    volume: Float[Array, ""]
    breakdown_ratio: Float[Array, ""]
    error_estimate: Float[Array, ""]
    code: Int[Array, ""]
    parameter: typing.Any = math.nan

    @property
    def voltage(self):
        """Φ = √q; NaN where q < 0."""
        return _root(self.voltage_squared)

    @property
    def sentence(self) -> str:
        """What the code says."""
        return Code(int(self.code)).sentence


def _root(q):
    """√q, with a defined derivative also where the value is set to 0 or NaN."""
    positive = q > 0
    root = jnp.sqrt(jnp.where(positive, q, 1.0))
    return jnp.where(positive, root, jnp.where(q == 0, 0.0, jnp.nan))


def _host(names: tuple, tree, shapes: list, surface: Surface | None, one: Callable | None):
    """The search as a function of the leaves of scenes, which have the given shapes after common batch axes: (…, names, 8).

    Rows hold λa, p, q, V, error, code, the number of steps of a shot that resolves the state, and a free parameter. `one`
    searches a single scene; without it the events of ramps are searched for.
    """

    def search(*leaves):
        scenes, shape = Scenes.of(tree, shapes, leaves)
        out = np.full((len(scenes), len(names), 8), np.nan)
        out[..., 6] = STEPS[0]
        out[..., 5] = scenes.admissible(surface)[:, None]
        good = np.flatnonzero(out[:, 0, 5] == int(Code.ok))
        if len(good):
            scenes = scenes[good]
            table: dict = {}
            if one is not None:
                for i, scene in zip(good, scenes, strict=True):
                    out[i][:, [0, 1, 2, 3, 4, 5, 7]] = guarded(one, scene, len(names), 7)
            elif not set(names) <= {"start", "snap"}:
                table = ramp_events(scenes, surface)
            else:
                table = first_folds(scenes) if surface is None else first_folds_on_surface(scenes, surface)
            for k, name in enumerate(names) if one is None else ():
                out[good, k, :6] = table[name]
            out[good, :, 6] = _steps(scenes, out[good], surface)
        return out.reshape((*shape, len(names), 8))

    return search


def _steps(scenes: Scenes, found, surface: Surface | None) -> np.ndarray:
    """The number of steps that resolves each state (scenes, names)."""
    groups: dict = {}
    membranes = [surface.membrane] if surface is not None else [scene.membrane for scene in scenes]
    for i, membrane in enumerate(membranes):
        groups.setdefault(MembraneKey.of(membrane), []).append(i)
    steps = np.empty(found.shape[:2])
    for key, own in groups.items():
        own = slice(None) if surface is not None else own
        apex, q = np.nan_to_num(found[own, :, 0], nan=2.0), np.nan_to_num(found[own, :, 2])
        fraction = q / largest_load(key.membrane.material, apex.ravel()).reshape(apex.shape)
        steps[own] = STEPS[difficulty(locking_stretch(key.membrane), apex, fraction)]
    return steps


class Found(typing.NamedTuple):
    """The result of a search for one event: its state, the error and code, and the steps that resolve it."""

    state: Solution
    error: typing.Any
    code: typing.Any
    steps: typing.Any


def check(scene: Scene, surface) -> None:
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    if isinstance(scene.loading, ConstantVoltage) or not isinstance(scene.loading, (Chamber, ConstantPressure)):
        raise other_loading(scene.loading, Chamber, ConstantPressure)
    if surface is not None and not isinstance(surface, Surface):
        raise ValueError(f"`surface` must be a Surface, but is a {type(surface).__name__}.")


def _inside(tree) -> bool:
    """Whether a value is traced by a transformation."""
    return not all(is_concrete(leaf) for leaf in jax.tree.leaves(tree))


def find(names: tuple, scene: Scene, surface: Surface | None, one: Callable | None = None) -> dict[str, Found]:
    """The named points of a scene, as numbers without derivatives; see `_host`."""
    leaves, tree = jax.tree.flatten(scene)
    leaves = [jax.lax.stop_gradient(leaf) if not is_concrete(leaf) else leaf for leaf in leaves]
    search = _host(names, tree, [np.shape(leaf) for leaf in leaves], surface, one)
    if _inside(leaves):
        shape = jax.ShapeDtypeStruct((len(names), 8), jnp.result_type(float))
        table = jax.pure_callback(search, shape, *leaves, vmap_method="broadcast_all")
    else:
        table = search(*leaves)
    found = {}
    for k, name in enumerate(names):
        apex, p, q, volume, error, code, steps, free = (jnp.asarray(table[k, i]) for i in range(8))
        found[name] = Found(Solution(apex, p, q, volume, free), error, code.astype(int), steps)
    return found


def engine_of(surface: Surface | None, steps) -> AbstractRim:
    return ShotRim(steps) if surface is None else SurfaceRim(surface, steps)


def start_of(scene: Scene, found: Found, surface) -> tuple[Solution, Conditions]:
    """The state at zero voltage, and the loading conditions with the filling of a chamber."""
    loading = scene.loading
    if isinstance(loading, ConstantPressure):
        kind, target = PointKind.pressure, loading.pressure
    else:
        assert isinstance(loading, Chamber)
        by_volume = loading.initial_volume is not None
        kind, target = (
            (PointKind.volume, loading.initial_volume) if by_volume else (PointKind.pressure, loading.initial_pressure)
        )
    held = Conditions(scene.membrane, ConstantVoltage(0.0).condition(), target)
    state = attach(found.state, held, kind, engine_of(surface, found.steps))
    if isinstance(loading, ConstantPressure):
        return state, Conditions(scene.membrane, loading.condition())
    filled = (state.pressure, target) if kind == PointKind.volume else (target, state.volume)
    return state, Conditions(scene.membrane, loading.condition(*filled))


def raise_if_none(scene: Scene, found: Found, throw: bool) -> None:
    """Raises the error of a point that does not exist, outside transformations."""
    if not throw or _inside((scene, found.code)):
        return
    code = Code(int(found.code))
    if code is not Code.ok:
        if code is Code.no_equilibrium:
            filling(scene, TOLERANCE)  # raises a more specific error about the filling
        raise SceneError(code)


def point_of(scene: Scene, found: Found, state: Solution, throw: bool) -> CriticalPoint:
    raise_if_none(scene, found, throw)
    ok = found.code == int(Code.ok)
    apex, p, q, volume = (jnp.where(ok, v, jnp.nan) for v in state[:4])
    ratio = _root(q * field_ratio_squared(scene.membrane.breakdown, apex, apex))
    numbers = apex, p, q, volume, ratio, jnp.where(ok, found.error, jnp.nan), found.code
    return CriticalPoint(*numbers, parameter=jnp.where(ok, state.free, jnp.nan))


def _fold(scene: Scene, name: str, surface, throw: bool) -> CriticalPoint:
    check(scene, surface)
    found = find(("start", name), scene, surface)
    _, theta = start_of(scene, found["start"], surface)
    of = found[name]
    engine = engine_of(surface, of.steps)
    state = attach(of.state, theta, PointKind.fold, engine)
    # the load from first derivatives alone
    state = state._replace(voltage_squared=attach_free(of.state.voltage_squared, of.state, theta, engine))
    return point_of(scene, of, state, throw)


def _fold_voltage(scene: Scene, name: str, surface):
    check(scene, surface)
    found = find(("start", name), scene, surface)
    of = found[name]
    raise_if_none(scene, of, True)
    _, theta = start_of(scene, found["start"], surface)
    load = attach_free(of.state.voltage_squared, of.state, theta, engine_of(surface, of.steps))
    return _root(jnp.where(of.code == int(Code.ok), load, jnp.nan))


def snap_voltage(scene: Scene, *, surface: Surface | None = None):
    """The voltage of the first fold of the stable branch on the ramp up, also past breakdown; in V on a scene with units.

    Its derivative dq/dθ = −(ψ·F_θ)/(ψ·F_q), with ψ the left null vector of the equations' Jacobian at the fold, needs first
    derivatives only. A `surface` of the scene's membrane makes batches fast. Raises SceneError if there is no fold; inside
    transformations the result is NaN instead.

    >>> import jax
    >>> from dielectric_jax import Chamber, Membrane
    >>> scene = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))
    >>> round(float(snap_voltage(scene)), 10)
    0.0764953595
    >>> slope = jax.grad(lambda vc: snap_voltage(scene.replace(chamber_volume=vc)))(1600.0)
    >>> round(1e5 * float(slope), 6)
    -1.27029
    """
    value = _fold_voltage(scene, "snap", surface)
    return scene.in_units(value, "voltage")


def snap_point(scene: Scene, *, surface: Surface | None = None, throw: bool = True) -> CriticalPoint:
    """The fold of `snap_voltage` as a state; its derivatives need second derivatives of the shot."""
    return _fold(scene, "snap", surface, throw)


def snap_back_voltage(scene: Scene, *, surface: Surface | None = None):
    """The voltage of the first fold on the ramp down from the last landing; otherwise like `snap_voltage`."""
    value = _fold_voltage(scene, "snap_back", surface)
    return scene.in_units(value, "voltage")


def snap_back_point(scene: Scene, *, surface: Surface | None = None, throw: bool = True) -> CriticalPoint:
    """The fold of `snap_back_voltage` as a state."""
    return _fold(scene, "snap_back", surface, throw)


def landing_point(scene: Scene, *, surface: Surface | None = None, throw: bool = True) -> CriticalPoint:
    """The state on which the first snap of the ramp up lands: stable, at the voltage of the snap.

    Its load changes with that of the snap. The state jumps where another state becomes the nearest stable one.
    """
    check(scene, surface)
    found = find(("start", "snap", "landing"), scene, surface)
    _, theta = start_of(scene, found["start"], surface)
    state = _landing(theta, found, surface)
    return point_of(scene, found["landing"], state, throw)


def _landing(theta: Conditions, found, surface) -> Solution:
    snap, landing = found["snap"], found["landing"]
    load = attach_free(snap.state.voltage_squared, snap.state, theta, engine_of(surface, snap.steps))
    at = eqx.tree_at(lambda c: c.target, theta, load)
    return attach(landing.state, at, PointKind.load, engine_of(surface, landing.steps))


def _select(choice, one: Solution, other: Solution) -> Solution:
    return Solution(*(jnp.where(choice, a, b) for a, b in zip(one, other, strict=True)))


def _breakdown(theta: Conditions, found, surface) -> Solution:
    """The state at breakdown, on the branch or in the snap.

    The case that is not selected uses the other's state, so that its matrices are finite and the reverse pass does not
    multiply NaN by 0.
    """
    broken = found["breakdown"]
    in_snap = _in_snap(found)
    engine = engine_of(surface, broken.steps)
    on_branch = attach(broken.state, theta, PointKind.breakdown, engine)
    snap = found["snap"]._replace(state=_select(in_snap, found["snap"].state, broken.state))
    landed = _landing(theta, {"snap": snap, "landing": broken}, surface)
    return _select(in_snap, landed, on_branch)


def _in_snap(found):
    """Whether the landing lies beyond breakdown, so that the membrane breaks down in the snap."""
    one, other = found["landing"], found["breakdown"]
    return (one.code == int(Code.ok)) & (one.state.apex_stretch == other.state.apex_stretch)


def breakdown_point(scene: Scene, *, surface: Surface | None = None, throw: bool = True) -> CriticalPoint:
    """The state at which the ramp up breaks down: on the branch, where E/E_EB = 1, or where a snap lands beyond."""
    check(scene, surface)
    found = find(("start", "snap", "landing", "breakdown"), scene, surface)
    _, theta = start_of(scene, found["start"], surface)
    return point_of(scene, found["breakdown"], _breakdown(theta, found, surface), throw)


def breakdown_voltage(scene: Scene, *, surface: Surface | None = None):
    """The voltage at which the ramp up breaks down, in V on a scene with units; see `breakdown_point`."""
    point = breakdown_point(scene, surface=surface)
    return scene.in_units(point.voltage, "voltage")


def area_strain(scene: Scene, *, surface: Surface | None = None):
    """(λa at breakdown / λa at the start of the ramp up)² − 1; with breakdown in the snap, or no landing, λa at the snap.

    If the ramp ends at the window's edge, the strain would be a property of the window, not of the membrane: raises
    SceneError, or gives NaN inside transformations. The diagram reports that strain.
    """
    check(scene, surface)
    found = find(("start", "snap", "landing", "breakdown"), scene, surface)
    start, theta = start_of(scene, found["start"], surface)
    broken, snap = found["breakdown"], found["snap"]
    lost = broken.code == int(Code.no_landing)
    held = _in_snap(found) | lost
    of = broken._replace(code=jnp.where(lost, snap.code, broken.code))
    raise_if_none(scene, of, True)
    # each system uses a state that exists, see `_breakdown`
    at_fold = _select(held, snap.state, broken.state)
    at_end = _select(held, snap.state, broken.state)
    engine = engine_of(surface, jnp.where(held, snap.steps, broken.steps))
    folded = attach(at_fold, theta, PointKind.fold, engine)
    ended = attach(at_end, theta, PointKind.breakdown, engine)
    apex = jnp.where(held, folded.apex_stretch, ended.apex_stretch)
    return jnp.where(of.code == int(Code.ok), (apex / start.apex_stretch) ** 2 - 1, jnp.nan)
