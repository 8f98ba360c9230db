"""Work and precision of single integrations: the shot to the rim, and the explicit map; one state alone and 128 at once.

Random states of the default membrane, from λa = 1.2 to 10, t from −0.3 to the load of breakdown. The truth is that of
`truth.py` in extended precision. The error is the largest over the states of the relative error of V and of the other
result: λ2 at the rim for the shot, p for the map.
"""

import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.integrate import solve_ivp

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.truth import extended_precision as truth
from benchmarks.truth import scipy_peers
from benchmarks.truth.chambers import STRETCH_LIMIT, breakdown_load
from dielectric_jax.model.membrane import apex_series, slopes
from dielectric_jax.model.shooting import EvenSteps, graded_map, integrate_membrane

MATERIAL = dj.Gent(STRETCH_LIMIT)
BATCH = 128
SHORTEST = 5e-3  # seconds of a round, which repeats its call until then
_FIRST = 4e-4
SOLVERS = {"Tsit5": dfx.Tsit5, "Dopri5": dfx.Dopri5, "Dopri8": dfx.Dopri8, "Kvaerno5": dfx.Kvaerno5}


class States:
    """Random states with their true p and V."""

    def __init__(self, count: int = BATCH, seed: int = 0):
        random = np.random.default_rng(seed)
        self.apex = random.uniform(1.2, 10.0, count)
        largest = truth.largest_load(self.apex, STRETCH_LIMIT)
        low, high = -0.3 * largest, np.minimum(breakdown_load(self.apex), 0.8 * largest)
        self.q = low + (high - low) * random.uniform(size=count)
        guess = jax.jit(dj.model.explicit_map)(MATERIAL, self.apex, self.q, 1.0)[0]
        p, v, uncertain = truth.exact(self.apex, guess, self.q, STRETCH_LIMIT, 1.0, steps=280)
        assert uncertain.max() < 1e-12, uncertain.max()
        self.p, self.v = (np.asarray(w, float) for w in (p, v))

    @property
    def count(self) -> int:
        return len(self.apex)

    def shot_error(self, stretch_change, v) -> float:
        some = slice(0, len(np.atleast_1d(v)))
        rim = np.abs(self.apex[some] + np.asarray(stretch_change) - 1)
        return float(np.max(np.maximum(rim, np.abs(v / self.v[some] - 1))))

    def map_error(self, p, v) -> float:
        some = slice(0, len(np.atleast_1d(v)))
        return float(np.max(np.maximum(np.abs(p / self.p[some] - 1), np.abs(v / self.v[some] - 1))))


def records_of(name, engine, knob, values, program, states, error, rounds):
    """Records of a JAX program(lanes, value), alone and in a batch, along the values of its knob."""
    compiled = jax.jit(program)
    lanes = tuple(jnp.asarray(w) for w in (states.apex, states.p, states.q))
    out = []
    for value in values:
        found = [np.asarray(w) for w in compiled(lanes, float(value))]
        for batch in (1, states.count):
            own = lanes if batch > 1 else tuple(w[:1] for w in lanes)
            if batch > 1:
                timing = harness.timed(lambda own=own, v=value: compiled(own, float(v)), rounds, shortest=SHORTEST)
                calls = 1
            else:  # adaptive steps depend on the state: a few of them, one after the other
                some = [tuple(w[k : k + 1] for w in lanes) for k in range(0, states.count, max(1, states.count // 8))]

                def each(some=some, v=value):
                    for lane in some:
                        jax.block_until_ready(compiled(lane, float(v)))

                timing, calls = harness.timed(each, rounds, shortest=SHORTEST), len(some)
            out.append(
                {
                    "name": name,
                    "engine": engine,
                    "parameters": {knob: value, "batch": batch},
                    "error": error(*found[:2]),
                    "seconds": timing.best / calls / batch,
                    "compile_seconds": timing.compile_seconds / calls,
                    "counts": {"states": states.count},
                }
            )
    return out


def own_shot(lanes, steps):
    """Ours: `shoot` is this one with a derivative rule."""
    shot = integrate_membrane(MATERIAL, *lanes, steps)
    return shot.stretch_change, shot.volume


def _rates(radius, y, lane):
    apex, p, q = lane
    l1, l2 = apex + y[0], apex + y[1]
    rate = slopes(MATERIAL, radius, l1, l2, y[2], p, q)
    return jnp.stack([*rate, jnp.pi * (radius * l2) ** 2 * l1 * jnp.sin(y[2])])


def _series(lane):
    apex, p, q = lane
    a, b, kappa = apex_series(MATERIAL, apex, p, q)
    scale = jnp.minimum(1 / kappa, 1.0)
    first = _FIRST * scale
    l1, l2 = apex + a * first**2, apex + b * first**2
    slope = jnp.arcsin(p * first * l2**2 / (2 * dj.model.stresses(MATERIAL, l1, l2, q)[0]))
    return scale, first, jnp.stack([a * first**2, b * first**2, slope, jnp.pi / 4 * apex**3 * kappa * first**4])


def diffrax_shot(solver: str, graded: bool):
    """A shot by a solver of diffrax as it comes: on even steps of our graded grid, or under its PID controller in R."""

    def one(lane, value):
        scale, first, start = _series(lane)
        made = SOLVERS[solver]()
        options = {"saveat": dfx.SaveAt(t1=True), "adjoint": dfx.ForwardMode(), "throw": False, "max_steps": 20_000}
        if graded:
            position = graded_map(scale, first)

            def field(tau, y, args):
                radius, stretching = position(tau)
                return stretching * _rates(radius, y, lane)

            steps = EvenSteps(value)
            if solver == "Kvaerno5":
                made = dfx.Kvaerno5(root_finder=optx.Newton(rtol=1e-10, atol=1e-12))  # its own diverges on given steps
            done = dfx.diffeqsolve(
                dfx.ODETerm(field), made, 0.0, 1.0, None, start, stepsize_controller=steps, **options
            )
        else:
            control = dfx.PIDController(rtol=10.0**-value, atol=10.0 ** (-value - 2))
            term = dfx.ODETerm(lambda radius, y, args: _rates(radius, y, lane))
            done = dfx.diffeqsolve(term, made, first, 1.0, first, start, stepsize_controller=control, **options)
        return done.ys[-1][1], done.ys[-1][3]

    return lambda lanes, value: jax.vmap(lambda *lane: one(lane, value))(*lanes)


def scipy_shot(method: str, tolerance: float, states, count: int):
    def one(k):
        x = states.apex[k], states.p[k], states.q[k]

        def rates(radius, y):
            return scipy_peers.slopes(radius, *y[:3].tolist(), x[1], x[2])

        first = scipy_peers.series(x)
        return solve_ivp(
            rates, (scipy_peers.FIRST, 1.0), first, method=method, rtol=tolerance, atol=1e-3 * tolerance
        ).y[:, -1]

    ends = np.array([one(k) for k in range(count)])
    return ends[:, 0] - states.apex[:count], ends[:, 3]


def shot_records(quick: bool) -> list[dict]:
    states = States(8 if quick else BATCH)
    rounds = 1 if quick else 3
    out = records_of(
        "shot",
        "dielectric_jax",
        "steps",
        (16, 32) if quick else (8, 12, 16, 24, 32, 48, 64, 96),
        own_shot,
        states,
        states.shot_error,
        rounds,
    )
    for solver in ("Tsit5",) if quick else SOLVERS:
        low = solver in ("Tsit5", "Dopri5")
        for graded in (True, False):
            if graded:
                values = (
                    (16, 32)
                    if quick
                    else (16, 32, 64, 128, 256)
                    if low or solver == "Kvaerno5"
                    else (8, 16, 24, 32, 48, 64, 96)
                )
            else:
                values = (4, 6) if quick else (4, 6, 8, 10, 12) if solver != "Kvaerno5" else (4, 6, 8)
            engine = f"diffrax {solver}, {'graded grid' if graded else 'PID controller'}"
            knob = "steps" if graded else "digits"
            program = diffrax_shot(solver, graded)
            out += records_of("shot", engine, knob, values, program, states, states.shot_error, rounds)
            harness.say(f"{engine}: {out[-1]['seconds'] * 1e6:.0f} µs at {out[-1]['error']:.1e}")
    for method in ("DOP853", "RK45"):
        for digits in (6,) if quick else (4, 6, 8, 10, 12):
            count = 4 if quick else 8
            error = states.shot_error(*scipy_shot(method, 10.0**-digits, states, count))
            run = functools.partial(scipy_shot, method, 10.0**-digits, states, count)
            best = harness.timed(run, 1, shortest=SHORTEST).best
            parameters = {"digits": digits, "batch": 1}
            one = {"name": "shot", "engine": f"SciPy {method}", "parameters": parameters, "error": error}
            out.append(one | {"seconds": best / count, "compile_seconds": 0.0, "counts": {"states": count}})
    return out


def map_records(quick: bool) -> list[dict]:
    states = States(8 if quick else BATCH)
    rounds = 1 if quick else 3

    def own(lanes, steps):
        apex, _, q = lanes
        return dj.model.explicit_map(MATERIAL, apex, q, 1.0, steps)[:2]

    steps = (16, 32) if quick else (8, 12, 16, 24, 32, 48, 64, 96)
    out = records_of("map", "dielectric_jax, explicit map", "steps", steps, own, states, states.map_error, rounds)
    for tolerance in () if quick else (1e-5, 1e-7, 1e-9):
        surface = dj.Surface.build(dj.Membrane(MATERIAL), tolerance=tolerance)

        def on_surface(lanes, _, surface=surface):
            state = surface(lanes[0], lanes[2])
            return state.pressure, state.volume

        out += records_of(
            "map", "dielectric_jax, surface", "tolerance", (tolerance,), on_surface, states, states.map_error, rounds
        )
    for digits in (6,) if quick else (4, 6, 8, 10, 12):
        count = 4 if quick else 8

        def by_scipy(digits=digits, count=count):
            return np.array(
                [scipy_map(a, q, 10.0**-digits) for a, q in zip(states.apex[:count], states.q[:count], strict=True)]
            )

        p, v = by_scipy().T
        best = harness.timed(by_scipy, 1, shortest=SHORTEST).best
        one = {"name": "map", "engine": "SciPy DOP853 with an event", "parameters": {"digits": digits, "batch": 1}}
        one |= {"error": states.map_error(p, v), "seconds": best / count, "compile_seconds": 0.0}
        out.append(one | {"counts": {"states": count}})
    return out


def scipy_map(apex, q, tolerance):
    """p and V at (λa, q): integrated at p = 1 to the radius where λ2 = 1, then scaled."""

    def rates(radius, y):
        return scipy_peers.slopes(radius, *y[:3].tolist(), 1.0, q)

    def at_rim(radius, y):
        return y[0] - 1.0

    at_rim.terminal = True
    start = scipy_peers.series((apex, 1.0, q))
    done = solve_ivp(
        rates, (scipy_peers.FIRST, 50.0), start, method="DOP853", rtol=tolerance, atol=1e-3 * tolerance, events=at_rim
    )
    radius = done.t_events[0][0]
    return radius, done.y_events[0][0][3] / radius**3
