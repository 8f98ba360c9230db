"""A scene: one membrane under one loading, looked at through a window.

The scene decides what is integrated: which derivatives the loading's condition needs, and where the window ends.
"""

import dataclasses
import typing
import warnings
from collections.abc import Mapping

import equinox as eqx
import jax
import numpy as np

from ..numerics import LARGEST, Readable, shown
from .loading import (
    AbstractLoading,
    Chamber,
    ChargeControl,
    ConstantPressure,
    ConstantVoltage,
    PrescribedVolume,
    control_of,
    mechanical,
)
from .materials import (
    AbstractDielectric,
    AbstractMaterial,
    ArrudaBoyce,
    ConstantBreakdown,
    CustomMaterial,
    CustomPermittivity,
    Electrostrictive,
    Gent,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    VHBBreakdown,
)
from .membrane import Membrane
from .parameters import PARAMETERS, parameter_of, place_of
from .resolution import LARGEST_FIELD, SCANNED_LOAD, VHB_MODULI, VHB_PERMITTIVITIES
from .units import Units, from_text, is_concrete, refuse_dimensionless
from .viscoelastic import Maxwell, Viscoelastic, spring_and_branches

__all__ = ["Scene", "Window", "describe", "describe_in_units", "doubt_of_vhb", "pair"]


_MEASURED = (
    "pressure",
    "volume",
)  # kinds of parameters that are held dimensionless, and given in SI on a scene with units


def constants_of(material) -> list[str]:
    """The names of a material's constants: its fields that are numbers, or tuples of them."""

    def is_constant(field) -> bool:
        value = getattr(material, field.name)
        leaves = jax.tree.leaves(value)
        if any(isinstance(v, eqx.Module) for v in (value if isinstance(value, tuple) else [value])):
            return False
        return not field.metadata.get("static", False) and bool(leaves) and not any(map(np.ndim, leaves))

    return [f.name for f in dataclasses.fields(material) if is_constant(f)]


def pair(name, value) -> tuple[float, float]:
    """Two finite numbers, the lower first; raises ValueError by the name otherwise."""
    try:
        low, high = (float(v) for v in value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"`{name}` must be a pair of numbers (low, high), but is {shown(value)}.") from None
    if not (abs(low) <= LARGEST and abs(high) <= LARGEST and low < high):
        raise ValueError(
            f"`{name}` must be finite, at most {LARGEST:g} in size, with low < high, but is ({low!r}, {high!r})."
        )
    return low, high


class Window(Readable):
    """The part of the chart that is searched: apex stretch, and load fraction t = q/q_max(λa).

    `apex_stretch=None` means from the prestretch to the material's largest stretch, beyond which no window goes: its lock-up
    (Gent 0.99 J, Arruda–Boyce ρ = 0.995); 12 prestretches where it has none; what a user's material says. A material without
    lock-up that stiffens before (Ogden with large exponents, Mooney–Rivlin at large prestretches) ends where the
    balloon pressure 2s/λ² of its equal-biaxial tension s(λ) reaches 100, (λ − 1) s'/s reaches 210, or s falls to zero. A Gent
    film that locks at a small stretch reaches the same pressure; above it branches are too steep to follow.
    """

    apex_stretch: tuple[float, float] | None = eqx.field(
        default=None, static=True, converter=lambda v: None if v is None else pair("stretch_window", v)
    )
    load_fraction: typing.Any = eqx.field(
        default=(-1.0, 1.0), static=True, converter=lambda v: (-1.0, 1.0) if v is None else pair("load_window", v)
    )

    def __check_init__(self):
        low, high = self.load_fraction
        if not (low >= -20 and high <= 1):
            raise ValueError(f"`load_window` must lie between -20 and 1, but is ({low!r}, {high!r}).")
        if not low < SCANNED_LOAD:
            raise ValueError(f"`load_window` must begin below {SCANNED_LOAD}, but begins at {low!r}.")


class Scene(Readable):
    """One membrane under one loading; `replace` changes parameters by their published names (`PARAMETERS`).

    Its fields hold dimensionless numbers. On a scene that carries `units`, parameters are given and returned in SI, by `replace`
    as by sweeps, maps and designs; `Scene.from_si` makes one from a loading in SI.

    >>> scene = Scene(membrane=Membrane(), loading=Chamber(volume=1600.0, initial_volume=2.42))
    >>> float(scene.replace(chamber_volume=800.0).loading.volume)
    800.0
    """

    membrane: Membrane
    loading: AbstractLoading
    window: Window = eqx.field(default_factory=Window)
    units: Units | None = None

    def __check_init__(self):
        if not isinstance(self.membrane, Membrane):
            raise ValueError(f"`membrane` must be a Membrane, but is a {type(self.membrane).__name__}.")
        if not isinstance(self.loading, AbstractLoading):
            raise ValueError(
                f"`loading` must be a loading such as Chamber(...), but is a {type(self.loading).__name__}."
            )
        for name in constants_of(self.membrane.material):
            if place_of(name) != ("membrane", "material", name):
                raise ValueError(
                    f"`{name}` must not be the name of a material's constant, because it is that of a parameter of "
                    f"the {place_of(name)[0]}."
                )
        if self.units is not None:
            if not isinstance(self.units, Units):
                raise ValueError(f"`units` must be a Units, but is a {type(self.units).__name__}.")
            _check_law(self.membrane.breakdown, self.units)
            _check_opening(self.membrane.prestretch, self.units)

    @classmethod
    def from_si(
        cls, membrane: Membrane, loading: AbstractLoading, units: Units | None = None, *, window: Window | None = None
    ) -> "Scene":
        """The scene of a loading whose numbers are in SI (Pa, m³, …), with `units` (default `Units()`) carried along.

        A `VHBBreakdown` of the membrane gets the units' μ and ε, with a warning where they are not those of VHB; the field of a
        `ConstantBreakdown` is in V/m. The membrane's other numbers are dimensionless as ever. A loading that looks dimensionless is refused.

        >>> chamber = Chamber(volume=18.225e-3, initial_volume=27.565e-6, atmospheric_pressure=100e3)
        >>> scene = Scene.from_si(Membrane(), chamber)
        >>> round(float(scene.loading.volume), 9), round(float(scene.loading.atmospheric_pressure), 9)
        (1600.0, 50.0)
        >>> thin = scene.replace(thickness=0.5e-3)  # the same chamber of air, twice as stiff beside the film
        >>> round(float(thin.loading.volume), 9), round(float(thin.loading.atmospheric_pressure), 9)
        (1600.0, 100.0)
        """
        units = Units() if units is None else units
        doubt = doubt_of_vhb(membrane.breakdown, units)
        if doubt:
            warnings.warn(doubt, UserWarning, stacklevel=2)
        changed = _rebuild(membrane, (), {"breakdown": _law_from_si(membrane.breakdown, units)})
        made = cls(changed, units.from_si(loading), Window() if window is None else window, units)
        measured = [n for n, row in PARAMETERS.items() if row.kind in _MEASURED and made.has(n)]
        made.check_in_si({n: made.value_of(n) for n in measured})
        return made

    def replace(self, **parameters) -> "Scene":
        """The scene with other values of the named parameters; setting one side of a filling clears the other.

        With `units` every pressure, volume and constant of the units is in SI: a number, or a text with a unit such as
        `chamber_volume="0.5 l"`; a number that looks dimensionless is refused. Where the units change, the loading and a constant
        breakdown field stay what they are in SI; so does an `opening_radius`, whose film has the radius a/λ0. Without `units` all numbers are dimensionless. The order of the parameters
        does not matter. An entry of a list is `moduli[0]`; `modulus_ratio` and `relaxation_time` are one number for each branch of a
        viscoelastic film, `branches[0].stretch_limit` a constant of a branch's spring, and `stretch_limit` that of the equilibrium
        spring.

        >>> chamber = Chamber(volume=18.225e-3, initial_volume=27.565e-6, atmospheric_pressure=100e3)
        >>> scene = Scene.from_si(Membrane(), chamber).replace(chamber_volume="0.5 l")
        >>> float(scene.value_of("chamber_volume")), round(float(scene.loading.volume), 9)
        (0.0005, 43.895747599)
        """
        self.check_in_si(parameters)
        return self.with_values(**{name: self.number_of(name, value) for name, value in parameters.items()})

    def with_values(self, **parameters) -> "Scene":
        """`replace` for computing: numbers only, of any size."""
        scene = self
        named = [pair for name, value in parameters.items() for pair in self._by_branches(name, value)]
        for name, value in sorted(named, key=lambda item: _order(item[0])):
            path = scene.path_of(name)
            opening = None if scene.units is None else scene.units.opening_radius
            if path[0] == "units":
                scene = scene._in(scene._units_with(name, value))
                continue
            if name == "prestretch" and opening is not None:
                membrane = _rebuild(scene.membrane, (), {name: value})
                scene = scene._in(_rebuild(scene.units, (), {"radius": opening / membrane.prestretch}), membrane)
                continue
            value = scene.as_held(name, value)
            changes = {path[-1]: value}
            other = {"initial_volume": "initial_pressure", "initial_pressure": "initial_volume"}.get(name)
            if other:
                changes[other] = None
            scene = _rebuild(scene, path[:-1], changes)
        return scene

    def _units_with(self, name: str, value) -> Units:
        """The units with another constant; the opening and the radius of the film change together."""
        units = typing.cast(Units, self.units)
        changes = {name: value}
        if name == "opening_radius":
            changes["radius"] = value / self.membrane.prestretch
        elif name == "radius" and units.opening_radius is not None:
            raise ValueError(
                "`radius` must be left out, because the scene keeps its `opening_radius`; change that one."
            )
        return _rebuild(units, (), changes)

    def number_of(self, name: str, value: typing.Any) -> typing.Any:
        """A value of a parameter, where it is a text with a unit as a number in SI; raises ValueError without `units`."""
        if not isinstance(value, str):
            return value
        if self.units is None:
            raise ValueError(f"`{name}` must be a number, because the scene carries no `units`, but is {shown(value)}.")
        return from_text(name, value)

    def numbers_of(self, name: str, values: typing.Any) -> typing.Any:
        """`number_of` of every value in a list or tuple; anything else stays."""
        return [self.number_of(name, v) for v in values] if isinstance(values, (list, tuple)) else values

    def check_in_si(self, given: Mapping[str, typing.Any]) -> None:
        """Raises ValueError for numbers of parameters, or lists of them, that look dimensionless on a scene with units."""
        if self.units is not None:
            refuse_dimensionless({name: value for name, value in given.items() if self.has(name)}, self.units)

    def as_held(self, name: str, value: typing.Any) -> typing.Any:
        """The value of a parameter as the scene's fields hold it: a pressure or a volume in SI made dimensionless."""
        return self.dimensionless(value, name) if parameter_of(name).kind in _MEASURED else value

    def in_units(self, value: typing.Any, name: str) -> typing.Any:
        """A dimensionless number as the scene gives it: in SI where it carries `units`; `name` as in `Units.to_si`."""
        return value if self.units is None else self.units.to_si(value, name)

    def dimensionless(self, value: typing.Any, name: str) -> typing.Any:
        """A number as the scene takes it, in SI where it carries `units`, or a text with a unit, made dimensionless."""
        value = self.number_of(name, value)
        return value if self.units is None else self.units.reduce(value, name)

    def has(self, name: str) -> bool:
        """Whether a parameter is one of this scene's."""
        try:
            return bool(self.path_of(name))
        except ValueError:
            return False

    def value_of(self, name: str) -> typing.Any:
        """The value of a parameter, in SI with `units`; a tuple of a list, None of the filling that another gives.

        Raises ValueError as `path_of`.
        """
        value = _at(self, self.path_of(name))
        return self.in_units(value, name) if parameter_of(name).kind in _MEASURED else value

    def _by_branches(self, name: str, value) -> list[tuple[str, typing.Any]]:
        """A parameter of all branches as one of each."""
        if parameter_of(name).path[2:] != ("branches", name):
            return [(name, value)]
        count = len(_at(self, self.path_of(name)))
        values = list(value) if isinstance(value, (list, tuple)) or np.ndim(value) else [value]
        if len(values) != count:
            raise ValueError(f"`{name}` must be one number for each branch, {count}, but is {shown(value)}.")
        return [(f"{name}[{k}]", own) for k, own in enumerate(values)]

    def path_of(self, name: str) -> tuple[typing.Any, ...]:
        """Where the scene keeps a parameter; raises ValueError where it has none of that name."""
        path = own = place_of(name)
        material = self.membrane.material
        inner: tuple[str, ...] = ()
        while (
            path[:2] == ("membrane", "material") and not self._holds(path) and isinstance(material, AbstractDielectric)
        ):
            # the elasticity of a dielectric, or the spring that a viscoelastic film is at rest
            part = "equilibrium" if isinstance(material, Viscoelastic) else "elastic"
            material, inner = getattr(material, part, None), (*inner, part)
            path = (*own[:2], *inner, *own[2:])
        if name not in PARAMETERS and not self._holds(path):
            known = dict.fromkeys((*PARAMETERS, *constants_of(self.membrane.material)))
            known |= dict.fromkeys(
                f"branches[{k}].{n}" for k, b in enumerate(self._branches) for n in constants_of(b.material)
            )
            raise ValueError(f"`{name}` must be one of {', '.join(known)}, but is not a parameter of a scene.")
        owner = parameter_of(name).owner
        if isinstance(self.loading, ChargeControl) and path[0] == "loading":
            path = ("loading", *path)
        if not self._holds(path) or (owner and type(mechanical(self.loading)).__name__ != owner):
            raise ValueError(
                f"`{name}` must be a parameter of this scene, but its {path[0]} has none of that name."
                if path[0] != "units" or self.units is not None
                else f"`{name}` must be a parameter of this scene, but it carries no `units`."
            )
        return path

    def check_varies(self, name: str) -> None:
        """Raises ValueError for a parameter that a diagram cannot vary with.

        The scene does not have it, its value is a list of numbers, or it is one of a branch, on which a membrane at rest does
        not depend.
        """
        path = self.path_of(name)
        if path[2:3] == ("branches",):
            raise ValueError(
                f"`{name}` must not vary here, because the membrane at rest does not depend on it; `dj.follow`, `dj.bounds` and sweeps with "
                "`engine=dj.rates.InTime(…)` do."
            )
        if isinstance(_at(self, path), tuple):
            raise ValueError(f"`{name}` must not vary, because its value is a list.")

    @property
    def _branches(self) -> tuple[Maxwell, ...]:
        return spring_and_branches(self.membrane.material)[1]

    def _holds(self, path: tuple[typing.Any, ...]) -> bool:
        """Whether there is a parameter at this place."""
        if isinstance(path[-1], int):
            return isinstance(_at(self, path[:-1]), tuple) and _at(self, path) is not None
        module = _at(self, path[:-1])
        if isinstance(module, Units):
            return getattr(module, path[-1]) is not None
        if isinstance(module, tuple):  # the branches
            module = module[0] if module else None
        if isinstance(module, AbstractMaterial):
            return path[-1] in constants_of(module)
        return module is not None and path[-1] in _fields(module)

    def _in(self, units: Units, membrane: Membrane | None = None) -> "Scene":
        """The same loading and breakdown field in SI on a film of other constants, and on another membrane if one is given."""
        before = typing.cast(Units, self.units)
        law = self.membrane.breakdown
        if isinstance(law, ConstantBreakdown):
            law = units.reduce(before.to_si(law))
        elif not isinstance(law, VHBBreakdown):
            raise ValueError(
                f"`breakdown` must be a VHBBreakdown or ConstantBreakdown where units change, but is a {type(law).__name__}."
            )
        film = _rebuild(self.membrane if membrane is None else membrane, (), {"breakdown": law_in(law, units)})
        loading = units.reduce(before.to_si(self.loading))
        return Scene(film, loading, self.window, units)

    def limits(self) -> tuple[tuple[float, float], bool, tuple[float, float]]:
        """Apex-stretch limits, whether the upper one is the material's lock-up, and load-fraction limits."""
        lock_up, locks = self.membrane.lock_up_stretch()
        prestretch = float(self.membrane.prestretch)
        if self.window.apex_stretch is None:
            return (prestretch, lock_up), locks, self.window.load_fraction
        low, high = self.window.apex_stretch
        if not high > prestretch:
            raise ValueError(f"`stretch_window` must end above the prestretch {prestretch:g}, but ends at {high!r}.")
        if not low < lock_up:
            raise ValueError(
                f"`stretch_window` must begin below the material's largest stretch {lock_up:.6g}, but begins at {low!r}."
            )
        return (max(low, prestretch), min(high, lock_up)), locks and high >= lock_up, self.window.load_fraction


def _fields(module) -> set:
    return set(module.__dataclass_fields__)


def doubt_of_vhb(law, units: Units) -> str | None:
    """A sentence where the unscaled law of VHB 4910 serves a film that is hardly VHB, by its modulus or permittivity."""
    if not isinstance(law, VHBBreakdown) or (is_concrete(law.scale) and law.scale != 1):
        return None
    for value, (low, high), words in (
        (units.shear_modulus, VHB_MODULI, "shear modulus of {:.4g} Pa"),
        (units.relative_permittivity, VHB_PERMITTIVITIES, "relative permittivity of {:.3g}"),
    ):
        if is_concrete(value) and not low <= value <= high:
            return (
                f"`breakdown` is the law of VHB 4910, which a film with a {words.format(float(value))} is hardly made of; "
                "give the film's own field."
            )
    return None


def _law_from_si(law, units: Units):
    """A breakdown law that measures its field in these units, of a law with its field in V/m where that is constant."""
    if not isinstance(law, ConstantBreakdown):
        return law_in(law, units)
    if is_concrete(law.constant_field) and law.constant_field < LARGEST_FIELD:
        raise ValueError(
            f"`constant_field` must be in V/m for a scene in SI, at least {LARGEST_FIELD:g}, but is {float(law.constant_field):g}."
        )
    return units.reduce(law)


def law_in(law, units: Units):
    """A breakdown law that measures its field in these units."""
    if not isinstance(law, VHBBreakdown):
        return law
    return VHBBreakdown(law.scale, units.shear_modulus, units.relative_permittivity)


def _check_law(law, units: Units) -> None:
    if isinstance(law, ConstantBreakdown) and is_concrete(law.constant_field) and law.constant_field > LARGEST_FIELD:
        raise ValueError(
            f"`constant_field` must be in units of √(μ/ε), at most {LARGEST_FIELD:g}, but is {float(law.constant_field):g}; "
            "Scene.from_si takes it in V/m."
        )
    if not isinstance(law, VHBBreakdown):
        return
    pairs = {
        "shear_modulus": (law.shear_modulus, units.shear_modulus),
        "relative_permittivity": (law.relative_permittivity, units.relative_permittivity),
    }
    for name, (own, other) in pairs.items():
        if is_concrete(own) and is_concrete(other) and abs(own / other - 1) > 1e-12:
            raise ValueError(
                f"`{name}` of the breakdown law must be that of the units, {float(other):.6g}, but is {float(own):.6g}; "
                "Scene.from_si sees to it."
            )


def _order(name: str) -> int:
    """In which order parameters are replaced: those by which others are measured first."""
    return 0 if place_of(name)[0] == "units" else 1 if name == "prestretch" else 2


def _check_opening(prestretch, units: Units) -> None:
    opening, radius = units.opening_radius, units.radius
    if opening is None or not all(map(is_concrete, (prestretch, opening, radius))):
        return
    if abs(radius * prestretch / opening - 1) > 1e-9:
        raise ValueError(
            f"`opening_radius` must be the prestretch times the radius of the film, {float(radius * prestretch):.6g}, but is "
            f"{float(opening):.6g}; Units.for_opening sees to it."
        )


def _at(module: typing.Any, path) -> typing.Any:
    """What stands at a place, of branches a tuple; None where there is nothing."""
    for step in path:
        if isinstance(step, int):
            module = module[step] if isinstance(module, tuple) and step < len(module) else None
        elif isinstance(module, tuple):
            module = tuple(getattr(m, step, None) for m in module)
        else:
            module = getattr(module, step, None)
    return module


def _rebuild(module: typing.Any, path, changes) -> typing.Any:
    """A copy with fields or entries changed, through the constructors, so that every check runs again."""
    if path:
        changes = {path[0]: _rebuild(_at(module, path[:1]), path[1:], changes)}
    if isinstance(module, tuple):
        return tuple(changes.get(k, entry) for k, entry in enumerate(module))
    return type(module)(**{n: getattr(module, n) for n in _fields(module)} | changes)


def describe_units(units: Units) -> dict:
    """The constants of the units, in SI, under their published names."""
    given = {name: getattr(units, name) for name in units.__dataclass_fields__}
    return {name: float(value) for name, value in given.items() if value is not None}


_MATERIAL_NAMES = {
    Gent: "gent",
    NeoHookean: "neo-hookean",
    ArrudaBoyce: "arruda-boyce",
    CustomMaterial: "custom",
    MooneyRivlin: "mooney-rivlin",
    Ogden: "ogden",
    Electrostrictive: "electrostrictive",
    CustomPermittivity: "custom-permittivity",
    Viscoelastic: "viscoelastic",
}


def _constants(material) -> dict:
    """A material's own numbers, under their published names."""
    return {n: np.asarray(getattr(material, n), float).tolist() for n in constants_of(material)}


def describe(what: Scene | Membrane) -> dict:
    """The scene's parameters under their published names, as the JSON documents carry them; the units' own are in SI."""
    scene = what if isinstance(what, Scene) else None
    membrane = what.membrane if isinstance(what, Scene) else what
    out: dict = {"material": _MATERIAL_NAMES.get(type(membrane.material), type(membrane.material).__name__)}
    material = membrane.material
    if isinstance(material, Viscoelastic):
        out["branches"] = [
            {"material": _MATERIAL_NAMES.get(type(b.material), type(b.material).__name__)}
            | _constants(b.material)
            | {"modulus_ratio": float(b.modulus_ratio), "relaxation_time": float(b.relaxation_time)}
            for b in material.branches
        ]
    if isinstance(material, AbstractDielectric):
        elastic = material.equilibrium if isinstance(material, Viscoelastic) else getattr(material, "elastic", None)
        out["elastic"] = _MATERIAL_NAMES.get(type(elastic), type(elastic).__name__)
        out |= _constants(elastic)
    out |= _constants(material)
    out["prestretch"] = float(membrane.prestretch)
    law = membrane.breakdown
    out["breakdown"] = (
        "vhb"
        if isinstance(law, VHBBreakdown)
        else float(law.constant_field)
        if isinstance(law, ConstantBreakdown)
        else type(law).__name__
    )
    out["breakdown_field_scale"] = float(getattr(law, "scale", 1.0))
    if scene is None:
        return out
    if scene.units is not None:
        out |= describe_units(scene.units)
    loading = mechanical(scene.loading)
    if isinstance(loading, ConstantPressure):
        out["pressure"] = float(loading.pressure)
    elif isinstance(loading, ConstantVoltage):
        out["voltage"] = float(loading.voltage)
    elif isinstance(loading, PrescribedVolume):
        out["volume"] = float(loading.volume)
    elif isinstance(loading, Chamber):
        out["chamber_volume"] = float(loading.volume)
        for name in ("initial_volume", "initial_pressure"):
            value = getattr(loading, name)
            if value is not None:
                out[name] = float(value)
        out["atmospheric_pressure"] = float(loading.atmospheric_pressure)
        out["polytropic_exponent"] = float(loading.polytropic_exponent)
    if control_of(scene.loading) == "charge":
        out["control"] = "charge"
    return out


def describe_in_units(scene: Scene) -> dict:
    """The beginning of a JSON document, "scene" and "units", with parameters as the scene gives them: in SI where it carries units."""
    document = {"scene": describe(scene), "units": "dimensionless"}
    return document if scene.units is None else scene.units.to_document(document)
