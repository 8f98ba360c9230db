"""How much time does a digit cost, here and with peers? Work–precision diagrams, and the same numbers as a table.

Four comparisons: one shot from apex to rim; the explicit map (apex stretch, q) → (p, V); one pressure–volume diagram; and
the batch of 256 chambers, whose records `batch_diagrams.py` writes. Errors are against extended-precision references, good to
1e-12. `--records` writes what was measured, and draws from it without measuring when it is there and `--draw` is given.

    AUTO_DIR=… python -m benchmarks.speed.work_precision [--batch FILE] [--records FILE] [--draw] [--output docs] [--quick]
"""

import json
import pathlib
import sys

import jax
import matplotlib as mpl
import matplotlib.pyplot as plt

from benchmarks import harness
from benchmarks.speed import curves, shots

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

DOCS = pathlib.Path(__file__).parents[2] / "docs"
# the palette of Okabe and Ito, which colour-blind readers can tell apart; a marker of its own for each line
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31", "#666666", "#B22222")
MARKERS = "os^vDPX*<>pd"
FLOOR = 1e-14  # of errors drawn on a logarithmic axis
TITLES = {
    "shot": "One shot from apex to rim (state and volume)",
    "map": "Explicit map: apex stretch and voltage to pressure and volume",
    "pressure_volume": "One pressure–volume diagram at Φ = 0.05, to V = 450",
    "batch": "Voltage–volume diagrams of 256 chambers",
}
ERRORS = {
    "shot": "largest relative error over the states",
    "map": "largest relative error over the states",
    "pressure_volume": "largest error of the fold pressures, p",
    "batch": "largest error of the fold voltages, Φ",
}


def batch_records(path: pathlib.Path) -> list[dict]:
    """The records of `batch_diagrams.py` in the form of the others."""
    document = json.loads(path.read_text())
    names = {name: f"dielectric_jax, {name}" for name in ("continuation", "surface")}
    names |= {"auto": "AUTO-07p", "scipy_shooting": "SciPy DOP853 shooting", "scipy_solve_bvp": "SciPy solve_bvp"}
    out = []
    for r in document["records"]:
        engine = names.get(r["engine"], r["engine"])
        if "stepping" in r["parameters"]:
            engine += f", {r['parameters']['stepping']} steps"
        elif "unresolved" in r["parameters"]:
            engine += ", the rest certified"
        elif r["parameters"].get("batched") is False:
            engine += ", one by one"
        counts = r["counts"]
        wrong = counts["missing_folds"] + counts["false_folds"] + counts["wrong_lanes"]
        out.append(
            {
                "name": "batch",
                "engine": engine,
                "parameters": r["parameters"],
                "error": r["error"],
                "seconds": r["seconds_per_diagram"],
                "compile_seconds": r["compile_seconds"],
                "counts": counts,
                "incomplete": wrong > 0,
            }
        )
    return out


def panels(name: str, records: list[dict]) -> list[tuple[str, list[dict]]]:
    """What is drawn side by side: single states and batches apart."""
    if name not in ("shot", "map"):
        return [("", records)]
    alone = [r for r in records if r["parameters"]["batch"] == 1]
    batch = [r for r in records if r["parameters"]["batch"] > 1]
    size = max((r["parameters"]["batch"] for r in batch), default=0)
    return [("one state alone", alone), (f"{size} states at once", batch)]


def solver_of(engine: str) -> str:
    """The engine without how it steps."""
    for end in (", graded grid", ", PID controller", ", natural steps", ", arclength steps"):
        engine = engine.removesuffix(end)
    return engine


def draw(name: str, records: list[dict], path: pathlib.Path) -> None:
    """One figure: error against time, a line an engine; hollow where folds or lanes are missing or wrong."""
    parts = panels(name, records)
    engines = list(dict.fromkeys(r["engine"] for r in records))
    # the two ways to step of one solver have one colour
    solvers = list(dict.fromkeys(solver_of(e) for e in engines))
    style = {e: (COLOURS[solvers.index(solver_of(e))], MARKERS[i % len(MARKERS)]) for i, e in enumerate(engines)}
    figure, axes = plt.subplots(
        1, len(parts), figsize=(12, 6.4), sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    unit, factor = ("µs a state", 1e6) if name in ("shot", "map") else ("ms a diagram", 1e3)
    lines = {}
    for ax, (title, own) in zip(axes[0], parts, strict=True):
        for engine in engines:
            rows = [r for r in own if r["engine"] == engine and r["error"] and r["error"] < 1]
            if not rows:
                continue
            colour, marker = style[engine]
            x = [r["seconds"] * factor for r in rows]
            y = [max(r["error"], FLOOR) for r in rows]
            dashes = "--" if "PID" in engine or "arclength" in engine else "-"
            drawn = dashes if name != "batch" or engine != "AUTO-07p" else ""
            whole = [not r.get("incomplete", False) for r in rows]
            ax.plot(x, y, drawn, color=colour, lw=1.6, alpha=0.8)
            for filled in (True, False):
                at = [k for k, w in enumerate(whole) if w == filled]
                face = colour if filled else "white"
                ax.plot([x[k] for k in at], [y[k] for k in at], marker, color=colour, ms=8, mfc=face, mew=1.6)
            lines[engine] = mpl.lines.Line2D([], [], color=colour, marker=marker, ms=8, ls=dashes, label=engine)
        ax.set(xscale="log", yscale="log", xlabel=f"time, {unit} (warm)")
        ax.set_title(title, fontsize=13)
        ax.grid(True, which="major", color="0.85", lw=0.8)
        ax.tick_params(labelsize=12)
        ax.xaxis.label.set_size(13)
    axes[0, 0].set_ylabel(ERRORS[name], fontsize=13)
    figure.suptitle(TITLES[name], fontsize=14, x=0.02, ha="left")
    if any(r.get("incomplete") for r in records):
        hollow = mpl.lines.Line2D([], [], color="0.3", marker="o", ms=8, mfc="white", ls="", mew=1.6)
        hollow.set_label("hollow: some lanes missing or wrong")
        lines["hollow"] = hollow
    figure.legend(handles=list(lines.values()), loc="outside right upper", fontsize=11, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def settings(parameters: dict) -> str:
    own = {k: v for k, v in parameters.items() if k not in ("batch", "threads", "batched")}
    return ", ".join(f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in own.items()).replace("_", " ")


def table(name: str, records: list[dict]) -> list[str]:
    """The records as lines of Markdown."""
    single = name in ("shot", "map")
    unit, factor = ("µs", 1e6) if single else ("ms", 1e3)
    head = f"| engine | setting | {'at once | ' if single else ''}{unit} | error |{' missing / false folds, wrong lanes |' if name == 'batch' else ''}"
    lines = [f"## {TITLES[name]}", "", f"![{TITLES[name]}](figures/work_precision_{name}.png)", "", head]
    lines.append("|" + "---|" * (head.count("|") - 1))
    for r in records:
        cells = [r["engine"], settings(r["parameters"])]
        cells += [str(r["parameters"]["batch"])] if single else []
        cells += [f"{r['seconds'] * factor:.3g}", "–" if r["error"] is None else f"{r['error']:.1e}"]
        if name == "batch":
            c = r["counts"]
            cells.append(f"{c['missing_folds']} / {c['false_folds']}, {c['wrong_lanes']} of {c['lanes']}")
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def main() -> int:
    parser = harness.arguments(__doc__, "few states and settings")
    parser.add_argument("--batch", type=pathlib.Path, metavar="FILE", help="records of batch_diagrams.py")
    parser.add_argument("--records", dest="json", metavar="FILE", help="the same as --json")
    parser.add_argument("--draw", action="store_true", help="draw what --records holds, measure nothing")
    parser.add_argument("--output", type=pathlib.Path, default=DOCS, help="folder of table and figures")
    options = parser.parse_args()
    if not options.quick:
        harness.without_cache()
    if options.draw:
        document = json.loads(pathlib.Path(options.json).read_text())
    else:
        makers = {"shot": shots.shot_records, "map": shots.map_records, "pressure_volume": curves.records}
        document = {"name": "work_precision", "machine": harness.machine(), "records": {}}
        for name, make in makers.items():
            document["records"][name] = make(options.quick)
            harness.say(f"{name}: {len(document['records'][name])} records")
            harness.write(document, options.json, partial=True)
    if options.batch is not None:
        document["records"]["batch"] = batch_records(options.batch)
    elif "batch" not in document["records"]:
        harness.say("batch: no records given (--batch)")
    machine = document["machine"]
    lines = [
        "# Work and precision",
        "",
        "Written by `benchmarks/speed/work_precision.py`. Errors are against references in extended precision, good to 1e-12;",
        "times are warm, without compiling, and those of AUTO-07p without the start of its process. Ratios carry over to",
        "another machine, seconds do not. What each row holds is in the docstrings of `benchmarks/speed/shots.py`, `curves.py`",
        "and `batch_diagrams.py`. AUTO-07p prints eleven digits, so that its smallest errors are chance.",
        "",
        f"Measured on {machine['processor']}, {machine['cores']} cores, jax {machine['jax']}.",
        "",
    ]
    for name, records in document["records"].items():
        draw(name, records, options.output / "figures" / f"work_precision_{name}.png")
        lines += table(name, records)
    (options.output / "work_precision.md").write_text("\n".join(lines))
    harness.say(f"written: {options.output / 'work_precision.md'} and its figures")
    return harness.finish(document, options.json, True)


if __name__ == "__main__":
    sys.exit(main())
