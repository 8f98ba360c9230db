"""Specifications of design problems in TOML files: a scene, the parameters that vary, and the constraints."""

from ..model import Scene, check_sizes, number, other_filling_left_out, place_of, read_toml, refuse, scene_of, table
from ..numerics import shown

__all__ = ["read_design_file"]

_WORDS = {
    (int, list): "a whole number or two",
    (int, float): "a number",
    (int,): "a whole number",
    (bool,): "true or false",
    (str,): "a text",
}
_WISHES = {
    "regimes": {"points": (int, list)},
    "optimise": {
        "survival_margin": (int, float),
        "operating_margin": (int, float),
        "must_snap": (bool,),
        "way_down": (str,),
        "quantile": (int, float),
        "compare": (int,),
        "check": (bool,),
    },
}


def read_design_file(path: str, command: str) -> tuple[Scene, dict, dict]:
    """The scene, the ranges of [over], and the options of a file, for "regimes" or "optimise".

    Raises ValueError with one sentence for a file that cannot be read, or that holds unknown entries.
    """
    document = read_toml(path)
    refuse("", document, ("scene", "units", "over", command, *(("uncertain",) if command == "optimise" else ())))
    over = {}
    for name, limits in table("over", document.get("over", {})).items():
        if not (isinstance(limits, list) and len(limits) == 2):
            raise ValueError(f"`{name}` in [over] must be a pair [low, high], but is {shown(limits)}.")
        over[name] = tuple(number("over", name, v) for v in limits)
    options = dict(table(command, document.get(command, {})))
    refuse(command, options, _WISHES[command])
    for name, value in options.items():
        kinds = _WISHES[command][name]
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise ValueError(f"`{name}` in [{command}] must be {_WORDS[kinds]}, but is {shown(value)}.")
        if kinds == (int, float):
            options[name] = number(command, name, value)
    if isinstance(options.get("points"), list):
        options["points"] = tuple(options["points"])
    if "uncertain" in document:
        given = table("uncertain", document["uncertain"])
        options["uncertain"] = {name: number("uncertain", name, share) for name, share in given.items()}
    scene, constants = (table(name, document.get(name, {})) for name in ("scene", "units"))
    sought = {n: low for n, (low, _) in over.items() if place_of(n)[0] != "units"}
    scene = other_filling_left_out(scene, over)
    made = scene_of(sought | scene, constants)
    check_sizes(scene | over, constants)
    return made, over, options
