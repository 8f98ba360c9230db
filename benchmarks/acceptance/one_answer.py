"""Does every way of asking give one answer? Random scenes of all materials, each asked in every way.

A scene is asked by its whole diagram (`voltage_volume`), by continuation side by side (`continue_scenes`), on the surface
(`chamber_ramps`, `pressure_ramps`), at a glance, in sweeps with both engines, and by `classify_designs`. Two ways disagree
where both are definite and the regimes differ, or the squared voltages of snap and breakdown differ by more than 1e-6
of max(Φ², 1e-3), as error estimates are measured. "not_decided" and an error in a sentence are no answers. Scenes: Gent J 5–1000, neo-Hookean, Mooney–Rivlin, Ogden, eight-chain,
electrostrictive; prestretch 1–4; V_0 from 0.1 to 1.6 of the volume at the peak of the pressure, or a pressure p_0 up to that
peak; V_C 0.02–25 000, p_atm 0–1000, polytropic exponents 1 and 1.4; every sixth scene at constant pressure.

A share of the scenes, and every scene whose answers differ, is asked by its whole diagram and by `classify_designs` too: the
two that decide nearly every scene, and that cost the most.

    python -m benchmarks.acceptance.one_answer [--scenes 10000] [--minutes M] [--each 10] [--share 0.1] [--kinds NAME,…]
                                               [--seed 0] [--json FILE|-] [--quick]
"""

import collections
import sys
import time
import warnings

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness, random_scenes

jax.config.update("jax_enable_x64", True)

ALLOWED = 1e-6
OPEN = "not_decided"
KINDS = "gent,gent,neo-hookean,mooney-rivlin,ogden,eight-chain,electrostrictive"


class Answer(dict):
    """What one way says of a scene: regime, and voltages of the first snap and of breakdown where it knows them."""


def of_ramps(ramps, i: int) -> Answer:
    if ramps.regime[i] == dj.Regime.not_decided:
        return Answer(regime=OPEN)
    found = Answer(regime=dj.Regime(int(ramps.regime[i])).name)
    for name, value in (("snap", ramps.snap.voltage[i, 0]), ("breakdown", ramps.breakdown.voltage[i])):
        if np.isfinite(value):
            found[name] = float(value)
    return found


def of_events(regime: dj.Regime, events) -> Answer:
    found = Answer(regime=regime.name)
    up = [e for e in events if e.direction == "up"]
    for name, kind, reason in (("snap", "snap", None), ("breakdown", "breakdown", "breakdown on the branch")):
        states = [e.state for e in up if e.event == kind and (reason is None or e.reason == reason)]
        if states and regime != dj.Regime.not_decided:
            found[name] = float(states[0].voltage)
    return found


def refused(error: Exception) -> Answer:
    return Answer(regime=OPEN, refused=str(error)[:80])


def by_diagram(scene) -> Answer:
    try:
        diagram = dj.voltage_volume(scene)
    except (ValueError, dj.SceneError) as error:
        return refused(error)
    return of_events(dj.diagram.regimes.regime_of_diagram(diagram), diagram.events)


def by_glance(scene, surface) -> Answer:
    try:
        seen = dj.glance(scene, surface)
    except (ValueError, dj.SceneError) as error:
        return refused(error)
    return of_events(seen.regime, seen.events)


def parameters_of(loading) -> dict:
    """The parameters of a loading by their names, those that a sweep varies."""
    if isinstance(loading, dj.ConstantPressure):
        return {"pressure": float(loading.pressure)}
    filling = "initial_volume" if loading.initial_volume is not None else "initial_pressure"
    names = {"chamber_volume": "volume", filling: filling}
    names |= {n: n for n in ("atmospheric_pressure", "polytropic_exponent")}
    return {name: float(getattr(loading, field)) for name, field in names.items()}


def by_sweep(scene, columns: dict, engine: str) -> list[Answer]:
    data = dj.sweep(scene, dj.sweeps.zipped(**columns), engine=engine, progress=False)
    found = []
    for i, code in enumerate(data.regime.values):
        answer = Answer(regime=dj.Regime(int(code)).name)
        for name, value in (("snap", data.snap_voltage.values[i, 0]), ("breakdown", data.breakdown_voltage.values[i])):
            if np.isfinite(value) and answer["regime"] != OPEN:
                answer[name] = float(value)
        found.append(answer)
    return found


def by_surface(surface, columns: dict) -> list[Answer]:
    columns = {name: np.array(values) for name, values in columns.items()}
    if "pressure" in columns:
        ramps = dj.diagram.pressure_ramps(surface, columns["pressure"])
    else:
        if "initial_pressure" in columns:
            filled = dj.diagram.filling_volumes(surface, columns.pop("initial_pressure"))
            columns["initial_volume"] = np.where(np.isfinite(filled), filled, 1e-300)
        ramps = dj.diagram.chamber_ramps(
            surface, columns.pop("chamber_volume"), columns.pop("initial_volume"), **columns
        )
    return [of_ramps(ramps, i) for i in range(len(ramps.outcome))]


def by_designs(scene, columns: dict, surface) -> list[Answer]:
    found = dj.classify_designs(scene, columns, surface=surface)
    return [Answer(regime=dj.Regime(int(r)).name) for r in found.regime]


def by_loading(scenes: list, which) -> list[tuple[list[int], dict]]:
    """Those scenes whose loadings have the same parameters together: their numbers, and the columns of their values."""
    groups = collections.defaultdict(list)
    for i in which:
        groups[tuple(parameters_of(scenes[i].loading))].append(i)
    tables = [(own, [parameters_of(scenes[i].loading) for i in own]) for own in groups.values()]
    return [(own, {name: [row[name] for row in table] for name in table[0]}) for own, table in tables]


def asked_in_every_way(scenes: list, whole, spent=None) -> list[dict]:
    """The answers of scenes that share a membrane, by way; `whole(answers)` says whether to ask the costly ways too."""
    membrane, spent = scenes[0].membrane, collections.Counter() if spent is None else spent
    answers: list[dict] = [{} for _ in scenes]

    def timed(way, ask):
        watch = harness.Stopwatch()
        found = watch.time(ask)
        spent[way] += watch.seconds
        return found

    try:
        surface = timed("build", lambda: dj.Surface.build(membrane))
    except ValueError:  # no part of the chart meets the tolerance
        surface = None
    batch = timed("batch", lambda: dj.continue_scenes(scenes).ramps)
    for i, scene in enumerate(scenes):
        answers[i]["batch"] = of_ramps(batch, i)
        if surface is not None:
            answers[i]["glance"] = timed("glance", lambda scene=scene: by_glance(scene, surface))
    for own, columns in by_loading(scenes, range(len(scenes))):
        ways = {
            "sweep by continuation": lambda c=columns, s=scenes[own[0]]: by_sweep(s, c, "continuation"),
            "sweep on the surface": lambda c=columns, s=scenes[own[0]]: by_sweep(s, c, "surface"),
        }
        if surface is not None:
            ways["surface"] = lambda c=columns: by_surface(surface, c)
        for way, ask in ways.items():
            for i, answer in zip(own, timed(way, ask), strict=True):
                answers[i][way] = answer
    chosen = [i for i in range(len(scenes)) if whole(answers[i])]
    for i in chosen:
        answers[i]["diagram"] = timed("diagram", lambda scene=scenes[i]: by_diagram(scene))
    for own, columns in by_loading(scenes, chosen) if surface is not None else []:
        found = timed("designs", lambda c=columns, s=scenes[own[0]]: by_designs(s, c, surface))
        for i, answer in zip(own, found, strict=True):
            answers[i]["designs"] = answer
    return answers


def disagree(answers: dict) -> bool:
    """Whether two definite answers differ."""
    definite = [a for a in answers.values() if a["regime"] != OPEN]
    if len({a["regime"] for a in definite}) > 1:
        return True
    for name in ("snap", "breakdown"):
        known = [a[name] for a in definite if name in a]
        if known and max(known) ** 2 - min(known) ** 2 > ALLOWED * max(max(known) ** 2, 1e-3):
            return True
    return False


def main() -> int:
    quick = "60 scenes of three Gent membranes, each by its whole diagram too; no polytropic gas"
    parser = harness.arguments(__doc__, quick, seed=True)
    parser.add_argument("--scenes", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=np.inf, help="ends after so many minutes")
    parser.add_argument("--each", type=int, default=10, help="scenes of a membrane")
    parser.add_argument("--share", type=float, default=0.1, help="of the scenes that are asked in the costly ways too")
    parser.add_argument("--kinds", help=f"materials, separated by commas, by default {KINDS}")
    options = parser.parse_args()
    if options.quick:
        options.scenes, options.each, options.share = 60, 20, 1.0
    random = np.random.default_rng(options.seed)
    kinds = (options.kinds or ("gent" if options.quick else KINDS)).split(",")
    harness.say(f"seed {options.seed}")
    spent, undecided = collections.Counter(), collections.Counter()
    asked, differing, regimes = collections.Counter(), [], collections.Counter()
    done, members = 0, 0
    until = time.monotonic() + 60 * options.minutes
    while done < options.scenes and time.monotonic() < until:
        membrane = random_scenes.film_of(kinds[members % len(kinds)], random)
        members += 1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            count = min(options.each, options.scenes - done)
            scenes = random_scenes.scenes_of(membrane, count, not options.quick, random)
            found = asked_in_every_way(
                scenes, lambda answers: disagree(answers) or random.uniform() < options.share, spent
            )
        done += len(found)
        for scene, answers in zip(scenes, found, strict=True):
            for way, answer in answers.items():
                asked[way] += 1
                undecided[way] += answer["regime"] == OPEN
            regimes[next((a["regime"] for a in answers.values() if a["regime"] != OPEN), OPEN)] += 1
            if disagree(answers):
                differing.append({"scene": dj.model.describe(scene), "answers": dict(answers)})
                harness.say(differing[-1])
        if options.quick or members % 5 == 0 or done == options.scenes:
            left = {way: round(undecided[way] / asked[way], 4) for way in asked}
            harness.say(f"{done} scenes, {len(differing)} differ, undecided {left}")
            harness.say({w: round(v, 1) for w, v in spent.items()})
    document = {
        "name": "one_answer",
        "parameters": {"scenes": done, "seed": options.seed, "share": options.share},
        "asked": dict(asked),
        "undecided": dict(undecided),
        "regimes": dict(regimes),
        "differing": differing,
        "milliseconds_per_scene": {w: 1e3 * spent[w] / max(asked.get(w, done), 1) for w in spent},
        "machine": harness.machine(),
    }
    harness.say(f"{done} scenes, {len(differing)} with two different answers")
    return harness.finish(document, options.json, not differing)


if __name__ == "__main__":
    sys.exit(main())
