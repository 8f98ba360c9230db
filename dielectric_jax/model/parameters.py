"""Every continuous parameter of a scene, in one table: where it lives, what it measures, what it is called, what it may be.

Scenes, documents, the command line, sweeps, designs, figures and the explorer read it. A new constant of a material is one
more row. Constants of a user's own material are no rows: they have the names of its fields, and may be any number. An entry of
a list of numbers is `moduli[0]`, a constant of the spring in a Maxwell branch `branches[0].stretch_limit`.
"""

import dataclasses
import enum
import math
import re
import typing

__all__ = ["PARAMETERS", "Change", "Parameter", "change_of", "parameter_of", "place_of"]


class Change(enum.Enum):
    """What another value of a parameter makes invalid."""

    LOADING = "loading"  # nothing but the loading: one surface serves
    PRESTRETCH = "prestretch"  # the surface; a family of surfaces serves
    MATERIAL = "material"  # every surface
    BREAKDOWN = "breakdown"  # the breakdown law, and so the domain of a surface


#: kinds of quantity: the dimensionless unit in ASCII, as attributes of datasets carry it, and as figures write it
_UNITS = {
    "": ("1", ""),
    "pressure": ("mu H / A", "μH/A"),
    "volume": ("A^3", "A³"),
    "modulus": ("mu", "μ"),
    "Pa": ("Pa", "Pa"),
    "m": ("m", "m"),
    "F/m": ("F m-1", "F/m"),
}


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One parameter of a scene.

    `path` is its place in a scene, by names of fields and numbers of entries, `owner` the class of the loading where several have a field of its name. `kind` is the kind
    of quantity: "pressure", "volume", "modulus" (a multiple of μ), an SI unit, or "" for a pure number. A value is above
    `least`, or equal to it where `closed`; a `many` is a list of numbers, of branches one a branch. `default` is that of its class.
    """

    name: str
    path: tuple[typing.Any, ...]
    symbol: str
    words: str
    kind: str = ""
    least: float = 0.0
    closed: bool = False
    many: bool = False
    change: Change = Change.LOADING
    owner: str = ""
    default: float | None = None

    @property
    def unit(self) -> str:
        """The unit as an attribute of a dataset: "1", "A^3", "mu H / A", "Pa"."""
        return _UNITS[self.kind][0]

    @property
    def figure_unit(self) -> str:
        """The unit with its symbols: "", "A³", "μH/A", "Pa"."""
        return _UNITS[self.kind][1]

    @property
    def label(self) -> str:
        """The words, the symbol and the unit in plain text: "chamber volume V_C / A³"."""
        unit = self.figure_unit
        unit = f"({unit})" if "/" in unit else unit
        return f"{self.words} {self.symbol}" + (f" / {unit}" if unit else "")

    @property
    def allowed(self) -> str:
        """What a value must be, in words; "" where every number is allowed."""
        if math.isinf(self.least):
            return ""
        if self.least:
            return f"at least {self.least:g}"
        return "zero or positive" if self.closed else "positive"

    def allows(self, value: float) -> bool:
        """Whether a number is one that the parameter may have."""
        return value > self.least or (self.closed and value == self.least)


def _loading(name, field, symbol, words, kind="", **more) -> Parameter:
    return Parameter(name, ("loading", field), symbol, words, kind, **more)


def _material(name, symbol, words, kind="", **more) -> Parameter:
    return Parameter(name, ("membrane", "material", name), symbol, words, kind, change=Change.MATERIAL, **more)


def _branches(name, symbol, words, **more) -> Parameter:
    path = ("membrane", "material", "branches", name)
    return Parameter(name, path, symbol, words, many=True, change=Change.MATERIAL, **more)


def _unit(name, symbol, words, kind, change) -> Parameter:
    return Parameter(name, ("units", name), symbol, words, kind, change=change)


_ROWS = (
    _loading("chamber_volume", "volume", "V_C", "chamber volume", "volume", owner="Chamber"),
    _loading("initial_volume", "initial_volume", "V₀", "initial volume", "volume", closed=True),
    _loading("initial_pressure", "initial_pressure", "p₀", "initial pressure", "pressure", closed=True),
    _loading(
        "atmospheric_pressure",
        "atmospheric_pressure",
        "p_atm",
        "atmospheric pressure",
        "pressure",
        closed=True,
        default=50.0,
    ),
    _loading("polytropic_exponent", "polytropic_exponent", "n", "polytropic exponent", default=1.0),
    _loading("pressure", "pressure", "p", "pressure", "pressure", closed=True),
    _loading("volume", "volume", "V", "volume", "volume", closed=True, owner="PrescribedVolume"),
    Parameter(
        "prestretch",
        ("membrane", "prestretch"),
        "λ₀",
        "prestretch",
        least=1.0,
        closed=True,
        change=Change.PRESTRETCH,
        default=1.0,
    ),
    Parameter(
        "breakdown_field_scale",
        ("membrane", "breakdown", "scale"),
        "E_EB/law",
        "breakdown field scale",
        change=Change.BREAKDOWN,
        default=1.0,
    ),
    _material("stretch_limit", "J", "stretch limit", default=270.0),
    _material("chain_links", "N", "links of a chain", default=125.0),
    _material("c1", "C₁", "Mooney–Rivlin constant", "modulus", closed=True, default=0.45),
    _material("c2", "C₂", "Mooney–Rivlin constant", "modulus", closed=True, default=0.05),
    _material("moduli", "μᵢ", "Ogden moduli", "modulus", least=-math.inf, many=True),
    _material("exponents", "αᵢ", "Ogden exponents", least=-math.inf, many=True),
    _material("thickness_coefficient", "c", "coefficient of the permittivity by the thickness", least=-math.inf),
    _material("stretch_coefficient", "c", "coefficient of the permittivity by the stretches", least=-math.inf),
    _branches("modulus_ratio", "g", "ratio of moduli of a Maxwell branch", closed=True),
    _branches("relaxation_time", "τ", "relaxation time of a Maxwell branch"),
    _unit("shear_modulus", "μ", "shear modulus", "Pa", Change.BREAKDOWN),
    _unit("thickness", "H", "undeformed thickness", "m", Change.LOADING),
    _unit("radius", "A", "undeformed radius", "m", Change.LOADING),
    _unit("opening_radius", "a", "radius of the opening", "m", Change.LOADING),
    _unit("permittivity", "ε", "permittivity", "F/m", Change.BREAKDOWN),
)
#: the parameters by their published names; those of the units where a scene carries `units`, in SI
PARAMETERS = {row.name: row for row in _ROWS}


def parameter_of(name: str) -> Parameter:
    """The row of a parameter: a published one, an entry of a list, or that of a constant of a user's material or of a branch.

    >>> parameter_of("chamber_volume").label, parameter_of("c1").change.name, parameter_of("my_constant").path
    ('chamber volume V_C / A³', 'MATERIAL', ('membrane', 'material', 'my_constant'))
    >>> parameter_of("relaxation_time[1]").path, parameter_of("branches[0].stretch_limit").label
    (('membrane', 'material', 'branches', 1, 'relaxation_time'), 'stretch limit J of branches[0]')
    """
    of_branch = re.fullmatch(r"branches\[(\d{1,3})\]\.([^.]+)", name)
    if of_branch:
        row = parameter_of(of_branch[2])
        path = ("membrane", "material", "branches", int(of_branch[1]), "material", *row.path[2:])
        symbol = f"{row.symbol} of branches[{of_branch[1]}]"
        return dataclasses.replace(row, name=name, path=path, symbol=symbol, change=Change.MATERIAL, default=None)
    entry = re.fullmatch(r"(\w+)\[(\d{1,3})\]", name)
    if entry:
        row, place = parameter_of(entry[1]), int(entry[2])
        *before, last = row.path
        path = (*before, place, last) if "branches" in before else (*before, last, place)
        return dataclasses.replace(row, name=name, path=path, symbol=f"{row.symbol}[{place}]", many=False)
    return PARAMETERS.get(name) or _material(name, name, name.replace("_", " "), least=-math.inf)


def place_of(name: str) -> tuple[typing.Any, ...]:
    """Where a scene keeps a parameter: names of fields, and numbers of entries."""
    return parameter_of(name).path


def change_of(name: str) -> Change:
    """What another value of a parameter makes invalid."""
    return parameter_of(name).change
