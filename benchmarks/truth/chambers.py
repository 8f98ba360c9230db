"""The batch of 256 chambers that engines compete on: the reference, and the judging of what an engine found.

An engine finds one `Found` a chamber: what lies on the branch from the filling at zero voltage to breakdown.
"""

import csv
import dataclasses
import itertools
import pathlib

import numpy as np

DATA = pathlib.Path(__file__).parent / "data"
INITIAL_VOLUME, ATMOSPHERE, STRETCH_LIMIT = 2.42, 50.0, 270.0
_RIGHT, _RIGHT_VOLUME = 1e-6, 1e-3  # a lane with a larger error in a voltage, or relative error in a volume, is wrong
_FIELD = (45e3 / (4.7 * 8.854e-12)) ** 0.5 / 1e6  # √(μ/ε) in MV/m
NAN = float("nan")


def breakdown_load(apex):
    """q at which E/E_EB = 1 at the apex."""
    return (np.minimum(30.6 * np.asarray(apex) ** 1.13, 218.0) / _FIELD / np.asarray(apex) ** 2) ** 2


def voltage(q):
    """Φ with the sign of q: −√(−q) where q < 0."""
    return np.sign(q) * np.sqrt(np.abs(q))


@dataclasses.dataclass
class Found:
    """Special points of one chamber in their order on the branch, from the filling on to the first breakdown.

    (q, V) of folds, where q is NaN if it is negative and an engine gives no more; volumes at zero voltage without the start's;
    q of breakdown; the volume of the landing of the snap, None where an engine does not seek it, NaN where it found none.
    """

    folds: list[tuple[float, float]]
    zero_voltage: list[float] | None
    breakdown: float
    landing: float | None = None


def reference() -> dict[float, Found]:
    """The special points of every chamber, from `data/chambers.csv`."""
    with (DATA / "chambers.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = {}
    for chamber, group in itertools.groupby(rows, key=lambda row: float(row["chamber_volume"])):
        points = {}
        for row in group:
            points.setdefault(row["kind"], []).append((float(row["voltage_squared"]), float(row["volume"])))
        found[chamber] = Found(
            folds=points.get("fold", []),
            zero_voltage=[v for _, v in points["zero_voltage"][1:]],
            breakdown=points["breakdown"][0][0],
            landing=points["landing"][0][1] if "landing" in points else None,
        )
    return found


def spread(chambers: list[float], count: int) -> list[float]:
    """`count` of the chambers, evenly, the first and the last among them."""
    return [chambers[i] for i in np.unique(np.linspace(0, len(chambers) - 1, count).round().astype(int))]


def judge(found: dict[float, Found], truth: dict[float, Found]) -> dict:
    """The largest errors over the lanes and the counts of what is missing, false and wrong.

    `error` is of the voltages of folds. Errors count over points that were found; a lane is wrong when a point is
    missing (landings are counted apart), false, or off by more than 1e-6 in a voltage or 1e-3 in a volume.
    """
    errors = {"error": 0.0, "fold_volume_error": 0.0, "breakdown_error": 0.0, "zero_voltage_error": 0.0}
    errors["landing_error"] = 0.0
    missing = false = wrong = missing_breakdown = missing_landing = 0
    has_zero = has_landing = False
    for chamber, one in found.items():
        true = truth[chamber]
        own = dict.fromkeys(errors, 0.0)
        bad = len(one.folds) != len(true.folds)
        missing += max(0, len(true.folds) - len(one.folds))
        false += max(0, len(one.folds) - len(true.folds))
        for (q, v), (true_q, true_v) in matched(one.folds, true.folds):
            if np.isfinite(q) or true_q > 0:
                own["error"] = max(own["error"], np.nan_to_num(abs(voltage(q) - voltage(true_q)), nan=np.inf))
            own["fold_volume_error"] = max(own["fold_volume_error"], abs(v / true_v - 1))
        own["breakdown_error"] = abs(voltage(one.breakdown) - voltage(true.breakdown))
        if not np.isfinite(own["breakdown_error"]):
            missing_breakdown += 1
            bad, own["breakdown_error"] = True, 0.0
        if one.zero_voltage is not None:
            has_zero = True
            if len(one.zero_voltage) != len(true.zero_voltage):
                bad = True
            else:
                gaps = [abs(a / b - 1) for a, b in zip(one.zero_voltage, true.zero_voltage, strict=True)]
                own["zero_voltage_error"] = max(gaps, default=0.0)
        if one.landing is not None:
            has_landing = True
            bad |= np.isfinite(one.landing) and true.landing is None
            missing_landing += true.landing is not None and not np.isfinite(one.landing)
            if np.isfinite(one.landing) and true.landing is not None:
                own["landing_error"] = abs(one.landing / true.landing - 1)
        # volumes are uncertain where the load hardly changes: at a fold by the root of its error
        bad |= any(v > (_RIGHT if k in ("error", "breakdown_error") else _RIGHT_VOLUME) for k, v in own.items())
        wrong += bad
        errors = {k: max(v, own[k]) for k, v in errors.items()}
    if not has_zero:
        errors["zero_voltage_error"] = None
    if not has_landing:
        errors["landing_error"] = None
    counts = {"lanes": len(found), "missing_folds": missing, "false_folds": false, "wrong_lanes": wrong}
    counts |= {"missing_breakdowns": missing_breakdown, "missing_landings": missing_landing if has_landing else None}
    return {**errors, "counts": counts}


def matched(found: list, true: list) -> list[tuple]:
    """Pairs of folds, in order; where the numbers differ, the nearest for each of the fewer."""
    if len(found) == len(true):
        return list(zip(found, true, strict=True))
    if len(found) < len(true):
        return [(f, min(true, key=lambda t: abs(t[1] - f[1]))) for f in found]
    return [(min(found, key=lambda f: abs(f[1] - t[1])), t) for t in true]
