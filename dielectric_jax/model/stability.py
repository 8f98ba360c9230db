"""Stability of a state: its axisymmetric Morse index from the shot's sensitivity, and when that index means something.

Under prescribed pressure and voltage the index is the number of zeros of ∂r/∂λa(R), at fixed p and q, in 0 < R < 1, as in
Jacobi's theory of conjugate points. This holds where the energy's density is convex in (r', z'), that is where
∂s1/∂λ1 > 0 (ellipticity) and s1 > 0 (meridional tension) all along the membrane. Every loading adds a term of rank one to
the second variation, or a constraint, and so changes the index by one or not at all.
Hoop tension does not enter: where it is lost the membrane wrinkles, which no axisymmetric variation shows.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.optimize import minimize_scalar

from ..numerics import cached_jit, run_lanes
from .loading import Chamber, ChargeControl, PrescribedVolume, mechanical
from .materials import stresses
from .membrane import Membrane
from .records import State
from .resolution import CHUNK, EQUILIBRIUM, GRID_DOUBT, LEAST_ESTIMATE, STABILITY_GRIDS, STATE_DOUBT
from .scene import Scene
from .shooting import UNKNOWNS, integrate_membrane

__all__ = ["Stability", "control_rate", "index_of", "index_under", "least_along", "stability_of", "under_charge"]


def index_of(zeros, jacobian, sensitivities, volume, condition):
    """Morse index under a contour's loading, (lanes,): zeros of ∂λ2/∂λa corrected for what the loading adds.

    `jacobian` (lanes, 2, 3) and `sensitivities` (3, 2, lanes) are those of a shot. Where the charge is controlled it is that
    under the voltage, see `under_charge`.
    """
    by_p, by_v, _ = condition.slopes(volume)
    return index_under(zeros, jacobian[:, 0, 0], sensitivities, by_p, by_v)


def index_under(zeros, of_rim, sensitivities, by_p, by_v):
    """Morse index under voltage and the condition by_p dp + by_v dV = 0; by_v = 0 is prescribed pressure.

    With a = ∂λ2(1)/∂λa (`of_rim`) and b = ∂λ2(1)/∂p, ∂p/∂λa|q = −a/b, so by_p + by_v dV/dp|q is, but for a positive factor,
    (by_p a + by_v (V_p a − V_a b))/a; where it is negative the loading takes one from the index. The parity of the zeros
    is a's sign.
    """
    a, b = of_rim, sensitivities[1, 0]
    zeros = zeros + ((zeros % 2 == 1) != (a < 0))  # a zero that a step at the rim hides
    with np.errstate(all="ignore"):
        gain = _gain(a, b, sensitivities, by_p, by_v) / a
    xp = jnp if isinstance(a, jax.Array) else np
    return xp.where((xp.asarray(by_v) != 0) & (gain < 0), zeros - 1, zeros)


def _gain(a, b, sensitivities, by_p, by_v):
    return by_p * a + by_v * (sensitivities[1, 1] * a - sensitivities[0, 1] * b)


def control_rate(q, along, charge, gradient):
    """d(Q²)/C² along a direction (3, lanes) of (λa, p, q): dq + 2 q dC/C."""
    return along[2] + 2 * q * (gradient * along).sum(axis=0) / charge


def under_charge(index, along, q, charge, gradient):
    """The index with U + Q²/(2C) for U − qC/2: one less where dQ²/dq < 0 along the loading; one more where q < 0.

    `along` (3, lanes) is a direction along the branch; C and its gradient (3, lanes) are given.
    """
    with np.errstate(all="ignore"):
        turned = control_rate(q, along, charge, gradient) * along[2] < 0
    return np.where(turned, index - np.sign(q).astype(int), index)


@dataclasses.dataclass(frozen=True)
class Stability:
    """What `stability_of` tells of a state.

    `index` is None where it is not valid, for `reasons`: "not_elliptic", "no_tension" (of the meridian), "near_fold"
    (nearer to a change of the index than the shot can tell), "unresolved" (the grids differ; numbers may be NaN). `hoop_tension` is the least true hoop stress
    σ2 and `hoop_tension_radius` the R where it is taken; `meridional_tension` the least σ1; `tangent_modulus` the least
    ∂s1/∂λ1, the margin of ellipticity.
    """

    index: int | None
    reasons: tuple[str, ...]
    hoop_tension: float
    hoop_tension_radius: float
    meridional_tension: float
    tangent_modulus: float

    @property
    def valid(self) -> bool:
        """Whether the index means something."""
        return self.index is not None

    @property
    def wrinkled(self) -> bool:
        """Whether hoop tension is lost somewhere: the membrane wrinkles, whatever its axisymmetric index."""
        return self.hoop_tension < 0

    @property
    def stable(self) -> bool | None:
        """Whether no axisymmetric variation lowers the energy; None where the index is not valid."""
        return None if self.index is None else self.index == 0


@cached_jit
def _survey_program(material, u, steps):
    """What stability needs of lanes u (3, lanes).

    λ2(1) − λa, V, C, columns (3, 3, lanes), zeros; R and σ2 after every step, padded with NaN; least σ1 and ∂s1/∂λ1.
    """
    apex, p, q = u
    shot = integrate_membrane(material, apex, p, q, steps, sensitivities=UNKNOWNS, outputs=True, trail="all")
    times, values, along = shot.trail
    done = jnp.isfinite(times)[:, None]
    radius, _, l1, l2, _ = along.rows(times, jnp.where(done[..., None], values[:, :3], 0.0))
    s1, s2, s11, _ = stresses(material, l1, l2, q)
    sensitivity = 1 + values[:, 6 + 1]  # of the first column, λa
    change = done[1:] & (sensitivity[1:] * sensitivity[:-1] < 0)
    sensitivities = jnp.stack([jnp.stack(shot.sensitivities[c]) for c in UNKNOWNS])
    least = [jnp.min(jnp.where(done, v, jnp.inf), axis=0) for v in (l1 * s1, s11)]
    fields = [jnp.where(done, v, jnp.nan) for v in (radius, l2 * s2)]
    return shot.stretch_change, shot.volume, shot.charge, sensitivities, jnp.sum(change, axis=0), *fields, *least


def least_along(radius: np.ndarray, hoop: np.ndarray) -> tuple[float, float]:
    """The least value of a smooth function known at rising radii, and its place."""
    known = np.isfinite(radius)
    radius, hoop = radius[known], hoop[known]
    if not np.isfinite(hoop).all():
        return np.nan, np.nan
    i = int(np.argmin(hoop))
    if not 0 < i < len(hoop) - 1:
        return float(hoop[i]), float(radius[i])
    near = slice(max(i - 4, 0), i + 5)
    inside = make_interp_spline(radius[near], hoop[near], k=min(5, len(radius[near]) - 1))
    found = minimize_scalar(inside, bounds=(radius[i - 1], radius[i + 1]), method="bounded", options={"xatol": 1e-10})
    return (float(found.fun), float(found.x)) if found.fun < hoop[i] else (float(hoop[i]), float(radius[i]))


def stability_of(what: Scene | Membrane, state):
    """Morse index, its validity, least hoop tension and ellipticity margin of a state under a scene's loading.

    For a `Membrane` the pressure and the voltage are prescribed. `state` is an equilibrium of the membrane, or a
    sequence of them, which gives a list; a chamber's filling is that of the state. Where q = Φ² < 0, which no voltage
    reaches, the index is that of the energy continued to there.
    Raises ValueError where a state is no equilibrium of the membrane.

    >>> from dielectric_jax import Chamber, equilibrium
    >>> membrane = Membrane()
    >>> snapped = equilibrium(membrane, volume=11.7561689651)
    >>> stability_of(membrane, snapped).index, stability_of(membrane, snapped).wrinkled
    (1, False)
    >>> stability_of(Scene(membrane, Chamber(volume=1600.0, initial_volume=2.42)), snapped).stable
    True
    """
    membrane = what.membrane if isinstance(what, Scene) else what
    if not isinstance(membrane, Membrane):
        raise ValueError(f"`what` must be a Scene or a Membrane, but is a {type(what).__name__}.")
    one = isinstance(state, State)
    states = [state] if one else list(state)
    for s in states:
        if not isinstance(s, State):
            raise ValueError(f"`state` must be a State or a sequence of them, but holds a {type(s).__name__}.")
    curved = [i for i, s in enumerate(states) if s.pressure > 0]
    chosen = [states[i] for i in curved]
    judged = dict(zip(curved, judge(what, chosen, survey(membrane, chosen)), strict=True))
    found = [judged[i] if i in judged else _flat(membrane, s) for i, s in enumerate(states)]
    return found[0] if one else found


def _flat(membrane: Membrane, state: State) -> Stability:
    """A flat film: homogeneous, so that no variation but a loss of tension or ellipticity lowers its energy.

    Its C = π λ0⁴ and V = 0 do not depend on the load, so that every loading gives the same.
    """
    stretch = float(membrane.prestretch)
    if state.pressure != 0 or abs(state.apex_stretch - stretch) > EQUILIBRIUM:
        raise ValueError(f"`state` must be an equilibrium of the membrane, but is {state!r}.")
    s1, s2, s11, _ = (float(v) for v in stresses(membrane.material, stretch, stretch, state.voltage_squared))
    reasons = tuple(name for name, lost in (("no_tension", s1 <= 0), ("not_elliptic", s11 <= 0)) if lost)
    return Stability(None if reasons else 0, reasons, stretch * s2, 0.0, stretch * s1, s11)


def _weights(what, states: list[State]):
    """by_p, by_v of the loading's condition at each state."""
    loading = mechanical(what.loading) if isinstance(what, Scene) else None
    by_p, by_v = np.ones(len(states)), np.zeros(len(states))
    if isinstance(loading, PrescribedVolume):
        by_p, by_v = by_v, by_p
    elif isinstance(loading, Chamber):
        fillings = [loading.condition(s.pressure, s.volume) for s in states]
        by_v = np.array([float(c.gas_stiffness(s.volume)) for c, s in zip(fillings, states, strict=True)])
    return by_p, by_v


def survey(membrane: Membrane, states: list[State]) -> list:
    """What `_survey_program` gives of inflated states on each of the grids."""
    u = np.array([[s.apex_stretch, s.pressure, s.voltage_squared] for s in states]).T.reshape(3, -1)
    if not states:
        return []
    return [
        run_lanes(lambda part, n=steps: _survey_program(membrane.material, part, n), u, sizes=CHUNK)
        for steps in STABILITY_GRIDS
    ]


def judge(what: Scene | Membrane, states: list[State], surveys: list) -> list[Stability]:
    """The stability under a loading of states that were surveyed."""
    if not states:
        return []
    membrane = what.membrane if isinstance(what, Scene) else what
    names = ("apex_stretch", "pressure", "voltage_squared")
    apex, pressure, q = (np.array([getattr(s, name) for s in states]) for name in names)
    charged = isinstance(what, Scene) and isinstance(what.loading, ChargeControl)
    given = q, *_weights(what, states), charged
    (coarse, rough, _), (index, sign, size) = (_index_and_sign(found, *given) for found in surveys)
    error = np.maximum([s.error_estimate for s in states], LEAST_ESTIMATE)
    stretch_change, _, _, sensitivities, zeros, radius, hoop, tension, modulus = surveys[1]
    with np.errstate(all="ignore"):
        defect = np.abs(stretch_change - (float(membrane.prestretch) - apex)) / apex
        # towards the cone an exact state's shot may end far off, but a small change of its p or q mends that
        reach = np.maximum(np.abs(sensitivities[1, 0] * pressure), np.abs(sensitivities[2, 0] * q))
        off = np.minimum(defect, defect * apex / reach)
        # beyond t of about 0.99 a shot may blow up every error: then the grids differ
        agreed = np.abs(stretch_change - surveys[0][0]) / apex < 0.01 * defect + 0.1 * EQUILIBRIUM
        doubt = np.maximum(GRID_DOUBT * np.abs(sign - rough), STATE_DOUBT * error * size)
        near = np.abs(sign) <= doubt
    found = []
    for i, state in enumerate(states):
        if off[i] > EQUILIBRIUM and agreed[i]:
            raise ValueError(f"`state` must be an equilibrium of the membrane, but is {state!r}.")
        if not (defect[i] < EQUILIBRIUM and agreed[i] and np.isfinite(sign[i])):
            found.append(Stability(None, ("unresolved",), *[np.nan] * 4))
            continue
        decided = abs(zeros[i] - surveys[0][4][i]) < 2
        doubts = {
            "no_tension": tension[i] <= 0,
            "not_elliptic": modulus[i] <= 0,
            "near_fold": bool(near[i] or coarse[i] != index[i]) and decided,
            "unresolved": not decided,
        }
        reasons = tuple(name for name, doubt in doubts.items() if doubt)
        least = least_along(radius[:, i], hoop[:, i])
        numbers = *least, float(tension[i]), float(modulus[i])
        found.append(Stability(None if reasons else int(index[i]), reasons, *numbers))
    return found


def _index_and_sign(found, q, by_p, by_v, charged: bool):
    """The index, the determinant (lanes,) whose sign it turns on, and the size of that determinant's terms.

    Where a determinant of fewer constraints vanishes, zeros and corrections change together and the index does not.
    """
    _, _, charge, sensitivities, zeros = found[:5]
    rim = sensitivities[:, 0].copy()
    rim[0] += 1.0
    a, b, pair = rim[0], rim[1], sensitivities[:, :2]
    index = index_under(zeros, a, pair, by_p, by_v)
    if not charged:
        size = _gain(1 + np.abs(a), -np.abs(b), np.abs(pair), by_p, by_v)
        return index, _gain(a, b, pair, by_p, by_v), size
    condition = by_v * sensitivities[:, 1]
    condition[1] += by_p
    along = np.cross(rim.T, condition.T).T
    index = under_charge(index, along, q, charge, sensitivities[:, 2])
    one, other = np.abs(rim), np.abs(condition)
    one[0] += 1.0
    most = np.stack([one[i] * other[j] + one[j] * other[i] for i, j in ((1, 2), (2, 0), (0, 1))])
    size = control_rate(np.abs(q), most, charge, np.abs(sensitivities[:, 2]))
    return index, control_rate(q, along, charge, sensitivities[:, 2]), size
