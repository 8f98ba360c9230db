"""Whether a fit of a curve may be told as a result: is it a minimum, are its constants determined, is the misfit noise?"""

from collections.abc import Mapping, Sequence

import numpy as np

__all__ = ["check_determined", "check_intervals", "check_optimal", "looks_absolute", "misfit_warnings"]

_INDEPENDENT = 1e-7  # least singular value of the Jacobian's scaled columns, over the largest
_FELT = 1e-9  # change of the pressures by a constant, over the pressures
_OPTIMAL = 1e-3  # cosine between the residuals and what a constant can change
_EXACT = 1e-7  # residuals over pressures: below they are rounding
_WIDE, _ENDLESS = 10.0, 1e6  # an interval's upper end over its lower one: said, and refused
_SEEN = 2e-3  # misfit over the range of pressures: below nobody minds
_MAD = 0.6744897501960817  # of a normal distribution's absolute deviations, the median


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def check_determined(start: Mapping[str, float], values: Mapping[str, float], jacobian, pressure) -> None:
    """Refuses constants that the curve does not depend on, or that can change together without changing it.

    `jacobian` (n, m) is that by the free parameters; `start` and `values` are the constants before and after the fit.
    """
    names, length = list(values), np.linalg.norm(jacobian, axis=0)
    felt = length > _FELT * np.linalg.norm(pressure)
    for name, good in zip(names, felt, strict=True):
        if not good:
            raise ValueError(
                f"`over` must name constants that the curve depends on, but a change of {name} does not change the pressures "
                f"(it started at {start[name]:.4g} and ended at {values[name]:.4g}); leave it out of `over`."
            )
    _, sizes, rows = np.linalg.svd(jacobian / length, full_matrices=False)
    if len(names) > 1 and sizes[-1] < _INDEPENDENT * sizes[0]:
        joined = [n for n, share in zip(names, np.abs(rows[-1]), strict=True) if share > 0.05]
        raise ValueError(
            f"`over` must name constants that the curve tells apart, but {_and(joined)} can change together without changing "
            "the pressures; leave one of them out of `over`."
        )


def check_optimal(start: Mapping[str, float], values: Mapping[str, float], jacobian, pull, pressure, at_limit) -> None:
    """Refuses constants at which the loss could still be lowered: the fit has stopped, not ended.

    `pull` (n,) are the derivatives of the loss by the residuals; `at_limit` (m,) says which parameters are at their lower limit.
    """
    if np.abs(pull).max() < _EXACT * np.abs(pressure).max():
        return
    slope = jacobian.T @ pull / (np.linalg.norm(jacobian, axis=0) * np.linalg.norm(pull))
    # a parameter at its lower limit may be pushed against it
    slope = np.where(at_limit & (slope < 0), 0.0, slope)
    if np.abs(slope).max() < _OPTIMAL:
        return
    moved = ", ".join(f"{n} {values[n]:.4g} (from {start[n]:.4g})" for n in values)
    raise ValueError(
        f"`pressure` must be a curve that the material can follow, but no best fit was found: the search stopped at {moved}; "
        "start elsewhere, seek fewer constants, or check the units, the thickness and the radius."
    )


def check_intervals(
    intervals: Mapping[str, tuple[float, float]], values: Mapping[str, float], level: float
) -> list[str]:
    """Refuses intervals without end; says which are wide."""
    said = []
    for name, (low, high) in intervals.items():
        told = f"the {100 * level:g} % interval of {name}, {values[name]:.4g}, is {low:.3g} to {high:.3g}"
        endless = not (np.isfinite(low) and np.isfinite(high)) or (low > 0 and high > _ENDLESS * low)
        if endless or (low == 0 and values[name] > 0 and name != "prestretch" and high > _ENDLESS * values[name]):
            raise ValueError(
                f"`over` must name constants that the curve determines, but {told}; leave it out of `over`, or measure "
                "larger volumes, where the film stiffens."
            )
        if low > 0 and high > _WIDE * low:
            said.append(f"The curve hardly determines {name}: {told}.")
    return said


def looks_absolute(volume, pressure) -> bool:
    """Whether pressures in Pa are about the atmosphere's at all volumes, from the smallest on."""
    small = pressure[volume <= 2 * volume.min()]
    return bool(70e3 < pressure.min() < 115e3 and small.min() < 115e3 and pressure.max() < 3 * pressure.min())


def misfit_warnings(volume, pressure, fit, *, robust: bool, noise: float | None, unit: str, advice: str) -> list[str]:
    """What is to be said of a misfit that is no noise; refuses a fit that leaves more than half of the pressures' variance.

    The noise is that of differences between residuals at neighbouring volumes, which a systematic misfit hardly changes
    (von Neumann's ratio), unless it is known as `noise`.
    """
    residual = (pressure - fit)[np.argsort(volume, kind="stable")]
    steps = np.diff(residual) / np.sqrt(2)
    if robust:
        misfit, jumps = (float(np.median(np.abs(v))) / _MAD for v in (residual, steps))
    else:
        misfit, jumps = (float(np.sqrt(np.mean(v**2))) for v in (residual, steps))
    expected = jumps if noise is None else noise
    # the ratio of the two variances scatters by 1/√n for noise
    allowed = 1 / np.sqrt(max(1 - 3 / np.sqrt(len(residual)), 0.05))
    if not (misfit > allowed * expected and misfit > _SEEN * np.ptp(pressure)):
        return []
    said = f"the misfit, {misfit:.3g}{unit}, is {misfit / expected:.3g} times the noise of the pressures, {expected:.3g}{unit}"
    offset = _offset(pressure, fit, misfit)
    if offset:
        advice = f"an offset of the pressures of {offset:.4g}{unit} would explain it: is the gauge zeroed?"
    if misfit > np.sqrt(0.5) * np.std(pressure):
        raise ValueError(f"`pressure` must be a curve that the material can follow, but {said}; {advice}")
    return [f"T{said[1:]}: the material does not follow the curve, and the intervals are too narrow; {advice}"]


def _offset(pressure, fit, misfit: float) -> float:
    """The offset of the pressures that explains most of a misfit; 0 where none does."""
    both = np.column_stack([np.ones_like(fit), fit])
    offset = np.linalg.lstsq(both, pressure, rcond=None)[0]
    left = float(np.sqrt(np.mean((pressure - both @ offset) ** 2)))
    return float(offset[0]) if left < 0.5 * misfit and abs(offset[0]) > 3 * left else 0.0
