"""Documents of the command line as readable tables."""

from collections.abc import Sequence

from ..model import number_text, text_table
from ..numerics import Code

__all__ = ["summary"]


def _range(values: Sequence[float | None]) -> str:
    known = [v for v in values if v is not None]
    return f"{min(known):.6g} to {max(known):.6g}" if known else "–"


def summary(document: dict) -> str:
    """A readable summary of a JSON document of this program."""
    if "store" in document:
        counts = [[name, code, n] for name in ("outcome", "regime") for code, n in document[name].items()]
        title = f"{document['scenes']} scenes in {document['store']}, {document['seconds']:.1f} s"
        return "\n".join([title, text_table(("variable", "code", "scenes"), counts)])
    if "diagrams" in document:
        return "\n\n".join(summary(d) for d in document["diagrams"])
    if "runs" in document:
        return "\n\n".join(summary(d) for d in document["runs"])
    if "error" in document:
        return document["error"]
    units = document.get("unit_names", {})
    scene = ", ".join(
        f"{k} {number_text(v)}{_unit_of(k, units) if isinstance(v, float) else ''}"
        for k, v in document["scene"].items()
        if v is not None and k != "branches"
    )
    lines = [f"scene: {scene} ({document['units']})"]
    if "intervals" in document:
        return "\n".join([*lines, *_fit_lines(document)])
    if "boundaries" in document:
        return "\n".join([*lines, *_map_lines(document, units)])
    if "multipliers" in document:
        return "\n".join([*lines, *_design_lines(document, units)])
    if "events" in document:
        return "\n".join([*lines, *_run_lines(document, units)])
    if "modes" in document:
        return "\n".join([*lines, *_mode_lines(document, units)])
    if "states" in document:
        return "\n".join([*lines, *_state_lines("states", document["states"], (), units)])
    complete = "yes" if document["complete"] else "no, scan and engine disagree"
    lines.append(f"engine: {document['engine']}, tolerance {document['tolerance']:g}, complete: {complete}")
    lines += _branch_lines(document["branches"], units)
    if document["special_points"]:
        lines += _state_lines("special points", document["special_points"], ("kind", "branch"), units)
    if document["ramp"]:
        charge = ("charge",) if "charge" in document["ramp"][0] else ()
        names = (
            "event",
            "direction",
            "voltage",
            *charge,
            "pressure",
            "volume",
            "apex_stretch",
            "breakdown_ratio",
            "reason",
        )
        lines += ["", "ramp", text_table(_heads(names, units), [[e[n] for n in names] for e in document["ramp"]])]
    if document["area_strain_reason"] is not None:
        lines += ["", f"area strain: {number_text(document['area_strain'])} ({document['area_strain_reason']})"]
    return "\n".join(lines)


def _fit_lines(document: dict) -> list[str]:
    share, unit = f"{100 * document['level']:g} %", document["noise_unit"]
    # the stated digits are those of a measurement
    rows = [
        [
            name,
            *("–" if v is None else f"{v:.6g}" for v in (value, *document["intervals"][name])),
            _of_constant(name, unit),
        ]
        for name, value in document["parameters"].items()
    ]
    measured = "stress" if "stress" in document else "pressure"
    lines = [
        "",
        text_table(["constant", "value", f"{share} from", "to", ""], rows),
        f"noise of one {measured}: {document['noise']:.4g} {unit}",
    ]
    return [*lines, *document.get("notices", ()), *(f"warning: {w}" for w in document["warnings"])]


def _of_constant(name: str, unit: str) -> str:
    """The unit of a fitted constant, empty if it has none."""
    return unit if name == "pressure_offset" or (name == "shear_modulus" and unit == "Pa") else ""


def _map_lines(document: dict, units: dict[str, str]) -> list[str]:
    every = [code for row in document["regimes"] for code in row]
    shares = [[name, every.count(int(code)) / len(every)] for code, name in document["names"].items()]
    rows = [
        [" | ".join(b["regimes"]), b["kind"] or "bisection", len(b[document["over"][0]])]
        + [_range(b[name]) for name in document["over"]]
        for b in document["boundaries"]
    ]
    header = ["boundary", "kind", "points", *_heads(document["over"], units)]
    return ["", text_table(["regime", "share"], [r for r in shares if r[1]]), "", text_table(header, rows)]


def _design_lines(document: dict, units: dict[str, str]) -> list[str]:
    rows = [[n, v, n in document["active"], document["multipliers"].get(n)] for n, v in document["slack"].items()]
    lines = ["", *(f"{n}: {number_text(v)}{_unit_of(n, units)}" for n, v in document["parameters"].items())]
    lines += [f"area strain: {number_text(document['area_strain'])} ({document['regime']})"]
    return [*lines, "", text_table(["constraint", "left", "active", "multiplier"], rows)]


def _mode_lines(document: dict, units: dict[str, str]) -> list[str]:
    rows = [
        [m["number"], m["index"], *m["eigenvalues"], *(m["frequency"] or []), f"{m['error_estimate']:.1e}"]
        for m in document["modes"]
    ]
    first = document["modes"][0]
    head = ["n", "index", *(f"eigenvalue {k + 1}" for k in range(len(first["eigenvalues"])))]
    head += [f"frequency {k + 1} [Hz]" for k in range(len(first["frequency"] or []))]
    least = f"least hoop stress: {number_text(document['hoop_tension'])}{_unit_of('hoop_tension', units)}"
    return [
        *_state_lines("state", [document["state"]], (), units),
        "",
        "modes",
        text_table([*head, "error"], rows),
        least,
    ]


def _branch_sentences(branches: Sequence[dict]) -> list[str]:
    return [
        f"branch {k}: " + ", ".join(f"{n} {number_text(v)}" for n, v in own.items()) for k, own in enumerate(branches)
    ]


def _told(protocol: dict, units: dict[str, str]) -> list[str]:
    """What is prescribed, one line a quantity."""
    lines = []
    for name in ("voltage", "volume", "pressure"):
        own = dict(protocol.get(name, {}))
        if own:
            kind = own.pop("protocol")
            numbers = ", ".join(f"{n} {number_text(v)}" for n, v in own.items() if v is not None)
            unit = f" ({units[name]}, rates in it per unit of time)" if name in units else ""
            lines.append(f"{name}: {kind}{f', {numbers}' if numbers else ''}{unit}")
    return lines


def _happened(document: dict, units: dict[str, str]) -> str:
    """One sentence about the snap and the end."""

    def place(event: dict) -> str:
        named = (("t", "time"), ("Φ", "voltage"), ("V", "volume"))
        return ", ".join(f"{symbol} = {event[name]:.6g}{_unit_of(name, units)}" for symbol, name in named)

    snap, end = document["snap"], document["events"][-1]
    ends = f"the run ends at t = {end['time']:.6g}: {end['reason']}"
    if snap is None:
        return f"There is no snap; {ends}."
    if snap["kind"] == "creep_through":
        return f"The membrane creeps through, fastest at {place(snap['at'])} (creep_through); {ends}."
    landing = snap["landing"]
    lands = "without a landing" if landing is None else f"to V = {landing['volume']:.6g}{_unit_of('volume', units)}"
    return f"The membrane jumps at {place(snap['at'])} {lands} (jump); {ends}."


def _run_lines(document: dict, units: dict[str, str]) -> list[str]:
    names = ("event", "time", "voltage", "pressure", "volume", "apex_stretch", "breakdown_ratio")
    rows = [
        [*(e[n] for n in names), "–" if e["error_estimate"] is None else f"{e['error_estimate']:.1e}", e["reason"]]
        for e in document["events"]
    ]
    lines = [*_branch_sentences(document["scene"].get("branches", ())), *_told(document["protocol"], units)]
    lines += [f"start: {document['protocol']['start']}; times in the unit of the relaxation times"]
    return [*lines, "", text_table([*_heads(names, units), "error", "reason"], rows), "", _happened(document, units)]


def _unit_of(name: str, units: dict[str, str]) -> str:
    return f" {units[name]}" if name in units else ""


def _heads(names: Sequence[str], units: dict[str, str]) -> list[str]:
    """Column headings: the names, with their units if they have one."""
    return [name.replace("_", " ") + (f" [{units[name]}]" if name in units else "") for name in names]


def _branch_lines(branches: Sequence[dict], units: dict[str, str]) -> list[str]:
    names = ("voltage_squared", "pressure", "volume", "apex_stretch")
    header = ["branch", "points", *_heads(names, units), "from", "to", "flags"]
    rows = [
        [i, len(b["volume"]), *(_range(b[n]) for n in names), b["start"], b["end"], ", ".join(b["flags"]) or None]
        for i, b in enumerate(branches)
    ]
    codes = dict.fromkeys(code for b in branches for code in (b["start"], b["end"]))
    sentences = [f"  {code}: {Code[code].sentence}" for code in codes]
    return ["", "branches", text_table(header, rows), *sentences]


def _state_lines(title: str, states: Sequence[dict], leading: Sequence[str], units: dict[str, str]) -> list[str]:
    names = (*leading, "voltage", "pressure", "volume", "apex_stretch", "breakdown_ratio", "index")
    rows = [[*(s[n] for n in names), f"{s['error_estimate']:.1e}", ", ".join(s["flags"]) or None] for s in states]
    return ["", title, text_table([*_heads(names, units), "error", "flags"], rows)]
