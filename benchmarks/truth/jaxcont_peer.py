"""The batch of chambers by the package jaxcont: all branches in one `vmap` of its pseudo-arclength continuation.

jaxcont knows no boundary-value problems, so its residual is a shot in two unknowns, (λa, p), continued in q, all scaled;
the shot is a plain scan of eighth-order steps on our graded grid, which can be differentiated in both modes as its fold
solver asks. Its events are not available under `vmap`: extremes of q between points of a branch are handed to its
`fold_point`, under `vmap` too; zero-voltage states, breakdown and landings to a vmapped Newton iteration.
"""

import jax
import jax.numpy as jnp
import jaxcont
import numpy as np

from benchmarks.truth import chambers
from benchmarks.truth.scipy_peers import SCALE, START
from dielectric_jax import Gent, VHBBreakdown
from dielectric_jax.model import stresses
from dielectric_jax.model.membrane import apex_series, slopes
from dielectric_jax.model.shooting import eighth_order_step, graded_map

_POINTS, _FIRST = 100, 4e-4
_GENT = Gent(chambers.STRETCH_LIMIT)


def shot(x, steps: int):
    """λ2(1) − 1 and V of the membrane shot from x = (λa, p, q)."""
    apex, p, q = x
    a, b, kappa = apex_series(_GENT, apex, p, q)
    scale = jax.lax.stop_gradient(jnp.minimum(1 / kappa, 1.0))
    first = _FIRST * scale
    position = graded_map(scale, first)
    l1, l2 = apex + a * first**2, apex + b * first**2
    slope = jnp.arcsin(p * first * l2**2 / (2 * stresses(_GENT, l1, l2, q)[0]))
    start = jnp.stack([a * first**2, b * first**2, slope, jnp.pi / 4 * apex**3 * kappa * first**4])

    def field(tau, y):
        radius, stretching = position(tau)
        l1, l2 = apex + y[0], apex + y[1]
        rates = slopes(_GENT, radius, l1, l2, y[2], p, q)
        return stretching * jnp.stack([*rates, jnp.pi * (radius * l2) ** 2 * l1 * jnp.sin(y[2])])

    def step(y, tau):
        return eighth_order_step(field, tau, 1 / steps, y), None

    end, _ = jax.lax.scan(step, start, jnp.arange(steps) / steps)
    return apex + end[1] - 1.0, end[3]


class Batch:
    """The batch at one accuracy: `run` returns what was found, no seconds, and counts."""

    def __init__(self, lanes: list[float], steps: int, tolerance: float):
        self.lanes, self.steps = lanes, steps
        gas = np.array(lanes)
        amount = (START[1] + chambers.ATMOSPHERE) * (chambers.INITIAL_VOLUME + gas)
        self.gas = jnp.asarray(np.stack([gas, amount], axis=1))
        settings = jaxcont.ContinuationPar(
            ds=0.05,
            ds_min=1e-4,
            ds_max=0.3,
            max_steps=_POINTS,
            newton_tol=tolerance,
            newton_max_iter=8,
            compute_stability=False,
        )
        start = jnp.asarray(START / SCALE)

        def residual(u, q, gas):
            x = jnp.append(u, q) * SCALE
            rim, v = shot(x, steps)
            return jnp.stack([rim, x[1] + chambers.ATMOSPHERE - gas[1] / (v + gas[0])])

        def branch(gas):
            problem = jaxcont.bif_problem(residual, start[:2], 0.0, args=gas)
            found = jaxcont.continuation(problem, p_span=(0.0, 10.0), settings=settings).branch
            return found.params, found.states, found.valid

        def fold(u, q, gas):
            u, q, _, converged = jaxcont.fold_point(residual, u, q, gas, tol=tolerance)
            x = jnp.append(u, q) * SCALE
            return jnp.append(x, shot(x, steps)[1]), converged

        def at_load(x, gas, level, broken):
            """Newton on the residual with q given, or that of breakdown."""

            def value(y):
                own = jnp.where(broken, _breakdown(y[0]), level)
                return jnp.append(residual(y[:2], y[2], gas), y[2] - own / SCALE[2])

            y = jax.lax.fori_loop(0, 6, lambda _, y: y - jnp.linalg.solve(jax.jacfwd(value)(y), value(y)), x)
            return jnp.append(y * SCALE, shot(y * SCALE, steps)[1])

        self._branches = jax.jit(jax.vmap(branch))
        self._folds, self._at_load = jax.jit(jax.vmap(fold)), jax.jit(jax.vmap(at_load))

    def run(self):
        q, u, valid = (np.asarray(w) for w in self._branches(self.gas))
        x = np.concatenate([u, q[..., None]], axis=2)
        count = valid.sum(axis=1)
        turns, broken, zeros = [], [], []
        for k, n in enumerate(count):
            excess = x[k, :n, 2] * SCALE[2] - chambers.breakdown_load(x[k, :n, 0])
            over = np.flatnonzero((excess[:-1] < 0) & (excess[1:] >= 0))
            last = over[0] if over.size else n - 2
            broken += [(k, i) for i in over[:1]]
            load = x[k, : last + 2, 2]
            turns += [(k, i) for i in np.flatnonzero((load[1:-1] - load[:-2]) * (load[2:] - load[1:-1]) < 0) + 1]
            zeros += [(k, i) for i in np.flatnonzero(load[1:-1] * load[2:] < 0) + 1]
        # padded to one shape, so that nothing compiles anew
        size = 2 * len(self.lanes)
        folds, converged = (np.asarray(w) for w in self._folds(*self._padded(x, turns, size)))
        folds = {place: folds[i] for i, place in enumerate(turns) if converged[i]}
        landings = self._landings(x, count, folds)
        asked = [(*place, 0.0, True) for place in broken] + [(*place, 0.0, False) for place in zeros]
        asked += [(k, i, level, False) for k, i, level in landings]
        places = [row[:2] for row in asked]
        u, q, gas = self._padded(x, places, 4 * len(self.lanes))
        level, flag = (np.resize(np.array([row[j] for row in asked]), len(u)) for j in (2, 3))
        located = np.asarray(self._at_load(np.concatenate([u, q[:, None]], axis=1), gas, level, flag))
        return self._found(folds, broken, zeros, landings, located), None, {"points": int(count.sum())}

    def _padded(self, x, places, size):
        """States at (lane, point) of the branches, repeated up to a size: u, q and the gas."""
        lanes, at = np.resize(np.array(places), (size, 2)).T
        return x[lanes, at, :2], x[lanes, at, 2], np.asarray(self.gas)[lanes]

    def _landings(self, x, count, folds):
        """(lane, point, load) behind the first fold of each lane, where its load is reached again."""
        found = {}
        for (k, i), state in folds.items():
            load = x[k, : count[k], 2] * SCALE[2]
            again = np.flatnonzero((load[:-1] < state[2]) & (load[1:] >= state[2]))
            again = again[again > i]
            if k not in found:
                found[k] = [(k, again[0] + 1, state[2])] if again.size else []
        return [row for rows in found.values() for row in rows]

    def _found(self, folds, broken, zeros, landings, located):
        out = {c: chambers.Found([], [], chambers.NAN, chambers.NAN) for c in self.lanes}
        for (k, _), state in folds.items():
            out[self.lanes[k]].folds.append((state[2], state[3]))
        for (k, _), state in zip(broken, located, strict=False):
            out[self.lanes[k]].breakdown = state[2]
        for (k, _), state in zip(zeros, located[len(broken) :], strict=False):
            out[self.lanes[k]].zero_voltage.append(state[3])
        for (k, *_), state in zip(landings, located[len(broken) + len(zeros) :], strict=False):
            out[self.lanes[k]].landing = state[3]
        return out


def _breakdown(apex):
    """`chambers.breakdown_load` for traced numbers."""
    return VHBBreakdown().field(apex) ** 2 / apex**4
