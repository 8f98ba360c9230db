"""Analysis of sweeps: counts, selection by regime, best designs, maps, and comparison with another sweep."""

from __future__ import annotations

import csv
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import REGIME_COLOURS
from ..numerics import need
from ..plot import COLOURS, labelled
from .resolution import TABLE_ROWS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["best_designs", "compare_sweeps", "count_sweep", "export_sweep", "plot_sweep", "select_regime"]


def _variable(data, name: str):
    if name not in data:
        raise ValueError(f"`{name}` must be a variable of the sweep, but it has {', '.join(map(str, data.data_vars))}.")
    return data[name]


def _meanings(variable) -> dict[str, int]:
    """The names of the codes of a variable, and their numbers."""
    attributes = variable.attrs
    if "flag_meanings" not in attributes:
        raise ValueError(f"`{variable.name}` must be a variable of codes, but has no `flag_meanings`.")
    return dict(
        zip(attributes["flag_meanings"].split(), np.atleast_1d(attributes["flag_values"]).tolist(), strict=True)
    )


def _scene_dims(data) -> tuple[str, ...]:
    return tuple(map(str, data["outcome"].dims))


def count_sweep(data) -> dict[str, Any]:
    """How many scenes have each outcome and each regime: {"scenes", "outcome": {name: count}, "regime": {name: count}}."""
    found: dict[str, Any] = {"scenes": int(data["outcome"].size)}
    for name in ("outcome", "regime"):
        values, counts = np.unique(data[name].values, return_counts=True)
        known = dict(zip(values.tolist(), counts.tolist(), strict=True))
        found[name] = {word: known[code] for word, code in _meanings(data[name]).items() if code in known}
    return found


def select_regime(data, *regimes: str):
    """The scenes in one of the regimes, along one dimension `scene` with every parameter as its coordinate.

    `regimes` are names of `Regime`, such as "returns". Raises ValueError for other names.
    """
    names = _meanings(data["regime"])
    for regime in regimes:
        if regime not in names:
            raise ValueError(f"`regime` must be one of {', '.join(names)}, but is {regime!r}.")
    return _at(data, np.flatnonzero(np.isin(data["regime"].values, [names[r] for r in regimes])))


def best_designs(data, variable: str = "area_strain", *, count: int = 10, where: Any = None, lowest: bool = False):
    """The scenes with the largest (or lowest) values of a variable, best first, along one dimension `scene`.

    `where`, a boolean array along the dimensions of the scenes such as `data.landing_ratio.isel(jump=0) <= 0.8`, excludes
    scenes that do not satisfy it. Scenes whose value is NaN are excluded.
    """
    values = _variable(data, variable)
    dims = _scene_dims(data)
    if set(values.dims) != set(dims):
        raise ValueError(f"`{variable}` must have one value a scene, but has the dimensions {', '.join(values.dims)}.")
    if not (isinstance(count, (int, np.integer)) and count > 0):
        raise ValueError(f"`count` must be a positive whole number, but is {count!r}.")
    flat = values.transpose(*dims).values.ravel().astype(float)
    flat = flat if lowest else -flat
    if where is not None:
        allowed = where.transpose(*dims).values if hasattr(where, "transpose") and hasattr(where, "dims") else where
        flat = np.where(np.broadcast_to(np.asarray(allowed, bool), values.shape).ravel(), flat, np.nan)
    order = np.argsort(flat, kind="stable")[:count]
    return _at(data, order[np.isfinite(flat[order])])


def _at(data, which: np.ndarray):
    """Scenes by their positions in the order of the grid, along one dimension `scene`."""
    xarray = need("xarray")
    dims = _scene_dims(data)
    places = np.unravel_index(which, data["outcome"].shape)
    index = {dim: xarray.DataArray(place, dims="scene") for dim, place in zip(dims, places, strict=True)}
    if dims == ("scene",):
        return data.isel(scene=which)
    return data.isel(index)


def compare_sweeps(one, other) -> dict[str, Any]:
    """How two sweeps of the same scenes differ, variable by variable.

    Returns {"variables": {name: {"differing", "one_only", "other_only", "largest", "beyond_errors"}}, "outcome": {...}}.
    `largest` is the largest |difference|/max(|value|, 1e-3) where both have a value; `beyond_errors` counts values
    that differ by more than ten times the larger of both errors; codes only count `differing`. Raises ValueError if the
    sweeps have different scenes.
    """
    for name in one.coords:
        if name not in other.coords or not np.array_equal(one[name].values, other[name].values):
            raise ValueError(f"The sweeps must have the same scenes, but `{name}` differs.")
    if one["outcome"].shape != other["outcome"].shape:
        raise ValueError("The sweeps must have the same scenes, but their shapes differ.")
    found: dict[str, Any] = {}
    for name in one.data_vars:
        if name not in other.data_vars:
            continue
        a, b = (d[name].transpose(*one[name].dims).values for d in (one, other))
        if a.dtype.kind != "f":
            found[name] = {"differing": int(np.sum(a != b))}
            continue
        known = np.isfinite(a), np.isfinite(b)
        both = known[0] & known[1]
        apart = np.abs(a[both] - b[both]) / np.maximum(np.abs(a[both]), 1e-3)
        found[name] = {
            "differing": int(np.sum(apart > 0)),
            "one_only": int(np.sum(known[0] & ~known[1])),
            "other_only": int(np.sum(known[1] & ~known[0])),
            "largest": float(apart.max(initial=0.0)),
        }
        error = one[name].attrs.get("ancillary_variables")
        if error in one and error in other:
            bound = np.maximum(*(d[error].broadcast_like(one[name]).values for d in (one, other)))
            found[name]["beyond_errors"] = int(np.sum(apart > 10 * bound[both]))
    return found


def plot_sweep(data: Any, variable: str, *, x: str, y: str, ax: Axes | None = None, legend: bool = True) -> Axes:
    """Draws a variable over two parameters: coloured cells on a grid of both, coloured points otherwise; codes have a legend.

    Args:
        data: the sweep; dimensions other than those of `x` and `y` must be reduced first (`sel`, `isel`).
        variable: a variable with one value for each scene, such as "regime" or "area_strain".
        x: the parameter along the horizontal axis.
        y: the parameter along the vertical axis.
        ax: the axes to draw on; new ones when None.
        legend: whether to add a legend of codes, or a colour bar.

    Returns:
        The axes.
    """
    import matplotlib.pyplot as plt
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    values, across, up = (_variable(data, name) for name in (variable, x, y))
    if set(values.dims) != {*across.dims, *up.dims} or x == y:
        raise ValueError(
            f"`{variable}` must vary along `{x}` and `{y}` alone, but has the dimensions {', '.join(values.dims) or 'none'}."
        )
    if ax is None:
        ax = plt.subplots(layout="constrained")[1]
    options: dict[str, Any] = {}
    codes = None
    if "flag_meanings" in values.attrs:
        codes = {word: code for word, code in _meanings(values).items() if code in values.values}
        limits = [*codes.values(), max(codes.values()) + 1]
        own = {regime.name: colour for regime, colour in REGIME_COLOURS.items()}
        palette = ListedColormap([own.get(word, COLOURS[i % len(COLOURS)]) for i, word in enumerate(codes)])
        options = {"cmap": palette, "norm": BoundaryNorm(np.array(limits) - 0.5, len(codes))}
    if len(values.dims) == 2:
        grid = values.transpose(up.dims[0], across.dims[0]).values
        drawn = ax.pcolormesh(across.values, up.values, grid, shading="nearest", rasterized=True, **options)
    else:
        drawn = ax.scatter(across.values, up.values, c=values.values, s=14, **options)
    for name, axis, place in ((x, ax.xaxis, across.values), (y, ax.yaxis, up.values)):
        axis.set_label_text(_label(data[name]))
        if place.min() > 0 and place.max() > 20 * place.min():
            (ax.set_xscale if axis is ax.xaxis else ax.set_yscale)("log")
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_locator(NullLocator())
    if legend and codes is not None:
        entries = [
            Patch(facecolor=options["cmap"](i), edgecolor="black", linewidth=0.5, label=word.replace("_", " "))
            for i, word in enumerate(codes)
        ]
        ax.legend(handles=entries, loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
    elif legend and ax.figure is not None:
        ax.figure.colorbar(drawn, ax=ax, label=_label(values))
    return ax


def _label(variable) -> str:
    words = variable.attrs.get("long_name", str(variable.name))
    symbols = {"mu": "μ", "epsilon": "ε", "sqrt": "√", "^2": "²", "^3": "³", " ": ""}
    unit = variable.attrs.get("counted_in", "1")
    for ascii_name, symbol in symbols.items():
        unit = unit.replace(ascii_name, symbol)
    si = variable.attrs.get("units", "1")
    return (
        labelled(words, unit=unit)
        if unit != "1"
        else labelled(words, unit="" if si == "1" else si, dimensionless=False)
    )


def export_sweep(data, path, *, variables: Sequence[str] | None = None) -> None:
    """Writes a sweep to a file: NetCDF if its name ends in .nc, a table with one line for each scene if it ends in .csv.

    A variable with several values becomes several columns (`snap_voltage_0`, …); codes are written by name. `variables`
    are those to write; all but curves when None (NetCDF: all). Raises ValueError for another suffix.
    """
    path = pathlib.Path(path)
    if variables is not None:
        data = data[[_variable(data, name).name for name in variables]]
    if path.suffix not in (".nc", ".csv"):
        raise ValueError(f"`path` must end in .nc or .csv, but is {str(path)!r}.")
    part = path.with_name(path.name + ".part")
    if path.suffix == ".nc":
        data.to_netcdf(part)
    else:
        _write_table(data, part, variables is not None)
    part.replace(path)


def _write_table(data, path: pathlib.Path, curves: bool) -> None:
    scenes = data[next(iter(data.data_vars))].dims if "outcome" not in data else data["outcome"].dims
    shape = [data.sizes[d] for d in scenes]
    coordinates = [name for name in data.coords if set(data[name].dims) <= set(scenes)]
    names = [n for n in data.data_vars if curves or "curve_point" not in data[n].dims]
    lead = max(1, TABLE_ROWS // max(1, int(np.prod(shape[1:]))))
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        for begin in range(0, shape[0], lead):
            part = data.isel({scenes[0]: slice(begin, begin + lead)})
            columns: dict[str, list] = {}
            for name in (*coordinates, *names):
                variable = part[name].broadcast_like(
                    part[names[0]].isel({d: 0 for d in part[names[0]].dims if d not in scenes})
                )
                variable = variable.transpose(*scenes, ...)
                table = variable.values.reshape(int(np.prod(variable.shape[: len(scenes)])), -1)
                words = {c: w for w, c in _meanings(variable).items()} if "flag_meanings" in variable.attrs else None
                for i, column in enumerate(table.T.tolist()):
                    key = name if table.shape[1] == 1 else f"{name}_{i}"
                    columns[key] = [words.get(v, v) for v in column] if words else column
            if begin == 0:
                writer.writerow(columns)
            writer.writerows([["" if v != v else v for v in row] for row in zip(*columns.values(), strict=True)])
