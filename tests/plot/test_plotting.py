"""Figures of synthetic diagrams whose curves are known: what is drawn, where, and in which style."""

import types

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.model.records import Branch, Event, SpecialPoint, State
from dielectric_jax.numerics.codes import Code
from dielectric_jax.plot.diagrams import (
    chamber_voltages,
    plot_chamber,
    plot_diagram,
    plot_membrane_curves,
    plot_pressure_volume,
    plot_voltage_volume,
)
from dielectric_jax.plot.drawing import seen_entries

SNAP_Q, DIP_Q = 0.006, -0.002


def load(volume):
    """q(V) = a cubic with its fold at (4, SNAP_Q) and its dip at (12, DIP_Q), and zero at the start near V = 2."""
    s = (volume - 8) / 4
    middle, swing = (SNAP_Q + DIP_Q) / 2, (SNAP_Q - DIP_Q) / 2
    return middle + swing * (s**3 - 3 * s) / 2


def state_values(volume, q):
    return {
        "voltage_squared": q,
        "pressure": 1.9 - 0.03 * volume,
        "volume": volume,
        "apex_stretch": 1 + volume**0.5,
        "height": volume**0.3,
        "charge": np.sqrt(np.maximum(q, 0)) * volume,
        "breakdown_ratio": np.sqrt(np.maximum(q, 0)) * volume / 1.6,
        "error_estimate": 1e-11 * np.ones_like(volume),
    }


def branch_of(volume, q, index, **more):
    values = state_values(volume, q) | more
    return Branch(**values, index=index, start=Code.window_load, end=Code.lock_up)


def state(volume, q, cls=State, index=0, **more):
    values = {k: float(v) for k, v in state_values(np.float64(volume), np.float64(q)).items()}
    return cls(**values, index=index, **more)


def roots(q):
    """All V with load(V) = q."""
    middle, swing = (SNAP_Q + DIP_Q) / 2, (SNAP_Q - DIP_Q) / 2
    s = np.roots([0.5, 0, -1.5, (middle - q) / swing])
    return sorted(8 + 4 * s[np.abs(s.imag) < 1e-6].real)


def voltage_diagram():
    volume = np.linspace(0.2, 30.0, 60)
    index = np.where((volume > 4) & (volume < 12), 1, 0)
    branches = [branch_of(volume, load(volume), index)]
    far = np.linspace(15.0, 22.0, 20)
    branches.append(branch_of(far, 0.009 + (far - 18) ** 2 / 1e4, np.ones(20, int)))
    landing = roots(SNAP_Q)[-1]
    points = [
        state(4.0, SNAP_Q, SpecialPoint, None, kind="fold", branch=0),
        state(12.0, DIP_Q, SpecialPoint, None, kind="fold", branch=0),
        *(state(v, 0.0, SpecialPoint, 0, kind="zero_voltage", branch=0) for v in roots(0.0)),
        state(18.0, 0.009, SpecialPoint, None, kind="fold", branch=1),
    ]
    up = [
        Event("start", "up", state(roots(0.0)[0], 0.0)),
        Event("snap", "up", state(4.0, SNAP_Q, index=None)),
        Event("landing", "up", state(landing, SNAP_Q)),
        Event("breakdown", "up", state(17.6, load(17.6)), "breakdown on the branch"),
    ]
    down = [
        Event("start", "down", state(17.0, load(17.0))),
        Event("end", "down", state(roots(0.0)[-1], 0.0), "zero voltage"),
    ]
    loading = types.SimpleNamespace(pressure=None)
    return types.SimpleNamespace(
        kind="voltage-volume",
        branches=branches,
        special_points=points,
        events=tuple(up + down),
        area_strain=3.0,
        area_strain_reason="breakdown on the branch",
        scene=types.SimpleNamespace(loading=loading),
        voltage=None,
        complete=True,
        gas_pressure=lambda v: 1.9 - 0.03 * v,
    )


def pressure_diagram(voltage):
    volume = np.linspace(0.01, 120.0, 400)
    pressure = (1 - 10 * voltage**2) * 6 * volume / (1 + volume**1.5) + np.exp((volume - 100) / 10)
    slope = np.gradient(pressure, volume)
    peak = int(np.argmax(slope < 0))
    index = (slope < 0).astype(int)
    branch = branch_of(volume, np.full_like(volume, voltage**2), index, pressure=pressure)
    values = {k: float(getattr(branch, k)[peak]) for k in state_values(volume, volume)}
    fold = SpecialPoint(**values, index=None, kind="fold", branch=0)
    return types.SimpleNamespace(
        kind="pressure-volume",
        branches=[branch],
        special_points=[fold],
        events=(),
        area_strain=None,
        area_strain_reason=None,
        scene=None,
        complete=True,
        voltage=voltage,
    )


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def curves_of(ax):
    """The lines of the branches, apart from markers."""
    return [line for line in ax.lines if line.get_marker() in ("None", None, "") and len(line.get_xdata()) > 1]


def is_dashed(line):
    return line.get_linestyle() not in ("-", "solid")


def test_a_given_ax_is_drawn_on_and_none_makes_one():
    _, ax = plt.subplots()
    assert plot_voltage_volume(voltage_diagram(), ax=ax) is ax
    assert len(curves_of(ax)) > 0
    before = len(plt.get_fignums())
    made = plot_voltage_volume(voltage_diagram())
    assert made is not ax and len(plt.get_fignums()) == before + 1

    _, ax = plt.subplots()
    assert plot_pressure_volume(pressure_diagram(0.0), ax=ax) is ax
    assert plot_pressure_volume(pressure_diagram(0.0)) is not ax

    before = plt.get_fignums()
    for diagram in (voltage_diagram(), pressure_diagram(0.0)):
        _, ax = plt.subplots()
        assert plot_diagram(diagram, ax=ax) is ax and len(curves_of(ax)) > 0
    assert len(plt.get_fignums()) == len(before) + 2
    with pytest.raises(ValueError, match="`ax` must be left out where `curves` is given"):
        plot_diagram(voltage_diagram(), [pressure_diagram(0.0)], ax=ax)


def test_a_notebook_shows_a_figure_once_and_scripts_can_show_it():
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    made = "figure = dj.plot.new_figure(3.0)\naxes = figure.add_subplot()"
    cells = ["import dielectric_jax as dj", made, f"{made}\nfigure", f"{made}\naxes.plot([0, 1])"]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in cells])
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    pictures = [sum("image/png" in output.get("data", ()) for output in cell.outputs) for cell in notebook.cells]
    assert pictures == [0, 1, 1, 1]
    figure = dj.plot.new_figure(3.0)
    assert plt.figure(figure.number) is figure


def test_stable_is_solid_unstable_dashed_and_they_meet_at_the_fold():
    ax = plot_voltage_volume(voltage_diagram())
    blue = [line for line in curves_of(ax) if line.get_color() == "#0072B2"]
    for line in blue:
        middle = np.mean(line.get_xdata()[[0, -1]])
        assert is_dashed(line) == (4 < middle < 12)
    dashed = next(line for line in blue if is_dashed(line))
    assert dashed.get_xdata()[0] == 4.0
    assert dashed.get_ydata()[0] == pytest.approx(np.sqrt(SNAP_Q), rel=1e-12)


def test_states_no_voltage_reaches_are_left_out_and_the_curve_starts_at_zero():
    ax = plot_voltage_volume(voltage_diagram())
    low, high = roots(0.0)[1:]
    for line in curves_of(ax):
        x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
        drawn = np.isfinite(y)
        assert np.all(y[drawn] >= 0)
        if line.get_color() == "#0072B2":
            assert not np.any((x[drawn] > low + 0.05) & (x[drawn] < high - 0.05))
    first = curves_of(ax)[0]
    y = np.asarray(first.get_ydata())
    start = np.flatnonzero(np.isfinite(y))[0]
    assert y[start] == pytest.approx(0, abs=1e-9)
    assert first.get_xdata()[start] == pytest.approx(roots(0.0)[0], abs=0.02)


def test_pale_beyond_breakdown():
    ax = plot_voltage_volume(voltage_diagram())
    pale = [line for line in curves_of(ax) if line.get_alpha() == 0.45]
    assert pale
    for line in pale:
        inside = np.asarray(line.get_xdata())[1:-1]
        assert np.all(np.sqrt(load(inside)) * inside / 1.6 >= 0.999) or line.get_color() != "#0072B2"


def test_limits_frame_the_ramp_or_everything():
    diagram = voltage_diagram()
    right = plot_voltage_volume(diagram).get_xlim()[1]
    assert 17.6 < right < 30
    assert plot_voltage_volume(diagram, whole=True).get_xlim()[1] >= 30


def test_snap_is_an_arrow_level_in_voltage():
    ax = plot_voltage_volume(voltage_diagram(), legend=False)
    assert ax.get_legend() is None
    arrows = [t for t in ax.texts if getattr(t, "arrow_patch", None) is not None]
    assert len(arrows) == 1
    (x0, y0), (x1, y1) = arrows[0].xyann, arrows[0].xy
    assert 4 < x0 < x1 < roots(SNAP_Q)[-1]
    assert y0 == y1 == pytest.approx(np.sqrt(SNAP_Q))


def test_labels_are_words_with_symbols():
    ax = plot_voltage_volume(voltage_diagram())
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Volume $V$ / $A^3$", r"Voltage $Φ$ / ($H\sqrt{μ/ε}$)")
    ax = plot_pressure_volume([pressure_diagram(0.0), pressure_diagram(0.1)])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Volume $V$ / $A^3$", "Pressure $p$ / ($μH/A$)")
    words = [t.get_text() for t in ax.get_legend().get_texts()]
    assert words[:2] == ["$Φ$ = 0", "$Φ$ = 0.1"] and "unstable" in words


@pytest.mark.parametrize(
    "loading", [dj.ConstantPressure(1.0), dj.Chamber(volume=100.0, initial_volume=2.0), dj.PrescribedVolume(2.0)]
)
def test_curves_are_dashed_where_the_loading_lets_them_snap(loading):
    """p = 2 − a(V − 3)² falls beyond its peak; a chamber holds it until the slope −2a(V − 3) reaches −(p + 50)/(V + 100)."""
    a, volume = 0.05, np.linspace(0.5, 9.0, 400)
    branch = branch_of(volume, 0 * volume, (volume > 3).astype(int), pressure=2 - a * (volume - 3) ** 2)
    curve = types.SimpleNamespace(kind="pressure-volume", scene=None, voltage=0.0, branches=[branch], special_points=[])
    _, ax = plt.subplots()
    diagram = types.SimpleNamespace(scene=types.SimpleNamespace(loading=loading))
    plot_membrane_curves(diagram, [curve], ["red"], ax=ax)
    dashed = [line for line in curves_of(ax) if is_dashed(line)]
    if isinstance(loading, dj.PrescribedVolume):
        assert not dashed
        return
    # 2a(V − 3)(V + 100) = 52 − a(V − 3)²
    turn = 3.0 if isinstance(loading, dj.ConstantPressure) else max(np.roots([3 * a, 188 * a, -591 * a - 52]))
    (line,) = dashed
    assert line.get_xdata()[0] == pytest.approx(turn, abs=0.03)
    assert [word for _, word in seen_entries(ax)] == ["stable", "unstable"]


def test_a_legend_explains_what_is_in_view():
    ax = plot_voltage_volume(voltage_diagram())
    words = {text.get_text() for text in ax.get_legend().get_texts()}
    assert {"stable", "unstable", "snap", "landing", "breakdown of the ramp"} <= words
    ax.set_xlim(2.5, 3.5)
    assert [word for _, word in seen_entries(ax)] == ["stable"]


def test_two_events_of_one_state_are_both_seen():
    diagram = voltage_diagram()
    start, snap, landing, _, *down = diagram.events
    broken = Event("breakdown", "up", landing.state, "breakdown in the snap")
    diagram.events = (start, snap, landing, broken, *down)
    ax = plot_voltage_volume(diagram)
    ring, cross = (next(k for k in ax.lines if k.get_marker() == m and k.get_zorder() != 4) for m in "DX")
    assert ring.get_markersize() > cross.get_markersize() + 2 and ring.get_zorder() < cross.get_zorder()
    assert ring.get_markerfacecolor() == "white" != cross.get_markerfacecolor()


@pytest.mark.parametrize(
    ("x", "y", "relation"),
    [
        ("apex_stretch", "volume", lambda x: (x - 1) ** 2),
        ("height", "volume", lambda x: x ** (1 / 0.3)),
        ("volume", "voltage_squared", load),
        ("breakdown_ratio", "charge", lambda x: 1.6 * x),
        ("pressure", "voltage", lambda x: np.sqrt(load((1.9 - x) / 0.03))),
    ],
)
def test_any_column_against_any_other(x, y, relation):
    """The columns of the synthetic branch are functions of its volume, and so of each other."""
    _, ax = plt.subplots()
    diagram = voltage_diagram()
    diagram.branches, diagram.special_points = diagram.branches[:1], diagram.special_points[:-1]
    assert plot_diagram(diagram, x=x, y=y, ax=ax) is ax
    lines = [line for line in curves_of(ax) if line.get_color() == "#0072B2"]
    drawn = np.concatenate([np.asarray(line.get_xydata(), float) for line in lines])
    own = np.stack([getattr(diagram.branches[0], name) for name in (x, y)], axis=1)
    own = own[(diagram.branches[0].voltage_squared > 0) & np.isfinite(own).all(axis=1)]
    np.testing.assert_allclose(own[:, 1], relation(own[:, 0]), rtol=1e-9)
    for place in own:
        assert np.nanmin(np.abs(drawn - place).max(axis=1)) < 1e-12
    markers = [line.get_xydata()[0] for line in ax.lines if line.get_marker() == "o" and line.get_zorder() == 4]
    folds = [
        (p.volume, q)
        for p, q in zip(diagram.special_points[:2], (SNAP_Q, DIP_Q), strict=True)
        if q > 0 or "squared" in y
    ]
    wanted = [[float(getattr(state(v, q), name)) for name in (x, y)] for v, q in folds]
    np.testing.assert_allclose([m for m in markers if np.isfinite(m).all()][: len(wanted)], wanted, rtol=1e-12)


def test_columns_carry_their_units():
    units = dj.Units()
    ax = plot_diagram(voltage_diagram(), x="volume", y="voltage", units=units)
    (left,) = ax.axes
    assert (left.get_xlabel(), left.get_ylabel()) == ("Volume $V$ / ml", "Voltage $Φ$ / kV")
    top = max(np.nanmax(line.get_ydata()) for line in left.lines if line.get_marker() == "X")
    assert top == pytest.approx(units.read(1.0, "voltage") * np.sqrt(load(17.6)), rel=1e-9)
    counted = plot_diagram(voltage_diagram(), x="volume", y="index").axes[0]
    assert counted.get_ylabel() == "Number of unstable directions"
    assert {float(v) for line in counted.lines for v in line.get_ydata()} <= {0.0, 0.5, 1.0}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"x": "volume"}, "`x` and `y` must be given together, but `y` is missing"),
        ({"x": "volume", "y": "speed"}, "`y` must be one of voltage, voltage_squared, pressure, .* but is 'speed'"),
        ({"x": "volume", "y": "volume"}, "`x` and `y` must be two columns, but both are 'volume'"),
        ({"x": "volume", "y": "pressure", "curves": [0]}, "`curves` must be left out where `x` and `y` are given"),
    ],
)
def test_columns_that_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        plot_diagram(voltage_diagram(), **given)


def test_gas_line_is_the_function_given():
    ax = plot_pressure_volume(pressure_diagram(0.0), gas_line=lambda v: 1.5 - 0.01 * v)
    black = next(line for line in ax.lines if line.get_color() == "black" and len(line.get_xdata()) > 50)
    assert np.allclose(black.get_ydata(), 1.5 - 0.01 * np.asarray(black.get_xdata()), rtol=1e-14)
    assert is_dashed(black)


def test_chamber_figure_has_both_panels_on_one_volume_axis():
    diagram = voltage_diagram()
    figure = plot_chamber(diagram, [pressure_diagram(v) for v in chamber_voltages(diagram)])
    left, right = figure.axes
    assert left.get_xlim() == right.get_xlim()
    assert len(plot_diagram(diagram).axes) == 1
    assert len(plot_diagram(pressure_diagram(0.05)).axes) == 1
    given = plt.figure()
    assert plot_diagram(diagram, figure=given) is given


def test_constant_pressure_draws_a_level_line():
    diagram = voltage_diagram()
    diagram.gas_pressure = lambda v: None
    diagram.scene.loading.pressure = 1.25
    left = plot_chamber(diagram, [pressure_diagram(0.0)]).axes[0]
    black = next(line for line in left.lines if line.get_color() == "black" and len(line.get_xdata()) > 50)
    assert np.all(np.asarray(black.get_ydata()) == 1.25)


def test_chamber_voltages_are_zero_snap_and_end():
    assert chamber_voltages(voltage_diagram()) == pytest.approx([0.0, np.sqrt(SNAP_Q), np.sqrt(load(17.6))])


def test_one_event_and_flat_films_are_drawn():
    diagram = voltage_diagram()
    diagram.events = (Event("start", "up", state(roots(0.0)[0], 0.0), "start_unstable"),)
    plot_voltage_volume(diagram).figure.canvas.draw()
    q = np.linspace(-0.1, 0.2, 20)
    flat = branch_of(np.zeros(20), q, np.zeros(20, int))
    slack = state(0.0, 0.2, SpecialPoint, None, kind="slack", branch=0)
    diagram.branches, diagram.special_points, diagram.events = [flat], [slack], ()
    ax = plot_voltage_volume(diagram)
    ax.figure.canvas.draw()
    assert ax.get_ylim()[1] > np.sqrt(0.2)


def test_no_branch_at_all_is_an_empty_plot():
    diagram = voltage_diagram()
    diagram.branches, diagram.special_points, diagram.events = [], [], ()
    assert curves_of(plot_voltage_volume(diagram)) == []


def test_the_wrong_kind_is_refused():
    with pytest.raises(ValueError, match=r"must be of kind 'voltage-volume', but is of kind 'pressure-volume'"):
        plot_voltage_volume(pressure_diagram(0.0))
    with pytest.raises(ValueError, match=r"must be of kind 'pressure-volume'"):
        plot_pressure_volume(voltage_diagram())
    with pytest.raises(ValueError, match="at least one diagram"):
        plot_pressure_volume([])
    with pytest.raises(ValueError, match="`curves` must be empty"):
        plot_diagram(pressure_diagram(0.0), [pressure_diagram(0.1)])
