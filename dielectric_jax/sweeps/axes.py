"""The scenes of a sweep: axes of parameters, their products, lists, tables and samples."""

import csv
import dataclasses
import math
import typing
from collections.abc import Mapping, Sequence

import numpy as np

from ..model import MOST_VALUES, PARAMETERS, Scene, parameter_of, place_of
from ..numerics import LARGEST, check_whole, shown

__all__ = ["Axis", "Design", "read_scenes", "samples", "zipped"]

_METHODS = ("sobol", "latin_hypercube", "random")


def _checked(name: str, values) -> np.ndarray:
    """The values of a parameter as a column; raises ValueError for values that no scene can have."""
    row = parameter_of(name)
    if row.many and "branches" not in row.path:  # of branches one number serves all
        raise ValueError(f"`{name}` must not vary along an axis, because its value is a list.")
    try:
        column = np.atleast_1d(np.asarray(values, float))
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"`{name}` must be a list of numbers, but is {shown(values)}.") from None
    if column.ndim != 1 or not column.size:
        raise ValueError(f"`{name}` must be a list of at least one number, but has the shape {column.shape}.")
    above = (column >= row.least) if row.closed else (column > row.least)
    allowed = (np.abs(column) <= LARGEST) & above
    if not allowed.all():
        what = f"{row.allowed} and " if row.allowed else ""
        value = float(column[~allowed][0])
        finite = f"at most {LARGEST:g} in size" if LARGEST < abs(value) < math.inf else "finite"
        raise ValueError(f"`{name}` must be {what}{finite}, but one value is {value!r}.")
    return column


@dataclasses.dataclass(frozen=True)
class Axis:
    """Parameters that vary together along one dimension: `columns` maps their names to values of one length.

    >>> Axis("prestretch", {"prestretch": [1, 1.5, 2]}).size
    3
    """

    dimension: str
    columns: Mapping[str, np.ndarray]

    def __post_init__(self):
        if not (isinstance(self.dimension, str) and self.dimension.isidentifier()):
            raise ValueError(f"`dimension` must be a name of letters and digits, but is {self.dimension!r}.")
        if not self.columns:
            raise ValueError(
                f"`columns` must name at least one parameter of the axis {self.dimension!r}, but is empty."
            )
        columns = {name: _checked(name, values) for name, values in self.columns.items()}
        sizes = {name: column.size for name, column in columns.items()}
        if len(set(sizes.values())) > 1:
            lengths = ", ".join(f"`{name}` {size}" for name, size in sizes.items())
            raise ValueError(f"The parameters of the axis {self.dimension!r} must have one length, but have {lengths}.")
        if self.dimension in PARAMETERS and self.dimension not in columns:
            raise ValueError(
                f"`dimension` must not be the name of a parameter that the axis does not vary, but is {self.dimension!r}."
            )
        object.__setattr__(self, "columns", columns)

    @property
    def size(self) -> int:
        """The number of values on the axis."""
        return next(iter(self.columns.values())).size

    @property
    def of_membrane(self) -> bool:
        """Whether the membrane changes along the axis."""
        return any(place_of(name)[0] != "loading" for name in self.columns)


def zipped(dimension: str = "scene", /, **columns) -> Axis:
    """Parameters that vary together: the first scene has the first value of each, and so on.

    >>> zipped(chamber_volume=[800.0, 1600.0], initial_volume=[2.0, 2.42]).dimension
    'scene'
    """
    return Axis(dimension, columns)


def samples(count: int, dimension: str = "scene", /, *, method: str = "sobol", seed: int = 0, **distributions) -> Axis:
    """Scenes drawn from distributions: `method` "sobol", "latin_hypercube" (scipy.stats.qmc) or "random".

    A distribution is anything with a method `ppf`, the inverse of its cumulative distribution, such as the frozen
    distributions of `scipy.stats`. The same seed draws the same scenes. Raises ValueError for bad input.

    >>> from scipy import stats
    >>> axis = samples(8, chamber_volume=stats.loguniform(200, 25000), prestretch=stats.uniform(1, 2), seed=3)
    >>> sorted(axis.columns), axis.size
    (['chamber_volume', 'prestretch'], 8)
    """
    from scipy.stats import qmc

    if method not in _METHODS:
        raise ValueError(f"`method` must be one of {', '.join(_METHODS)}, but is {shown(method)}.")
    check_whole("count", count, 1, MOST_VALUES)
    check_whole("seed", seed, 0, 2**128 - 1)
    for name, distribution in distributions.items():
        if not callable(getattr(distribution, "ppf", None)):
            raise ValueError(f"`{name}` must be a distribution with a method `ppf`, but is {shown(distribution)}.")
    random = np.random.default_rng(seed)
    names = list(distributions)
    if method == "sobol":
        # a power of two preserves the balance of the sequence; surplus points are dropped
        unit = qmc.Sobol(max(len(names), 1), rng=random).random_base2(max(math.ceil(math.log2(count)), 0))[:count]
    elif method == "latin_hypercube":
        unit = qmc.LatinHypercube(max(len(names), 1), rng=random).random(count)
    else:
        unit = random.random((count, max(len(names), 1)))
    unit = np.clip(unit, 0.5**54, 1 - 0.5**53)  # avoids infinite values of unbounded distributions
    return Axis(dimension, {name: distributions[name].ppf(unit[:, i]) for i, name in enumerate(names)})


def read_scenes(path, dimension: str = "scene") -> Axis:
    """The scenes of a table: a CSV file whose first line names parameters and whose other lines hold their values.

    Raises ValueError for entries that are not numbers, with their line, and for names that are not parameters.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = [(line.line_num, row) for line in [csv.reader(file)] for row in line if row]
    except (OSError, ValueError, csv.Error):  # no file, no text, or no lines of CSV
        raise ValueError(f"`path` must be a CSV file that can be read, but is {shown(str(path))}.") from None
    if len(rows) < 2:
        raise ValueError(f"`path` must hold a line of names and a line for each scene, but {str(path)!r} does not.")
    names = [name.strip() for name in rows[0][1]]
    if len(set(names)) < len(names):
        raise ValueError(f"`path` must name each parameter once, but {str(path)!r} names {', '.join(names)}.")
    columns: dict[str, list[float]] = {name: [] for name in names}
    for line, row in rows[1:]:
        if len(row) != len(names):
            raise ValueError(
                f"`path` must hold {len(names)} values a line, but line {line} of {str(path)!r} has {len(row)}."
            )
        for name, text in zip(names, row, strict=True):
            try:
                columns[name].append(float(text))
            except ValueError:
                raise ValueError(
                    f"`{name}` must be a number, but is {text!r} in line {line} of {str(path)!r}."
                ) from None
    return Axis(dimension, typing.cast(Mapping, columns))


@dataclasses.dataclass(frozen=True)
class Design:
    """The product of axes, with a scene that provides all other parameters.

    Scenes lie on a grid of the axes' dimensions, and blocks are the chunks of that grid. `of_engine` are the names of axes that
    an engine in time knows, which then also knows the constants of branches; None of engines of a membrane at rest.
    """

    scene: Scene
    axes: tuple[Axis, ...]
    of_engine: tuple[str, ...] | None = None

    def __post_init__(self):
        if not isinstance(self.scene, Scene):
            raise ValueError(f"`scene` must be a Scene, but is a {type(self.scene).__name__}.")
        if not self.axes:
            raise ValueError("A sweep must have at least one axis of parameters, but has none.")
        seen: set[str] = set()
        for axis in self.axes:
            if not isinstance(axis, Axis):
                raise ValueError(f"An axis of a sweep must be an Axis, such as `zipped` makes, but one is {axis!r}.")
            for name in {axis.dimension, *axis.columns}:
                if name in seen:
                    raise ValueError(f"`{name}` must be given once, but two axes of the sweep name it.")
            seen |= {axis.dimension, *axis.columns}
        if {"initial_volume", "initial_pressure"} <= seen:
            raise ValueError("`initial_volume` and `initial_pressure` must not both vary: each sets the filling.")
        self.scene.check_in_si({n: column for axis in self.axes for n, column in axis.columns.items()})
        for name in (name for axis in self.axes for name in axis.columns):
            if self.of_engine is None:
                self.scene.check_varies(name)
            elif name not in self.of_engine:
                self.scene.path_of(name)

    @property
    def dimensions(self) -> tuple[str, ...]:
        """The names of the axes."""
        return tuple(axis.dimension for axis in self.axes)

    @property
    def shape(self) -> tuple[int, ...]:
        """The sizes of the axes."""
        return tuple(axis.size for axis in self.axes)

    @property
    def count(self) -> int:
        """The number of scenes."""
        return math.prod(self.shape)

    def columns(self, part: Sequence[slice]) -> dict[str, np.ndarray]:
        """The values of the varied parameters in a part of the grid, in grid order: arrays of one length."""
        lengths = [len(range(*own.indices(axis.size))) for own, axis in zip(part, self.axes, strict=True)]
        columns = {}
        for i, (own, axis) in enumerate(zip(part, self.axes, strict=True)):
            shape = [1] * len(lengths)
            shape[i] = lengths[i]
            for name, values in axis.columns.items():
                columns[name] = np.broadcast_to(values[own].reshape(shape), lengths).ravel()
        return columns

    def chunk(self, most: int) -> tuple[int, ...]:
        """The shape of blocks of at most `most` scenes that contain as few membranes as possible."""
        chunk = [1] * len(self.axes)
        order = sorted(range(len(self.axes)), key=lambda i: (self.axes[i].of_membrane, -i))
        for i in order:
            size = self.axes[i].size
            parts = -(-size // max(1, most))
            chunk[i] = size if parts <= 1 else most
            most //= chunk[i]
        return tuple(chunk)

    def blocks(self, chunk: Sequence[int]) -> list[tuple[slice, ...]]:
        """The blocks in order of their numbers, as parts of the grid."""
        return [
            tuple(
                slice(i * own, min((i + 1) * own, size)) for i, own, size in zip(place, chunk, self.shape, strict=True)
            )
            for place in np.ndindex(*self._counts(chunk))
        ]

    def order(self, chunk: Sequence[int]) -> np.ndarray:
        """The numbers of the blocks, ordered so that blocks of one membrane follow each other."""
        counts = self._counts(chunk)
        numbers = np.arange(math.prod(counts)).reshape(counts)
        slow = sorted(range(len(counts)), key=lambda i: not self.axes[i].of_membrane)
        return numbers.transpose(slow).ravel()

    def _counts(self, chunk: Sequence[int]) -> list[int]:
        return [-(-size // own) for size, own in zip(self.shape, chunk, strict=True)]


def axes_of(parameters: Mapping[str, typing.Any], scene: Scene | None = None) -> tuple[Axis, ...]:
    """One axis for each parameter, with the name of the parameter; texts with units as numbers in SI."""

    def numbers(name: str, values: typing.Any) -> typing.Any:
        return scene.numbers_of(name, values) if isinstance(scene, Scene) else values

    return tuple(Axis(name, {name: numbers(name, values)}) for name, values in parameters.items())
