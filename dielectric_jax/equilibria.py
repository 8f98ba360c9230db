"""Points made exact: batched Newton onto a loading's contour, every quantity of a state, and its error estimate.

The unknowns of a lane are u = (λa, p, q), the equations λ2(1) = λ0, the loading's condition, and one row that says
where on the contour: a hyperplane, or a value. Newton runs with exact Jacobians on a coarse grid; then the residual alone
is taken on finer grids (deferred correction), doubling the steps until the estimate meets the tolerance, at last
adaptively. Going from n/2 to n steps moves a state by δ; the method is of order eight, so the error left is about δ/256,
and δ/16 is reported, plus what rounding can do.
"""

import concurrent.futures
import dataclasses
import functools
import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from .loading import Contour
from .materials import largest_load, stresses
from .membrane import Membrane, field_ratio_squared, slopes
from .scene import SCANNED_LOAD
from .shooting import COLUMNS, integrate_membrane

__all__ = ["Points", "polish"]

CHUNK = 32  # lanes of one call; one compiled program serves every count of points
SCALE = np.array([1.0, 0.2, 0.02])  # of (λa, p, q)
EASY = (16.0, 32.0, 64.0)  # steps: of Newton, then of the residual
HARD = (48.0, 96.0, 192.0, 320.0)  # where an inner layer forms: a high load near lock-up, or near the cone
ADAPTIVE = (10.0, 12.0)  # exponents of the tolerance of the careful path
SAFETY = 16.0
LEAST_ESTIMATE = 1e-13
_ROUNDING = 2e-14  # relative to λa, p and V; measured


@jax.jit
def _jacobian_program(material, u, steps):
    """lag, V, their columns by (λa, p, q), and the number of zeros of ∂λ2/∂λa in 0 < R < 1."""
    shot = integrate_membrane(material, *u, steps, columns=COLUMNS, trail="sensitivity")
    times, sensitivity = shot.trail
    change = jnp.isfinite(times[1:])[:, None] & (sensitivity[1:] * sensitivity[:-1] < 0)
    columns = jnp.stack([jnp.stack(shot.columns[c]) for c in COLUMNS])
    return shot.lag, shot.volume, columns, jnp.sum(change, axis=0)


def _least_inside(values, rates):
    """Least value of the quintic Hermite interpolants about each inner node that is lower than its neighbours.

    `values` and `rates` (per step) are (nodes, lanes) at equal steps; +inf where no inner node is.
    """
    before, here, after = values[:-2], values[1:-1], values[2:]
    low = (here <= before) & (here <= after) & jnp.isfinite(before) & jnp.isfinite(after)
    before, after = jnp.where(low, before, here), jnp.where(low, after, here)
    slope = rates[1:-1]
    even, odd = (after + before) / 2 - here, (after - before) / 2 - slope
    rise, lift = (rates[2:] - rates[:-2]) / 2, (rates[2:] + rates[:-2]) / 2 - slope
    a4, a5 = (rise - 2 * even) / 2, (lift - 3 * odd) / 2
    a2, a3 = even - a4, odd - a5
    x = jnp.zeros_like(here)
    for _ in range(5):
        first = slope + x * (2 * a2 + x * (3 * a3 + x * (4 * a4 + x * 5 * a5)))
        second = 2 * a2 + x * (6 * a3 + x * (12 * a4 + x * 20 * a5))
        x = jnp.clip(x - first / jnp.where(low & (second != 0), second, 1.0), -1.0, 1.0)
    least = here + x * (slope + x * (a2 + x * (a3 + x * (a4 + x * a5))))
    return jnp.min(jnp.where(low, jnp.minimum(least, here), jnp.inf), axis=0)


_BLOCK = 32  # steps of a trail that are searched together; only as many blocks as there are steps


@jax.jit
def _careful_program(membrane, u, exponent):
    """lag, V, height and C = Q/Φ by adaptive steps."""
    shot = integrate_membrane(membrane.material, *u, exponent, outputs=True, adaptive=True)
    return shot.lag, shot.volume, shot.height, shot.charge


@jax.jit
def _value_program(membrane, u, steps):
    """lag, V, height, C = Q/Φ, least σ2 and largest (E/E_EB)²/q along the membrane, stretches admissible."""
    apex, p, q = u
    material = membrane.material
    shot = integrate_membrane(material, apex, p, q, steps, outputs=True, trail="profile")
    times, values, profile = shot.trail
    # blocks overlap by two nodes, so that every inner node has both neighbours in one
    padding = -(len(times) - 2) % _BLOCK
    times = jnp.pad(times, (0, padding), constant_values=jnp.inf)
    values = jnp.pad(values, ((0, padding), (0, 0), (0, 0)))

    def hoop(l1, l2):
        return l2 * stresses(material, l1, l2, q)[1]

    def field(l1, l2):
        return -field_ratio_squared(membrane.breakdown, l1, l2)

    def search(block, found):
        *least, admissible = found
        tau = jax.lax.dynamic_slice_in_dim(times, block * _BLOCK, _BLOCK + 2)
        rows = jax.lax.dynamic_slice_in_dim(values, block * _BLOCK, _BLOCK + 2)
        done = jnp.isfinite(tau)[:, None]
        radius, stretching, l1, l2, theta = profile((tau, jnp.where(done[..., None], rows, 0.0)))
        rate1, rate2, _ = slopes(material, radius, l1, l2, theta, p, q)
        for k, function in enumerate((hoop, field)):
            value, rate = jax.jvp(function, (l1, l2), (rate1, rate2))
            value = jnp.where(done, value, jnp.inf)
            inner = _least_inside(value, jnp.where(done, rate * stretching / steps, 0.0))
            least[k] = jnp.minimum(least[k], jnp.minimum(inner, jnp.min(value, axis=0)))
        inside = jnp.all(material.admissible(l1, l2) | ~done, axis=0)
        return *least, admissible & inside

    count = jnp.sum(jnp.isfinite(times))
    begin = hoop(apex, apex), field(apex, apex), material.admissible(apex, apex)
    least, largest, admissible = jax.lax.fori_loop(0, (count - 2 + _BLOCK - 1) // _BLOCK, search, begin)
    return shot.lag, shot.volume, shot.height, shot.charge, least, -largest, admissible


@functools.cache
def _threads() -> concurrent.futures.ThreadPoolExecutor:
    return concurrent.futures.ThreadPoolExecutor(max(os.cpu_count() or 1, 1))


_compiling: dict = {}


def compile_ahead(membrane: Membrane, more: tuple[Callable, ...] = ()) -> None:
    """Starts compiling the programs of this kind of membrane side by side, and `more`; `polish` waits for its own."""
    key = jax.tree.structure(membrane)
    if key not in _compiling:
        u = np.tile(np.array([[float(membrane.prestretch) + 0.1], [0.1], [0.0]]), (1, CHUNK))
        jobs = (
            *more,
            lambda: _jacobian_program(membrane.material, u, 2.0),
            lambda: _value_program(membrane, u, 2.0),
        )
        pool = concurrent.futures.ThreadPoolExecutor(len(jobs))
        _compiling[key] = [pool.submit(job) for job in jobs]
        pool.shutdown(wait=False)


def _await_programs(membrane: Membrane) -> None:
    for job in _compiling.get(jax.tree.structure(membrane), ()):
        job.result()


def run_chunks(program: Callable, u: np.ndarray) -> list[np.ndarray]:
    """`program` on lanes u of shape (3, lanes), in chunks of one compiled shape, on all cores."""
    count = u.shape[1]
    u = np.pad(u, ((0, 0), (0, -count % CHUNK)), mode="edge")
    parts = [u[:, i : i + CHUNK] for i in range(0, u.shape[1], CHUNK)]

    def work(part):
        return [np.asarray(v) for v in program(part)]

    done = [work(parts[0]), *(_threads().map(work, parts[1:]) if len(parts) > 1 else [])]
    return [np.concatenate(pieces, axis=-1)[..., :count] for pieces in zip(*done, strict=True)]


@dataclasses.dataclass
class Points:
    """States of many lanes as columns of shape (lanes,), with what locating special points needs.

    `u` is (3, lanes), `tangent` the unit null vector in scaled unknowns (lanes, 3), `error` the relative error of p, V, q
    at fixed λa, `error_of` those errors one by one (3, lanes), `ok` whether Newton converged.
    """

    u: np.ndarray
    volume: np.ndarray
    height: np.ndarray
    charge_per_voltage: np.ndarray
    hoop: np.ndarray
    field: np.ndarray
    tangent: np.ndarray
    index: np.ndarray
    error: np.ndarray
    error_on_plane: np.ndarray
    ok: np.ndarray

    def __len__(self) -> int:
        return self.u.shape[1]

    def take(self, which) -> "Points":
        """The lanes `which`, an index array or slice."""
        return Points(
            **{
                f.name: getattr(self, f.name)[..., which] if f.name != "tangent" else self.tangent[which]
                for f in dataclasses.fields(self)
            }
        )

    @staticmethod
    def join(parts: list["Points"]) -> "Points":
        """All lanes of several sets, in order."""
        return Points(
            **{
                f.name: np.concatenate([getattr(p, f.name) for p in parts], axis=0 if f.name == "tangent" else -1)
                for f in dataclasses.fields(Points)
            }
        )


def _assemble(u, lag, volume, columns, rim, contour):
    """Residual (lanes, 2) and Jacobian (lanes, 2, 3) of rim condition and loading."""
    by_p, by_v, by_q = contour.slopes(volume)
    residual = np.stack([lag - (rim - u[0]), contour.residual(u[1], volume, u[2])], axis=1)
    of_lag = columns[:, 0].copy()
    of_lag[0] += 1.0
    of_condition = by_v * columns[:, 1]
    of_condition[1] += by_p
    of_condition[2] += by_q
    return residual, np.stack([of_lag.T, of_condition.T], axis=1)


def _solve(matrix, right):
    """Batched solve that gives NaN, not an exception, where a matrix is singular."""
    good = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(right).reshape(len(right), -1).all(axis=1)
    safe = np.where(good[:, None, None], matrix, np.eye(matrix.shape[-1]))
    with np.errstate(all="ignore"):
        good &= np.abs(np.linalg.det(safe)) > 1e-300
        safe = np.where(good[:, None, None], safe, np.eye(matrix.shape[-1]))
        out = np.linalg.solve(safe, right if right.ndim == 3 else right[..., None])
    out[~good] = np.nan
    return out if right.ndim == 3 else out[..., 0]


def tangents(jacobian: np.ndarray) -> np.ndarray:
    """Unit null vectors (lanes, 3) of (lanes, 2, 3) Jacobians, in scaled unknowns."""
    a, b = (jacobian * SCALE)[:, 0], (jacobian * SCALE)[:, 1]
    null = np.cross(a, b)
    with np.errstate(all="ignore"):
        return null / np.linalg.norm(null, axis=1, keepdims=True)


def _index(zeros, jacobian, columns, volume, contour):
    """Morse index under the loading: zeros of ∂λ2/∂λa, less one where the gas stiffens the mode.

    With a = ∂λ2(1)/∂λa and b = ∂λ2(1)/∂p: 1 + k dV/dp|q = (a + k (V_p a − V_a b))/a; the parity of the zeros is a's sign.
    """
    a, b = jacobian[:, 0, 0], jacobian[:, 0, 1]
    zeros = zeros + ((zeros % 2 == 1) != (a < 0))  # a zero that a step at the rim hides
    k = contour.gas_stiffness(volume)
    with np.errstate(all="ignore"):
        gain = (a + k * (columns[1, 1] * a - columns[0, 1] * b)) / a
    return np.where(gain < 0, zeros - 1, zeros)


def is_hard(membrane: Membrane, apex_stretch: np.ndarray, load_fraction: np.ndarray) -> np.ndarray:
    """Where the coarse grid does not resolve the membrane: a high load near lock-up, and anywhere near the cone."""
    lock_up = membrane.lock_up_stretch()[0]
    return ((load_fraction > 0.7) & (apex_stretch > 0.72 * lock_up)) | (load_fraction > 0.93)


def load_fraction(membrane: Membrane, u: np.ndarray) -> np.ndarray:
    """t = q/q_max(λa) of points (3, lanes)."""
    return u[2] / run_chunks(lambda part: [_limits(membrane.material, part[0])], u)[0]


_limits = jax.jit(largest_load)


def polish(
    membrane: Membrane,
    contour: Contour,
    u,
    rows,
    targets,
    *,
    tolerance=1e-9,
    reach=1.0,
    quick=False,
    refine=False,
    profile_steps=0.0,
) -> Points:
    """Newton from `u` (3, lanes) onto the contour, with rows·u = targets; `rows` is (lanes, 3).

    A row of NaN asks for a volume: V = target. `reach` bounds the total correction in scaled unknowns: farther means not
    converged. `quick` stops after one residual on the finer grid; `refine` takes tangent and index from a finer grid at the end, `profile_steps` the extremes along the membrane. Lanes that fail have ok = False and never disturb the
    others.
    """
    _await_programs(membrane)
    u, rows, targets = np.array(u, float), np.asarray(rows, float), np.asarray(targets, float)
    hard = is_hard(membrane, u[0], load_fraction(membrane, u))
    order, parts = [], []
    again = np.zeros(0, int)
    for easy, ladder in ((True, EASY), (False, HARD)):
        which = np.flatnonzero(~hard) if easy else np.sort(np.concatenate([np.flatnonzero(hard), again]))
        if not len(which):
            continue
        done = _polish(
            membrane,
            contour,
            u[:, which],
            rows[which],
            targets[which],
            tolerance,
            reach,
            ladder[:2] if quick else ladder,
            refine,
            profile_steps,
        )
        if easy:
            failed = ~done.ok if quick else ~(done.ok & (done.error <= tolerance))
            again = which[failed]
            which, done = which[~failed], done.take(np.flatnonzero(~failed))
        order.append(which)
        parts.append(done)
    return Points.join(parts).take(np.argsort(np.concatenate(order)))


def _polish(membrane, contour, u, rows, targets, tolerance, reach, ladder, refine, profile_steps) -> Points:
    """`polish` of lanes that share one ladder of grids."""
    coarse = ladder[0]
    u = np.array(u, float)
    lanes = u.shape[1]
    rim = float(membrane.prestretch)
    start = u.copy()
    by_volume = ~np.isfinite(rows).all(axis=1)

    def system(part, lag, volume, columns):
        at = u[:, part]
        residual, jacobian = _assemble(at, lag, volume, columns, rim, contour)
        last_row = np.where(by_volume[part, None], columns[:, 1].T, rows[part])
        last = np.where(by_volume[part], volume, np.einsum("ij,ji->i", np.nan_to_num(rows[part]), at)) - targets[part]
        return np.concatenate([residual, last[:, None]], axis=1), np.concatenate([jacobian, last_row[:, None]], axis=1)

    matrix = np.full((lanes, 3, 3), np.nan)
    columns = np.full((3, 2, lanes), np.nan)
    zeros = np.zeros(lanes, int)
    volume = np.full(lanes, np.nan)
    active = np.arange(lanes)
    settled = np.zeros(lanes, bool)

    def newton(active, steps, tries):
        size = np.full(lanes, np.inf)
        for _ in range(tries):
            if not len(active):
                break
            lag, volume[active], columns[..., active], zeros[active] = run_chunks(
                lambda part: _jacobian_program(membrane.material, part, steps), u[:, active]
            )
            right, matrix[active] = system(active, lag, volume[active], columns[..., active])
            move = -_solve(matrix[active], right)
            length = np.linalg.norm(move / SCALE, axis=1)
            with np.errstate(all="ignore"):
                move = move * np.minimum(1.0, 0.5 * reach / length)[:, None]
            u[:, active] += move.T
            volume[active] += np.einsum("il,li->l", columns[:, 1][:, active], move)
            size[active] = length
            drift = np.linalg.norm((u[:, active] - start[:, active]).T / SCALE, axis=1)
            settled[active] = size[active] < 1e-5
            active = active[~settled[active] & np.isfinite(length) & (drift < 3 * reach)]

    newton(active, coarse, 9)
    settled &= np.isfinite(u).all(axis=0)
    result = [volume.copy(), *(np.full(lanes, np.nan) for _ in range(4))]
    admissible = np.zeros(lanes, bool)
    change_of_volume = np.full(lanes, np.nan)
    discretisation = np.full((lanes, 2), np.nan)  # change of (rim condition, condition) from the coarser grid
    estimate = np.full(lanes, np.inf)
    plane = np.full(lanes, np.inf)

    def correct(active, steps, adaptive=False):
        """Deferred correction on one grid: the residual there at first, and the state moved to make it zero."""
        first = np.full((lanes, 2), np.nan)
        working = active
        for _ in range(4):
            program = _careful_program if adaptive else _value_program
            lag, vol, *rest = run_chunks(lambda part, run=program: run(membrane, part, steps), u[:, working])
            right, _ = system(working, lag, vol, columns[..., working])
            move = -_solve(matrix[working], right)
            begin = np.isnan(first[working, 0])
            first[working[begin]] = right[begin, :2]
            change_of_volume[working[begin]] = np.abs(vol - result[0][working])[begin]
            u[:, working] += move.T
            vol = vol + np.einsum("il,li->l", columns[:, 1][:, working], move)
            for store, values in zip([*result, admissible], [vol, *rest], strict=False):
                store[working] = values
            # the next chord step would be smaller by the error of the Jacobian, 1e-3 or less
            working = working[np.linalg.norm(move / SCALE, axis=1) > 3e-9]
            if not len(working):
                break
        return first[active]

    def estimate_errors(active):
        by_volume = np.abs(contour.slopes(result[0][active])[1] * result[0][active])
        rounding = _ROUNDING * np.stack([np.abs(u[0, active]), np.abs(u[1, active]) + by_volume], axis=1)
        both = discretisation[active] / SAFETY + rounding
        fixed_apex = matrix[active].copy()
        fixed_apex[:, 2] = [1.0, 0.0, 0.0]
        on_plane = matrix[active].copy()
        on_plane[:, 2] = tangents(matrix[active][:, :2]) / SCALE
        for store, system_matrix in ((estimate, fixed_apex), (plane, on_plane)):
            inverse = np.abs(_solve(system_matrix, np.broadcast_to(np.eye(3), system_matrix.shape).copy())[:, :, :2])
            moved = np.einsum("lij,lj->li", inverse, both)
            of_volume = np.einsum("il,li->l", np.abs(columns[:, 1][:, active]), moved)
            of_volume += _ROUNDING * np.abs(result[0][active]) + change_of_volume[active] / SAFETY
            value = np.stack([u[1, active], result[0][active], u[2, active]])
            error = np.stack([moved[:, 1], of_volume, moved[:, 2]]) / np.maximum(np.abs(value), 1e-3)
            store[active] = np.maximum(np.nan_to_num(error.max(axis=0), nan=np.inf), LEAST_ESTIMATE)

    active = np.flatnonzero(settled)
    for steps in ladder[1:]:
        if not len(active):
            break
        discretisation[active] = np.abs(correct(active, steps))
        estimate_errors(active)
        active = active[~(estimate[active] <= tolerance)]
    if ladder == HARD and len(active):
        # within the scanned loads only: beyond them a branch ends where the estimate does
        active = active[(load_fraction(membrane, u[:, active]) <= SCANNED_LOAD) & (estimate[active] < 1e-6)]
        for exponent in ADAPTIVE:
            if not len(active):
                break
            discretisation[active] = np.abs(correct(active, exponent, adaptive=True))
            if exponent != ADAPTIVE[0]:
                estimate_errors(active)
                active = active[~(estimate[active] <= tolerance)]
    which = np.flatnonzero(settled)
    if profile_steps and len(which):
        *_, result[3][which], result[4][which], _ = run_chunks(
            lambda part: _value_program(membrane, part, profile_steps), u[:, which]
        )
    if refine and len(which):
        lag, vol, columns[..., which], zeros[which] = run_chunks(
            lambda part: _jacobian_program(membrane.material, part, 3 * coarse), u[:, which]
        )
        _, matrix[which] = system(which, lag, vol, columns[..., which])
    drift = np.linalg.norm((u - start).T / SCALE, axis=1)
    ok = settled & np.isfinite(u).all(axis=0) & np.isfinite(result[0]) & (drift < 2 * reach) & admissible
    return Points(
        u=u,
        volume=result[0],
        height=result[1],
        charge_per_voltage=result[2],
        hoop=result[3],
        field=result[4],
        tangent=tangents(matrix[:, :2]),
        index=_index(zeros, matrix, columns, result[0], contour),
        error=estimate,
        error_on_plane=plane,
        ok=ok,
    )
