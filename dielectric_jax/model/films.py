"""Homogeneous films in time: one state of stretch everywhere, with the dashpots of a viscoelastic material.

With u = (ln λ1, ln λ2), the logarithms x_k of the dashpots' stretches, the load q = Φ² and T_i = λ_i ∂w/∂λ_i, the true stresses are

    T(u, x, q) = T_eq(u, q) + Σ g_k T_k(u − x_k),        dx_k/dt = F T_k(u − x_k)/τ_k,        F = (1, −½; −½, 1)/3.

Two equations R(t, u, x) = 0 hold at every instant. One is what is prescribed: the stretch λ1, a dead load s, T_1 = s λ1, or the
pressure p of a spherical balloon, T_1 = p λ³/2. The other is the mode: λ2 = λ1, T_2 = 0, or λ2 = 1. Differentiated they are
∂R/∂u u' = −(∂R/∂x x' + ∂R/∂t). The determinant S of ∂R/∂u is the instantaneous stiffness: where it vanishes the film pulls in.
With N = −adj(∂R/∂u) (∂R/∂x x' + ∂R/∂t), and σ the length along the path,

    dt/dσ = S/D,    du/dσ = N/D,    dx/dσ = x' S/D,        D² = S² + κ² |N|²,

which is smooth at a pull-in, where dt/dσ = 0 (`pass_film`). Up to it the states at given times are integrated in t (`film_states`).
"""

import typing
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from .materials import AbstractMaterial, capacitance
from .resolution import MOST_FILM_STEPS
from .viscoelastic import FLOW, Maxwell, spring_and_branches

__all__ = ["FILM_MODES", "Film", "FilmState", "Passed", "Sampled", "film_of", "film_states", "pass_film"]


class Mode(typing.NamedTuple):
    """A mode of deformation: ln λ2 = `ratio` ln λ1 where `held` is 1, no transverse stress T_2 where it is 0.

    Without a voltage an isotropic film in uniaxial tension is as thin as it is narrow, so that its ratio is known too.
    """

    ratio: float
    held: float


FILM_MODES = {"equal_biaxial": Mode(1.0, 1.0), "uniaxial": Mode(-0.5, 0.0), "pure_shear": Mode(0.0, 1.0)}


class Sampled(eqx.Module):
    """A course in time through samples (n,), linear between them and constant beyond."""

    time: jax.Array
    value: jax.Array

    def __call__(self, moment):
        return jnp.interp(moment, self.time, self.value)


class FilmState(typing.NamedTuple):
    """A state: `time`, `logs` (…, 2) of the stretches, and `x` (…, K, 2) of the stretches of the dashpots."""

    time: typing.Any
    logs: typing.Any
    x: typing.Any


class Reach(typing.NamedTuple):
    """The true stress T_1 = `share` λ1^`power` that a load of 1 holds: 1 and 1 of a dead load, ½ and 3 of a balloon's pressure."""

    share: typing.Any
    power: typing.Any

    def __call__(self, logs):
        return self.share * jnp.exp(self.power * logs[0])


class Film(eqx.Module):
    """A film, its mode of deformation, and the courses of what is prescribed and of the voltage.

    Prescribed is the stretch λ1, or with a `reach` a load. `voltage` None is no voltage at all. Where not `flows` the dashpots stay
    where they are; where `explicit` the stretches are functions of time alone.
    """

    spring: AbstractMaterial
    branches: tuple[Maxwell, ...]
    course: Callable
    voltage: Callable | None
    reach: "Reach | None"
    mode: Mode
    flows: bool = eqx.field(static=True)
    explicit: bool = eqx.field(static=True)

    def load(self, time):
        """q = Φ²."""
        return 0.0 if self.voltage is None else self.voltage(time) ** 2

    def given_logs(self, time):
        """ln λ of a film whose stretches are functions of time alone, (2,)."""
        return jnp.log(self.course(time)) * jnp.stack([1.0, self.mode.ratio])

    def stress(self, time, logs, x):
        """The true stresses T (2,) at the voltage of that time."""
        return self._stress(time, logs, x)[0]

    def flow(self, logs, x):
        """dx/dt (K, 2)."""
        if not self.flows:
            return jnp.zeros((len(self.branches), 2))
        springs = [jax.grad(_energy(b.material))(logs - y) for b, y in zip(self.branches, x, strict=True)]
        rates = [jnp.asarray(FLOW) @ t / b.relaxation_time for b, t in zip(self.branches, springs, strict=True)]
        return jnp.stack(rates) if rates else jnp.zeros((0, 2))

    def stiffness(self, time, logs, x):
        """S = det ∂R/∂u, positive where the film is stable at frozen dashpots."""
        (a, b), (c, d) = self._rows(time, logs, self._stress(time, logs, x)[1])
        return a * d - b * c

    def rates(self, time, logs, x):
        """S, N (2,), and dx/dt (K, 2)."""
        _, tangent, moved, flow = self._stress(time, logs, x)
        (a, b), (c, d) = self._rows(time, logs, tangent)
        value_rate = jax.jvp(self.course, (time,), (jnp.ones_like(time),))[1]
        first = -value_rate / self.course(time)
        if self.reach is not None:
            first = moved[0] - value_rate * self.reach(logs)
        second = (1 - self.mode.held) * moved[1]
        return a * d - b * c, jnp.stack([b * second - d * first, c * first - a * second]), flow

    def _stress(self, time, logs, x):
        """T (2,), ∂T/∂u (2, 2), ∂T/∂x x' + ∂T/∂t (2,), and x' (K, 2)."""
        stress, tangent = _with_slopes(_energy(self.spring), logs)
        moved, flows = jnp.zeros(2), []
        if self.voltage is not None:
            q, q_rate = jax.jvp(self.load, (time,), (jnp.ones_like(time),))
            own, slope = _with_slopes(lambda u: -capacitance(self.spring, *jnp.exp(u)) / 2, logs)
            stress, tangent, moved = stress + q * own, tangent + q * slope, q_rate * own
        for branch, y in zip(self.branches, x, strict=True):
            own, slope = _with_slopes(_energy(branch.material), logs - y)
            flow = jnp.asarray(FLOW) @ own / branch.relaxation_time if self.flows else jnp.zeros(2)
            stress, tangent = stress + branch.modulus_ratio * own, tangent + branch.modulus_ratio * slope
            moved = moved - branch.modulus_ratio * slope @ flow
            flows.append(flow)
        return stress, tangent, moved, jnp.stack(flows) if flows else jnp.zeros((0, 2))

    def _rows(self, time, logs, tangent):
        """∂R/∂u (2, 2)."""
        one = jnp.ones_like(logs[0])
        first = (one, 0.0)
        if self.reach is not None:
            held = self.reach.power * self.course(time) * self.reach(logs)
            first = (tangent[0][0] - held, tangent[0][1])
        held = self.mode.held
        second = -held * self.mode.ratio, held
        return first, tuple(v + (1 - held) * t for v, t in zip(second, tangent[1], strict=True))


REACHES = {"stretch": None, "force": Reach(1.0, 1.0), "pressure": Reach(0.5, 3.0)}


def film_of(
    material: AbstractMaterial, course: Callable, voltage: Callable | None, *, prescribed: str, mode: str, flows=True
) -> Film:
    """A film of a material, `prescribed` "stretch", "force" or "pressure" by `course`, in a mode of `FILM_MODES`."""
    spring, branches = spring_and_branches(material)
    explicit = prescribed == "stretch" and (mode != "uniaxial" or voltage is None)
    flows = flows and bool(branches)
    return Film(spring, branches, course, voltage, REACHES[prescribed], FILM_MODES[mode], flows, explicit)


def _energy(material) -> Callable:
    """W at logarithms of stretches (2,)."""
    return lambda logs: material.energy(*jnp.exp(logs))


def _with_slopes(energy, logs):
    """The gradient (2,) and the Hessian (2, 2) of a function of logarithms of stretches."""

    def twice(u):
        slope = jax.grad(energy)(u)
        return slope, slope

    hessian, slope = jax.jacfwd(twice, has_aux=True)(logs)
    return slope, hessian


def _solve(field, y0, span, *, tolerance, step_ts=None, event=None, adjoint=None, solver=None):
    """An adaptive solution, by Kvaerno's L-stable method of order 5 unless another solver is given."""
    begin, end = span
    control: diffrax.AbstractStepSizeController = diffrax.PIDController(rtol=tolerance, atol=tolerance)
    if step_ts is not None:
        control = diffrax.ClipStepSizeController(control, step_ts=step_ts)
    return diffrax.diffeqsolve(
        diffrax.ODETerm(jax.jit(field)),  # traced once, not at every use: half the time to trace an implicit method
        diffrax.Kvaerno5() if solver is None else solver,
        begin,
        end,
        1e-3 if step_ts is None else step_ts[1] - step_ts[0],
        y0,
        stepsize_controller=control,
        saveat=diffrax.SaveAt(t1=True) if step_ts is None else diffrax.SaveAt(ts=step_ts),
        event=event,
        max_steps=MOST_FILM_STEPS,
        throw=False,
        adjoint=diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
    )


def film_states(film: Film, begin: FilmState, times, tolerance, adjoint=None) -> tuple[FilmState, jax.Array]:
    """The states at times (n,) that rise from that of `begin`, and whether all of them were reached.

    Differentiable and traceable; `adjoint` of diffrax says how derivatives are taken, backwards by default.
    """
    span = times[0], times[-1]
    solver = diffrax.Kvaerno5() if film.flows else diffrax.Tsit5()
    options = {"tolerance": tolerance, "step_ts": times}
    options |= {"adjoint": adjoint, "solver": solver}
    count = len(film.branches)
    if film.explicit:
        logs = jax.vmap(film.given_logs)(times)
        if not count:
            return FilmState(times, logs, jnp.zeros((len(times), 0, 2))), jnp.asarray(True)
        found = _solve(lambda t, x, _: film.flow(film.given_logs(t), x), begin.x, span, **options)
        return FilmState(times, logs, found.ys), found.result == diffrax.RESULTS.successful

    def field(t, y, _):
        logs, x = y[:2], y[2:].reshape(count, 2)
        stiffness, n, flow = film.rates(t, logs, x)
        return jnp.concatenate([n / stiffness, flow.ravel()])

    start = jnp.concatenate([begin.logs, jnp.ravel(begin.x)])
    found = _solve(field, start, span, **options)
    y = typing.cast(jax.Array, found.ys)
    return FilmState(times, y[:, :2], y[:, 2:].reshape(-1, count, 2)), found.result == diffrax.RESULTS.successful


class Passed(typing.NamedTuple):
    """The `state` at the pull-in, or beyond the end, whether the film `pulled` in, and whether the search reached either."""

    state: FilmState
    pulled: typing.Any
    good: typing.Any


def pass_film(film: Film, begin: FilmState, stop, kappa, tolerance, adjoint=None) -> Passed:
    """The state in which a film pulls in, S = 0, if it does so before the time `stop`.

    The path is followed in σ until S ≤ 0 or t ≥ stop. From there it goes back with S as the independent variable (Hénon), so that
    nothing is interpolated; where the dashpots are held and the film does not pull in, with t, to the state at `stop`. `kappa` is
    a time in which the film stretches noticeably. Held dashpots are not stiff, and an explicit method is used. Differentiable and
    traceable.
    """
    count = len(film.branches)
    solver = diffrax.Kvaerno5() if film.flows else diffrax.Tsit5()

    def split(y):
        return kappa * y[0], y[1:3], y[3:].reshape(count, 2)

    def field(_, y, __):
        stiffness, n, flow = film.rates(*split(y))
        size = jnp.sqrt(stiffness**2 + kappa**2 * n @ n)
        return jnp.concatenate([jnp.stack([stiffness / kappa]), n, (flow * stiffness).ravel()]) / size * kappa

    def happened(_, y, __, **___):
        return (kappa * y[0] >= stop) | (film.stiffness(*split(y)) <= 0)

    y0 = jnp.concatenate([jnp.stack([begin.time / kappa]), begin.logs, jnp.ravel(begin.x)])
    options = {"tolerance": tolerance, "adjoint": adjoint}
    event = diffrax.Event(happened)
    found = _solve(field, y0, (0.0, 1e9), event=event, solver=solver, **options)
    beyond = typing.cast(jax.Array, found.ys)[-1]
    lost, late = film.stiffness(*split(beyond)), 0.0 if film.flows else beyond[0] - stop / kappa
    pulled = lost <= 0

    def back(_, y, __):
        rate = field(0.0, y, None)
        change = jax.jvp(lambda z: film.stiffness(*split(z)), (y,), (rate,))[1]
        return -rate * jnp.where(pulled, lost, late) / jnp.where(pulled, change, rate[0])

    # a part of one step on the way to a pull-in: short enough for an explicit method, which needs no derivatives of `back`
    ended = _solve(back, beyond, (0.0, 1.0), solver=diffrax.Tsit5(), **options)
    state = FilmState(*split(typing.cast(jax.Array, ended.ys)[-1]))
    done = (found.result == diffrax.RESULTS.event_occurred) & (ended.result == diffrax.RESULTS.successful)
    # a fold just behind the end
    return Passed(state, pulled & (state.time <= stop), done & jnp.isfinite(state.time))
