"""Every benchmark runs in its quick setting and prints one record that can be read again."""

import json
import pathlib
import subprocess
import sys

import pytest

from benchmarks import harness
from benchmarks.truth import chambers

ROOT = pathlib.Path(__file__).parents[2]


def quick(script: str, tmp_path, *more) -> tuple[dict, str]:
    """The JSON document of one run, and its text on standard error."""
    pytest.importorskip("scipy")
    command = [sys.executable, "-m", f"benchmarks.{script}", "--quick", "--json", "-", *more]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout, done.stderr
    return json.loads(done.stdout), done.stderr  # one document, whatever is written on the way


def test_calls_are_timed_in_turn():
    asked = []

    def call(name):
        return lambda: asked.append(name) or len(asked)

    timings = harness.timed_in_turn({"a": call("a"), "b": call("b")}, 2)
    assert asked == ["a", "b"] * 3  # once to compile, then turn by turn
    assert timings["a"].values == [3, 5] and timings["b"].value == 6
    assert all(len(t.seconds) == len(t.cpu_seconds) == 2 and t.best <= t.median for t in timings.values())
    alone = harness.timed(call("c"), 0)  # without warm rounds the first call counts
    assert alone.values == [7] and alone.best == alone.first and alone.compile_seconds == 0
    reported = iter((9.0, 3.0, 2.0, 4.0))
    own = harness.timed(lambda: next(reported), 3, reported=lambda value: value)
    assert (own.first, own.best, own.median, own.value_of_best, own.compile_seconds) == (9, 2, 3, 2, 7)
    asked.clear()
    harness.timed(call("d"), 1, shortest=0.05)
    assert len(asked) > 10  # a round of a quick call repeats it


def test_partial_records_go_to_files_only(tmp_path, capsys):
    file = tmp_path / "record.json"
    for count in (1, 2):
        harness.write({"records": list(range(count))}, "-", partial=True)
        harness.write({"records": list(range(count))}, str(file), partial=True)
        assert json.loads(file.read_text()) == {"records": list(range(count))}
    assert capsys.readouterr().out == ""
    harness.write({"records": [0.5, float("nan")]}, "-")
    assert json.loads(capsys.readouterr().out) == {"records": [0.5, None]}


def test_the_estimates_of_a_few_states_are_honest(tmp_path):
    record, said = quick("acceptance.error_honesty", tmp_path)
    counts = record["counts"]
    assert counts["states"] == counts["converged"] == 12, said
    assert counts["exceptions"] == counts["ratio_above_allowed"] == counts["truth_not_sharp_enough"] == 0, said
    assert record["ratio"]["max"] <= 10
    # the reference itself, which SciPy's integrator in double precision reproduces
    assert record["truth_against_scipy"]["largest_difference"] < 1e-9


def test_the_indices_of_a_few_states_are_those_of_the_eigenvalues(tmp_path):
    record, said = quick("acceptance.stability", tmp_path)
    counts = record["counts"]
    assert counts["states"] == 40 and counts["valid"] > 200 and counts["wrong"] == counts["ritz_unsure"] == 0, said
    assert counts["valid"] == counts["equal"] + counts["equal_on_finer"]
    assert {"0", "1"} <= set(record["index"])


def test_two_diagrams_agree_with_a_finer_scan(tmp_path):
    record, said = quick("acceptance.agreement", tmp_path)
    assert record["counts"]["agreement"] == record["counts"]["scenes"] == 2, said
    assert record["largest_difference"] < 1e-6
    assert record["counts"]["fold"] == 2  # the second scene snaps: without a fold nothing was compared
    assert all(r["complete"] for r in record["records"])


def test_modes_agree_with_those_of_more_functions(tmp_path):
    record, said = quick("acceptance.modes", tmp_path)
    assert record["wrong_indices"] == 0 and record["largest_ratio"] <= 10, said
    assert record["records"][0]["undecided"] == 0 < record["records"][0]["indices"], said


def test_lowest_eigenpairs_are_those_of_lapack(tmp_path):
    record, said = quick("speed.eigenpairs", tmp_path)
    assert {r["way"] for r in record["records"]} == {"bisection", "lapack"}, said
    assert all(r["error"] < 1e-13 for r in record["records"]), said


def test_spectra_are_measured_and_right(tmp_path):
    record, said = quick("speed.modes", tmp_path)
    assert [r["name"] for r in record["records"]] == ["shot", "1e-08"], said
    assert record["records"][1]["error"] < 1e-8, said


def test_ramps_in_time_are_measured_and_right(tmp_path):
    record, said = quick("speed.rates", tmp_path)
    assert [r["count"] for r in record["records"]] == [1, 4, 1], said
    assert all(r["error"] < 1e-6 for r in record["records"]), said


def test_the_first_diagram_is_measured_and_right(tmp_path):
    record, said = quick("speed.first_diagram", tmp_path)
    names = [r["name"] for r in record["records"]]
    assert names == ["first_diagram: empty cache", "first_diagram: filled cache", "first_diagram: warm"], said
    for r in record["records"]:
        assert r["error"] < 1e-9
        assert 0 < r["seconds_per_diagram"] < 600
        assert {"engine", "parameters", "compile_seconds", "counts", "machine", "calibration_seconds"} <= set(r)
    empty, filled, warm = record["records"]
    assert filled["compile_seconds"] < empty["compile_seconds"]
    assert warm["seconds_per_diagram"] < filled["seconds_per_diagram"]
    stages = "stages_summed_over_threads"
    assert filled[stages]["compile"] < empty[stages]["compile"] and filled[stages]["load"] > 0


def test_random_protocols_end_with_a_reason_as_finer_runs_do(tmp_path):
    record, said = quick("acceptance.protocols", tmp_path)
    assert record["counts"] == {"agrees": 2} and record["differing"] == record["open"] == [], said
    assert record["largest_error"] <= record["parameters"]["allowed"] and sum(record["reasons"].values()) == 2


def test_sixty_random_scenes_have_one_answer_in_every_way(tmp_path):
    record, said = quick("acceptance.one_answer", tmp_path)
    assert "PASSED" in said and record["differing"] == []
    assert set(record["asked"].values()) == {60} and len(record["asked"]) == 7
    # the complete methods leave nothing undecided, and the fast methods decide most scenes
    assert record["undecided"]["diagram"] == record["undecided"]["designs"] == 0
    assert max(record["undecided"].values()) <= 20


def test_chambers_on_the_surface_agree_with_continuation(tmp_path):
    record, said = quick("acceptance.ensemble", tmp_path)
    assert record["compared"] >= 6 and not record["differing"], said
    assert record["largest_difference"] < 1e-8
    group = record["groups"][0]
    assert group["scenes"] == group["compared"] + group["unresolved"] == 12
    assert group["microseconds_per_scene"] > 0


def test_our_engines_are_right_beside_a_peer_or_alone(tmp_path):
    record, said = quick("speed.peers", tmp_path)
    ours = [r for r in record["records"] if not r["engine"].startswith("AUTO")]
    names = [r["engine"] for r in ours]
    assert names == ["continuation", "surface, certified", "surface alone", "glance", "ramp, one of 12"], said
    for r in ours:
        assert r["fold_error"] < 1e-9 and r["breakdown_error"] < 1e-9
        assert r["seconds"] > 0
    if record["auto"] == "AUTO-07p: not installed":
        assert record["auto"] in said and len(ours) == len(record["records"])


def test_a_small_sweep_is_right_and_measured(tmp_path):
    record, said = quick("speed.sweep", tmp_path)
    assert sum(record["outcomes"].values()) == 512, said
    assert record["outcomes"]["unresolved"] < 256
    assert record["largest_error_bound"] <= 1e-8 and 0 < record["largest_curve_error"] < 1e-7
    for g in record["groups"]:
        assert not g["missing"] and g["difference"] < 1e-7
        assert g["microseconds_per_ramp"] > 0 and g["microseconds_per_curve"] > 0
    assert record["gigabytes"] > 0


def test_labelled_sweeps_are_measured_and_right(tmp_path):
    record, said = quick("speed.sweep_throughput", tmp_path)
    executors = [(r["engine"], r["executor"]) for r in record["records"] if r["name"].endswith("executors")]
    assert ("surface", "in process") in executors and ("continuation", "processes") in executors, said
    for r in record["records"]:
        assert r["scenes_per_second"] > 0 and r["error"] < 1e-8 and r["decided"] > 200
    assert [r["scenes"] for r in record["records"] if r["name"].endswith("sizes")] == [100, 1000]


def test_a_killed_sweep_loses_nothing(tmp_path):
    record, said = quick("acceptance.sweep_faults", tmp_path)
    assert record["kills"] == 3 and record["stores_finished"] >= 1 and record["wrong"] == [], said


def test_a_process_of_many_scenes_stays_small(tmp_path):
    record, said = quick("acceptance.memory", tmp_path)
    first, last = record["blocks"]
    assert last["scenes"] == 4 and last["compiled"] < first["compiled"], said
    assert last["gigabytes"] < 1.5 and last["maps"] < 20_000 and last["programs"] > 0


def test_a_surface_is_as_exact_as_it_says(tmp_path):
    record, said = quick("acceptance.surface_error", tmp_path)
    assert record["states"] == 200 and record["not_sharp"] < 100, said
    assert 0 < record["largest_ratio"] <= 10


def test_the_references_of_the_chambers_agree_with_what_is_known():
    found = chambers.reference()
    assert len(found) == 256
    # between these chamber volumes two folds have merged; below the last the landing lies beyond breakdown
    bare = [c for c, one in found.items() if not one.folds]
    assert bare == [c for c in found if 484.04966 < c < 551.39914]
    assert all(one.landing is not None for c, one in found.items() if c not in bare)
    # bistability begins at V_C = 1455.896
    assert all((len(one.zero_voltage) == 2) == (c > 1455.896) for c, one in found.items())
    lines = (chambers.DATA / "chambers.csv").read_text().splitlines()[1:]
    assert max(float(line.rsplit(",", 1)[1]) for line in lines) < 1e-12


def test_missing_and_false_folds_are_counted():
    truth = chambers.reference()
    bare = next(c for c, one in truth.items() if not one.folds)
    last = list(truth)[-1]
    found = {
        last: chambers.Found(truth[last].folds[1:], truth[last].zero_voltage, truth[last].breakdown),
        bare: chambers.Found([(0.01, 3.0)], [], truth[bare].breakdown, chambers.NAN),
    }
    judged = chambers.judge(found, truth)
    assert judged["counts"]["missing_folds"] == judged["counts"]["false_folds"] == 1
    assert judged["counts"]["wrong_lanes"] == 2 and judged["error"] == 0
    shifted = {last: chambers.Found([(q + 1e-7, v) for q, v in truth[last].folds], None, truth[last].breakdown)}
    assert 8e-7 < chambers.judge(shifted, truth)["error"] < 9e-7


def test_a_batch_of_chambers_is_right_by_every_engine(tmp_path):
    record, said = quick("speed.batch_diagrams", tmp_path, "--engines", "auto,surface,scipy_shooting,scipy_solve_bvp")
    engines = {r["engine"] for r in record["records"]}
    assert {"surface", "scipy_shooting", "scipy_solve_bvp"} <= engines, said
    assert "auto" in engines or record["missing"] == ["AUTO-07p: not installed"]
    for r in record["records"]:
        assert r["counts"]["missing_folds"] == r["counts"]["false_folds"] == 0, r
        assert r["error"] < (1e-6 if "scipy" in r["engine"] else 1e-8), r
        assert 0 < r["seconds_per_diagram"] < 60


def test_the_time_of_a_lane_is_taken_apart(tmp_path):
    record, said = quick("speed.lane_profile", tmp_path)
    assert record["error"] < 1e-8 and "PASSED" in said
    assert [r["phase"] for r in record["records"]] == ["march", "events", "loads", "host"]
    assert sum(r["share"] for r in record["records"]) == pytest.approx(1)
    assert all(r["calls"] > 0 for r in record["records"][:3])


def test_work_precision_diagrams_are_drawn(tmp_path):
    record, said = quick("speed.work_precision", tmp_path, "--output", tmp_path)
    assert set(record["records"]) == {"shot", "map", "pressure_volume"}, said
    for name, records in record["records"].items():
        assert (tmp_path / "figures" / f"work_precision_{name}.png").stat().st_size > 10_000
        assert all(r["error"] < 1e-2 and r["seconds"] > 0 for r in records)
    ours = [r for r in record["records"]["shot"] if r["engine"].startswith("dielectric_jax")]
    assert min(r["error"] for r in ours) < 1e-9
    text = (tmp_path / "work_precision.md").read_text()
    assert text.count("| dielectric_jax") >= len(ours)


def test_the_cost_of_a_scene_is_told_beside_its_error(tmp_path):
    record, said = quick("speed.cost_of_a_scene", tmp_path)
    tables = {r["name"] for r in record["records"]}
    assert tables == {f"cost_of_a_scene: {t}" for t in ("integration", "equilibrium", "diagram")}, said
    assert all(r["ratio"] > 0 and (r["error"] is None or r["error"] < 1e-9) for r in record["records"])


def test_some_hard_cases_make_a_table(tmp_path):
    table = tmp_path / "table.md"
    record, said = quick("acceptance.hard_cases", tmp_path, "--case", "6", "10", "--table", table)
    assert len(record["records"]) >= 8 and all(r["right"] for r in record["records"]), said
    for r in record["records"]:
        assert {"name", "engine", "parameters", "error", "seconds_per_diagram", "compile_seconds", "counts"} <= set(r)
        assert {"true", "known_by", "answered", "machine"} <= set(r)
    text = table.read_text(encoding="utf-8")
    assert "## 6. Volume at lock-up" in text and "## 10. Beyond slack" in text and "## 7." not in text
    assert text.count("| yes |") == len(record["records"])


def test_some_hard_scenes_are_counted(tmp_path):
    record, said = quick("acceptance.hard_scenes", tmp_path)
    ramps, sample = record["records"]
    assert ramps["engine"] == "surface" and sample["engine"] == "continuation", said
    counts = ramps["counts"]
    outcomes = {k: v for k, v in counts.items() if k not in ("scenes", "half_decided")}
    assert counts["scenes"] == sum(outcomes.values()) == 64 and counts["half_decided"] == 0
    assert sample["counts"]["compared"] >= 2 and sample["counts"]["differing"] == 0, said
    assert sample["error"] < 1e-8 and ramps["error"] <= 1e-8


def test_a_few_gradients_are_audited(tmp_path):
    record, said = quick("acceptance.gradient_audit", tmp_path)
    rows = record["records"]
    assert {r["kind"] for r in rows} == {"snap voltage", "area strain"}, said
    assert all(r["relative_difference"] < 1e-6 for r in rows), said


def test_fold_curves_and_their_known_numbers(tmp_path):
    record, said = quick("acceptance.fold_curves", tmp_path)
    assert max(record["errors_in_last_digits"].values()) <= 1, said
    assert record["difference_between_search_and_curve"] < 1e-10 and 0 < record["difference_from_surface"] < 1e-9
    assert record["compared_with_surface"] > 20
    # none between the cusps; above them a snap, and a snap-back up to the onset of bistability
    folds = [c["parameter"] for c in record["curves"]["chamber_volume"]["curves"] if c["kind"] == "fold"]
    assert len(folds) == 2 and not any(484.0497 < v < 551.3991 for curve in folds for v in curve)
    assert record["curves"]["chamber_volume"]["complete"]


def test_two_designs_are_no_worse_than_scans(tmp_path):
    record, said = quick("acceptance.design_problems", tmp_path)
    assert len(record["problems"]) == 2 and record["good"], said
    for problem in record["problems"].values():
        assert problem["scan"]["designs"] >= 1000 and problem["active"] == ["survival_margin"]
        assert 0 <= problem["scan"]["gain"] < 0.1


def test_some_parameters_go_through_some_verbs(tmp_path):
    record, said = quick("acceptance.parameters", tmp_path)
    assert record["counts"] == {"agrees": 4, "refused": 6, "wrong": 0}, said
    refused = {
        r["parameter"] for r in record["records"] if r["verb"] == "classify_designs" and r["answer"] == "refused"
    }
    assert refused == {"c1"}
