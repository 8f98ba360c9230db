"""States by a user's own diffrax solver, step size controller and optimistix root finder, beside ours."""

import dataclasses

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from ..numerics import run_lanes
from .points import Points, Shooting
from .resolution import CHUNK, SCALE
from .shooting import UNKNOWNS, integrate_membrane

__all__ = ["ShootingMethod", "shooting_of"]


_RootFinder = optx.AbstractRootFinder | optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser


class ShootingMethod(eqx.Module):
    """How states are made exact: the integration from the apex to the rim, and the root finder of the rim condition.

    `solver` and `stepsize_controller` are those of diffrax, `dt0` the first step (of the interval from 0 to 1; None where the
    controller chooses it), `max_steps` a bound of their number; `root_finder` is what `optimistix.root_find` takes. The method
    gives λa, p, q and V; height, charge, index and the values along the membrane are those of the default at nearly the same
    state. The default of `equilibrium` and `voltage_volume` is not one of these methods: it uses fixed grids and deferred
    correction. Raises ValueError where an argument is of another kind.

    >>> method = ShootingMethod(solver=dfx.Tsit5(), stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-9))
    >>> type(method.root_finder).__name__
    'Newton'
    """

    solver: dfx.AbstractSolver = eqx.field(default_factory=dfx.Dopri8)
    stepsize_controller: dfx.AbstractStepSizeController = eqx.field(
        default_factory=lambda: dfx.PIDController(rtol=1e-10, atol=1e-10)
    )
    root_finder: _RootFinder = eqx.field(default_factory=lambda: optx.Newton(rtol=1e-9, atol=1e-9))
    dt0: float | None = None
    max_steps: int = 4096

    def __check_init__(self):
        for name, kind, words in (
            ("solver", dfx.AbstractSolver, "a solver of diffrax"),
            ("stepsize_controller", dfx.AbstractStepSizeController, "a step size controller of diffrax"),
            ("root_finder", _RootFinder, "a root finder, least-squares solver or minimiser of optimistix"),
        ):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"`{name}` must be {words}, but is {getattr(self, name)!r}.")
        if self.dt0 is None and isinstance(self.stepsize_controller, dfx.ConstantStepSize):
            raise ValueError("`dt0` must be given with a ConstantStepSize, but is None.")
        if not (isinstance(self.max_steps, int) and self.max_steps > 0):
            raise ValueError(f"`max_steps` must be a positive whole number, but is {self.max_steps!r}.")


@eqx.filter_jit
def _states_by_method(method: ShootingMethod, membrane, condition, lanes):
    """u (n, 3), V and success from lanes (n, 7): a start u, a row (NaN asks for a volume) and its target."""
    material = membrane.material

    def one(lane):
        row, target = lane[3:6], lane[6]
        by_volume = ~jnp.all(jnp.isfinite(row))
        row = jnp.where(by_volume, 0.0, row)

        @jax.custom_jvp
        def shot(u):
            found = integrate_membrane(material, u[0], u[1], u[2], 0.0, method=method)
            return found.stretch_change, found.volume

        @shot.defjvp
        def _(primals, tangents):  # a matrix, which root finders may transpose
            u, change = *primals, *tangents
            found = integrate_membrane(material, u[0], u[1], u[2], 0.0, method=method, sensitivities=UNKNOWNS)
            columns = jnp.stack([jnp.stack(found.sensitivities[c]) for c in UNKNOWNS])
            return (found.stretch_change, found.volume), tuple(change @ columns)

        def equations(x, _):
            u = x * SCALE
            stretch_change, volume = shot(u)
            rim = stretch_change - (membrane.prestretch - u[0])
            goal = jnp.where(by_volume, volume, row @ u) - target
            return jnp.stack([rim, condition.residual(u[1], volume, u[2]), goal])

        root = optx.root_find(equations, method.root_finder, lane[:3] / SCALE, throw=False)
        u = root.value * SCALE
        return u, shot(u)[1], root.result == optx.RESULTS.successful

    return jax.vmap(one)(lanes)


@dataclasses.dataclass(frozen=True)
class _ByMethod(Shooting):
    """The engine that makes states exact by a `ShootingMethod`, from ours; by how much the two differ is in the error."""

    method: ShootingMethod = dataclasses.field(default_factory=ShootingMethod)

    def corrected_points(self, u, rows, targets, **options) -> Points:
        """States near `u` on the loading's contour with rows·u = targets; see `points.corrected_points`."""
        points = super().corrected_points(u, rows, targets, **options)
        rows, targets = np.asarray(rows, float), np.asarray(targets, float)
        begin = np.where(points.ok, points.u, np.asarray(u, float))
        lanes = np.concatenate([begin.T, rows, targets[:, None]], axis=1)
        found, volume, solved = run_lanes(
            lambda part: _states_by_method(self.method, self.membrane, self.condition, part),
            lanes,
            sizes=CHUNK,
            axis=0,
            out_axis=0,
        )
        both = np.concatenate([points.u, points.volume[None]]), np.concatenate([found.T, volume[None]])
        with np.errstate(invalid="ignore"):
            apart = np.max(np.abs(both[1] - both[0]) / np.maximum(np.abs(both[0]), 1e-3), axis=0)
        return dataclasses.replace(
            points,
            u=found.T.copy(),
            volume=volume,
            error=np.where(np.isfinite(apart), np.maximum(points.error, apart), np.inf),
            ok=points.ok & solved & np.isfinite(apart),
        )


def shooting_of(membrane, condition, method: ShootingMethod | None = None) -> Shooting:
    """The engine that makes states exact by shooting: ours, or a user's method."""
    if method is None:
        return Shooting(membrane, condition)
    if not isinstance(method, ShootingMethod):
        raise ValueError(f"`method` must be a ShootingMethod, but is {method!r}.")
    return _ByMethod(membrane, condition, method)
