"""Continuation on curves given by a formula, and on the membrane with every step setting."""

import dataclasses
import enum
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.diagram.tracing import run_trace
from dielectric_jax.model import SCALE
from dielectric_jax.numerics import Code, Problem, Steps, advance, begin, locate_folds, shorter, stepped, trace

ONES = np.ones(2)
USUAL = Steps()


def box(low, high):
    """Margins of a box, both sides of every variable, and codes that name the sides of the last variable."""
    low, high = np.asarray(low, float), np.asarray(high, float)

    def margins(u, args):
        return jnp.concatenate([u - low, high - u])

    return {"margins": margins, "codes": (Code.window_stretch, Code.window_load) * len(low)}


@functools.partial(jax.jit, static_argnames=("residual", "margins", "codes", "steps"))
def run(residual, start, direction, margins, codes, steps=USUAL, scale=ONES, args=None, active=True):
    return trace(Problem(residual, scale, margins, codes, args, steps), start, direction, active)


def points(found):
    return np.asarray(found.points)[: int(found.count)], np.asarray(found.tangents)[: int(found.count)]


def turning_points(x, t, column):
    """Sign changes of a tangent's entry, with pairs hidden between neighbours found by the Hermite interpolant."""
    gap = np.linalg.norm(np.diff(x, axis=0), axis=1)
    share = np.linspace(0, 1, 201)[:, None]
    x0, x1, d0, d1 = x[:-1, column], x[1:, column], gap * t[:-1, column], gap * t[1:, column]
    # derivative of the cubic through both ends with both slopes
    slope = 6 * share * (1 - share) * (x1 - x0) + (1 - share) * (1 - 3 * share) * d0 + share * (3 * share - 2) * d1
    sign = np.sign(slope[:-1].T.ravel())
    sign = sign[sign != 0]
    return int((sign[1:] != sign[:-1]).sum())


def circle(u, args):
    return jnp.array([u @ u - 1.0])


def test_a_circle_closes():
    found = run(circle, np.array([1.0, 0.0]), np.array([0.0, 1.0]), **box([-2, -2], [2, 2]))
    x, t = points(found)
    assert Code(int(found.code)) is Code.closed
    np.testing.assert_allclose(np.hypot(*x.T), 1.0, atol=1e-6)
    np.testing.assert_allclose(t, np.stack([-x[:, 1], x[:, 0]], axis=1), atol=1e-3)
    angle = np.unwrap(np.arctan2(x[:, 1], x[:, 0]))
    assert (np.diff(angle) > 0).all()
    # once round: the last point is the first that reaches the start again
    assert 2 * math.pi <= angle[-1] < 2 * math.pi + 1.0
    assert angle[-2] < 2 * math.pi
    assert turning_points(x[:-1], t[:-1], 0) == 1 and turning_points(x[:-1], t[:-1], 1) == 2


def test_the_other_direction_and_an_inexact_start():
    found = run(circle, np.array([0.8, 0.1]), np.array([0.0, -1.0]), **box([-2, -2], [2, 2]))
    x, _ = points(found)
    assert Code(int(found.code)) is Code.closed
    assert (np.diff(np.unwrap(np.arctan2(x[:, 1], x[:, 0]))) < 0).all()
    np.testing.assert_allclose(np.hypot(*x.T), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("low", "high", "code"),
    [
        ([-0.5, -2], [2, 2], Code.window_stretch),
        ([-2, -2], [2, 0.5], Code.window_load),
    ],
)
def test_the_box_ends_a_branch_on_either_side(low, high, code):
    """The last point lies outside, the one before inside."""

    def margins(u, args):
        return jnp.stack([u[0] - low[0], high[0] - u[0], u[1] - low[1], high[1] - u[1]])

    codes = (Code.window_stretch, Code.window_stretch, Code.window_load, Code.window_load)
    for way in (1.0, -1.0):
        start, heading = (np.array([1.0, 0.0]), np.array([0.0, way]))
        if code is Code.window_load and way < 0:
            start = np.array([0.0, -1.0])
            heading = np.array([1.0, 0.0])
        found = run(circle, start, heading, margins, codes)
        x, _ = points(found)
        assert Code(int(found.code)) is code
        assert float(margins(x[-1], None).min()) < 0 <= float(margins(x[-2], None).min())


def test_all_four_sides():
    """A straight line u1 = s u0 left through each side of a box has the code of that side."""
    names = (Code.window_stretch, Code.lock_up, Code.window_load, Code.apex_cone)

    def margins(u, args):
        return jnp.stack([u[0] + 1, 1 - u[0], u[1] + 1, 1 - u[1]])

    def line(u, slope):
        return jnp.array([u[1] * slope[0] - u[0] * slope[1]])

    for slope, heading, code in (
        ((1.0, 0.3), (-1.0, -0.3), Code.window_stretch),
        ((1.0, 0.3), (1.0, 0.3), Code.lock_up),
        ((0.3, 1.0), (-0.3, -1.0), Code.window_load),
        ((0.3, 1.0), (0.3, 1.0), Code.apex_cone),
    ):
        found = run(line, np.zeros(2), np.array(heading), margins, names, args=jnp.array(slope))
        assert Code(int(found.code)) is code


def cubic(u, args):
    """Load = x³ − x: folds at x = ∓1/√3, load ±2/(3√3)."""
    return jnp.array([u[1] - u[0] ** 3 + u[0]])


def test_a_cubic_has_its_two_folds():
    found = run(cubic, np.array([-2.0, -6.0]), np.array([1.0, 11.0]), **box([-2.5, -9], [2.5, 9]))
    x, t = points(found)
    assert turning_points(x, t, 1) == 2 and turning_points(x, t, 0) == 0
    np.testing.assert_allclose(x[:, 1], x[:, 0] ** 3 - x[:, 0], atol=3e-6 * 20)
    assert x[:, 1][x[:, 0] < 0].max() == pytest.approx(2 / (3 * math.sqrt(3)), abs=0.05)
    assert x[:-1, 0].max() <= 2.5


@pytest.mark.parametrize("count", [3, 9])
def test_a_wavy_curve_has_every_fold(count):
    """load = x/10 + sin(x): folds where cos x = −1/10, two in every period."""

    def wave(u, args):
        return jnp.array([u[1] - u[0] / 10 - jnp.sin(u[0])])

    end = 2 * math.pi * count
    found = run(wave, np.zeros(2), np.array([1.0, 1.1]), **box([-1, -99], [end, 99]), steps=Steps(largest=2.0))
    x, t = points(found)
    assert turning_points(x, t, 1) == 2 * count
    assert Code(int(found.code)) is Code.window_stretch or Code(int(found.code)) is Code.window_load


def test_a_sharp_fold_needs_small_steps_and_gets_them():
    """u1 = 500 u0² has the radius 1e-3 at its fold, a thousandth of the largest step and 10⁴ smallest ones."""

    def parabola(u, args):
        return jnp.array([u[1] - 500 * u[0] ** 2])

    found = run(parabola, np.array([-0.1, 5.0]), np.array([0.1, -10.0]), **box([-9, -9], [9, 5.5]))
    x, t = points(found)
    assert turning_points(x, t, 1) == 1
    assert x[0, 0] < 0 < x[-1, 0] and x[-1, 1] > 5.5
    turn = np.arccos(np.clip((t[1:] * t[:-1]).sum(axis=1), -1, 1))
    assert turn.max() <= Steps().most_turn + 1e-12


def test_an_isola():
    """(x² − 1)² + λ² = 1/4 is two closed loops about x = ±1; each closes on itself."""

    def isola(u, args):
        return jnp.array([(u[0] ** 2 - 1) ** 2 + u[1] ** 2 - 0.25])

    for side in (-1.0, 1.0):
        found = run(isola, np.array([side, 0.5]), np.array([1.0, 0.0]), **box([-3, -3], [3, 3]))
        x, t = points(found)
        assert Code(int(found.code)) is Code.closed
        assert (np.sign(x[:, 0]) == side).all()
        assert x[:, 1].min() == pytest.approx(-0.5, abs=0.05) and x[:, 1].max() == pytest.approx(0.5, abs=0.05)
        # starting at one of its two turning points in the load, it passes the other and then the first again
        assert turning_points(x, t, 0) == 2


def test_codes_of_lanes_that_fail():
    def none(u, args):
        return jnp.array([u @ u + 1.0])  # no solution anywhere

    lost = run(none, np.array([1.0, 0.0]), np.array([0.0, 1.0]), **box([-2, -2], [2, 2]))
    assert Code(int(lost.code)) is Code.step_too_small and int(lost.count) <= 1
    short = run(circle, np.array([1.0, 0.0]), np.array([0.0, 1.0]), **box([-2, -2], [2, 2]), steps=Steps(most_points=5))
    assert Code(int(short.code)) is Code.too_many_points and int(short.count) == 5
    idle = run(circle, np.array([1.0, 0.0]), np.array([0.0, 1.0]), **box([-2, -2], [2, 2]), active=False)
    assert Code(int(idle.code)) is Code.not_converged and int(idle.count) == 0
    corner = run(
        lambda u, args: jnp.array([u[1] - jnp.abs(u[0])]),
        np.array([-1.0, 1.0]),
        np.array([1.0, -1.0]),
        **box([-2, -2], [2, 2]),
    )
    assert Code(int(corner.code)) is Code.step_too_small
    assert abs(points(corner)[0][-1]).max() < 1e-3


def test_a_lane_that_fails_leaves_the_others_alone():
    """Circles of radius √args: NaN, none (negative), and three sound ones, together and alone."""

    def residual(u, size):
        return jnp.array([u @ u - size])

    limits = box([-9, -9], [9, 9])
    sizes = np.array([1.0, np.nan, 4.0, -1.0, 0.25])
    starts = np.stack([np.sqrt(np.abs(np.nan_to_num(sizes, nan=1.0))), np.zeros(5)], axis=1)

    def lane(size, start):
        return trace(Problem(residual, ONES, args=size, **limits), start, jnp.array([0.0, 1.0]))

    together = jax.jit(jax.vmap(lane))(sizes, starts)
    assert [Code(int(c)).name for c in together.code] == [
        "closed",
        "step_too_small",
        "closed",
        "step_too_small",
        "closed",
    ]
    alone = jax.jit(lane)
    for k in (0, 2, 4):
        single = alone(sizes[k], starts[k])
        assert int(single.count) == int(together.count[k])
        np.testing.assert_allclose(single.points, together.points[k], rtol=1e-12, atol=1e-13)
        assert np.isnan(np.asarray(together.points[k])[int(single.count) :]).all()


def test_a_walk_may_be_given_its_value_and_jacobian():
    """As where they are computed outside: the same walk, which a NaN or `shorter` sends back to half the step."""
    inside = Problem(circle, ONES, **box([-2, -2], [2, 2]))
    outside = dataclasses.replace(inside, residual=None)
    walk = other = begin(inside, np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    for _ in range(12):
        walk, arrived = advance(inside, walk)
        other, also = stepped(outside, other, *inside.linear(other.trial))
        assert arrived == also
        jax.tree.map(np.testing.assert_array_equal, walk, other)
    assert int(walk.count) > 3
    back = shorter(walk)
    assert back.step == walk.step / 2 and (back.base == walk.base).all()
    there = np.asarray(back.trial - walk.base)
    assert abs(np.linalg.norm(there) / float(back.step) - 1) < 0.05 and there @ walk.tangent > 0
    lost, arrived = stepped(outside, back, np.full(1, np.nan), np.full((1, 2), np.nan))
    assert not arrived and lost.step == back.step / 2
    with pytest.raises(ValueError, match="`residual` must be a function, but is None"):
        outside.linear(walk.trial)


def test_the_scale_is_only_a_choice_of_units():
    """An ellipse in its own units is the circle."""

    def ellipse(u, args):
        return jnp.array([u[0] ** 2 + (u[1] / 0.01) ** 2 - 1.0])

    small = run(
        ellipse, np.array([1.0, 0.0]), np.array([0.0, 1.0]), **box([-2, -2], [2, 2]), scale=np.array([1.0, 0.01])
    )
    unit = run(circle, np.array([1.0, 0.0]), np.array([0.0, 1.0]), **box([-2, -200], [2, 200]))
    np.testing.assert_allclose(points(small)[0] / [1.0, 0.01], points(unit)[0], atol=1e-9)


@pytest.mark.parametrize(
    "options",
    [
        {"first": 0.0},
        {"largest": -1.0},
        {"smallest": 0.0},
        {"most_turn": 1.1},
        {"most_correction": 0.6},
        {"tolerance": 0.0},
        {"tolerance": float("nan")},
        {"most_points": 0},
    ],
    ids=lambda o: next(iter(o)),
)
def test_step_settings_out_of_range_are_refused_by_name(options):
    (name,) = options
    with pytest.raises(ValueError, match=f"^`{name}` must be .*, but is .*\\.$"):
        Steps(**options)


# --- the membrane at Φ = 0.15: four folds in pressure, two of them close to the cone ---

FOLDS = 4


@dataclasses.dataclass(frozen=True)
class TracedSteps(Steps):
    """The same settings as traced numbers, so that one compiled program serves every setting."""

    def __post_init__(self):
        pass


def settings():
    """Every bound at its extremes, one by one and together, and settings drawn at random."""
    out = [dict(most_turn=t, most_correction=c) for t in (0.05, 0.35, 1.0) for c in (0.01, 0.15, 0.5)]
    out += [dict(first=v) for v in (1e-4, 1.0, 100.0)]
    out += [dict(largest=v) for v in (0.2, 10.0, 1e3)]
    out += [dict(tolerance=v) for v in (1e-12, 1e-3, 1.0, 1e3)]
    out += [dict(smallest=v) for v in (1e-12, 1e-4)]
    out += [dict(first=100.0, largest=100.0, most_turn=1.0, most_correction=0.5, tolerance=t) for t in (1e-6, 1.0, 1e6)]
    rng = np.random.default_rng(15)
    for _ in range(24):
        out.append(
            dict(
                first=10 ** rng.uniform(-3, 0.5),
                largest=10 ** rng.uniform(-0.5, 0.4),
                most_turn=rng.uniform(0.1, 1.0),
                most_correction=rng.uniform(0.02, 0.5),
                tolerance=10 ** rng.uniform(-12, -2),
            )
        )
    return out


def pressure_curve(steps, seed, heading):
    condition = dj.ConstantVoltage(0.15).condition()
    material = dj.Gent()

    def residual(u, args):
        rim = dj.model.shoot(material, u[0], u[1], u[2], steps=44.0)
        return jnp.stack([rim.stretch_change - (1.0 - u[0]), condition.residual(u[1], rim.volume, u[2])])

    def margins(u, args):
        return jnp.stack([u[0] - 1.3, 10.8 - u[0], u[1] - 0.05, 9.0 - u[1]])

    problem = Problem(residual, jnp.asarray(SCALE), margins, codes=(Code.window_stretch,) * 4, steps=steps)
    return trace(problem, seed, heading)


def reachable(setting):
    try:
        Steps(**setting)
    except ValueError:
        return False
    return True


def test_four_folds_at_every_step_setting():
    """Whatever setting `Steps` does not refuse, the trace reaches the far end and passes all four folds."""
    asked = [setting for setting in settings() if reachable(setting)]
    assert len(asked) >= 20
    names = [f.name for f in dataclasses.fields(Steps) if f.name != "most_points"]
    table = np.array([[setting.get(n, getattr(Steps(), n)) for n in names] for setting in asked])
    state = dj.equilibrium(dj.Membrane(), voltage=0.15, volume=1.5)
    seed = np.array([state.apex_stretch, state.pressure, 0.0225])

    @jax.jit
    @jax.vmap
    def lanes(row):
        # a large bound on the points, so that small steps are not cut short
        steps = TracedSteps(**dict(zip(names, row, strict=True)), most_points=1500)
        return pressure_curve(steps, seed, jnp.array([1.0, 0.1, 0.0]))

    found = jax.device_get(lanes(table))
    lost = []
    for k, setting in enumerate(asked):
        x, t = (np.asarray(v)[k][: found.count[k]] for v in (found.points, found.tangents))
        folds = turning_points(x / SCALE, t, 1)
        if folds != FOLDS or not x[-1, 0] > 10.8:
            lost.append((setting, folds, Code(int(found.code[k])).name, int(found.count[k])))
    assert lost == []


@pytest.mark.parametrize(
    "options",
    [{"points": 8}, {"points": 20}, {"points": 64}, {"points": 700}, {"tolerance": 1e-5}, {"tolerance": 1e-10}],
    ids=str,
)
def test_four_folds_in_the_diagram_at_every_setting(membrane, options):
    """`points` and `tolerance` are the step settings of a diagram."""
    diagram = dj.pressure_volume(membrane, 0.15, **options)
    folds = sorted((p for p in diagram.special_points if p.kind == "fold"), key=lambda p: p.apex_stretch)
    assert [round(p.apex_stretch, 4) for p in folds] == [2.0992, 6.0512, 8.4119, 9.8986]
    assert len(diagram.branches) == 1 and diagram.complete


def test_tangents_of_a_trace_lead_along_it():
    """In scaled unknowns the tangent is a unit vector along the chord to the next point."""
    membrane = dj.Membrane()
    condition = dj.ConstantPressure(1.82).condition()
    limits = np.array([1.0, 11.6, -1.0, 1.0, 8.4])
    seed = np.array([1.82, 1.82, 0.0])
    points, tangents, _ = run_trace(membrane, condition, limits, seed, np.array([1.0, 0.0, 0.0]))
    chords = np.diff(points / SCALE, axis=0)
    chords /= np.linalg.norm(chords, axis=1)[:, None]
    assert np.allclose(np.linalg.norm(tangents, axis=1), 1.0)
    assert ((chords * tangents[:-1]).sum(axis=1) > 0.9).all()


def test_folds_are_located_and_reasons_of_ones_own_come_back():
    """q = x³ − 3x folds at x = ±1; with z = x² as a third unknown, and the residual's own codes."""

    class Reason(enum.IntEnum):
        too_far = 1000
        too_deep = 1001

    def curve(u, args):
        x, q, z = u
        return jnp.array([q - args * (x**3 - 3 * x), z - x**2])

    def margins(u, args):
        return jnp.array([2.5 - u[0], u[0] + 2.5])

    problem = Problem(curve, np.array([2.0, 1.0, 1.0]), margins, (Reason.too_far, Reason.too_deep), args=2.0)
    found = trace(problem, np.array([-2.2, 2 * (-(2.2**3) + 6.6), 4.84]), np.array([1.0, 0.0, 0.0]))
    assert problem.reason(found.code) is Reason.too_far
    folds = locate_folds(problem, found, 1)
    assert [fold.code for fold in folds] == [Code.ok, Code.ok]
    np.testing.assert_allclose([fold.point for fold in folds], [[-1, 4, 1], [1, -4, 1]], rtol=1e-13)
    for fold in folds:
        before, behind = (float(found.points[fold.after + k, 0]) for k in (0, 1))
        assert before < fold.point[0] < behind
    (turn,) = locate_folds(problem, found, 2)
    np.testing.assert_allclose(turn.point, [0, 0, 0], atol=1e-12)
    assert locate_folds(problem, found, 0) == []
    with pytest.raises(ValueError, match="`unknown` must be a number from 0 to 2, but is 3"):
        locate_folds(problem, found, 3)
    with pytest.raises(ValueError, match="IntEnum with numbers from 1000"):
        dataclasses.replace(problem, codes=(7,))
