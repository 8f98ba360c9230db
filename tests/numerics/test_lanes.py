"""Lanes in calls of few sizes: the results are those of the plain function, whatever the number, the structure and the axes."""

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dielectric_jax.numerics import calls_of, lanes_of_a_call, run_lanes

sizes_of_calls = st.lists(st.integers(1, 40), min_size=1, max_size=3, unique=True).map(lambda s: tuple(sorted(s)))


@given(st.integers(0, 200), sizes_of_calls, st.floats(0.0, 0.9))
def test_calls_hold_every_lane_once(count, sizes, fill):
    calls = list(calls_of(count, sizes, fill))
    assert all(size in sizes for _, size in calls)
    assert [begin for begin, _ in calls] == list(np.cumsum([0, *(size for _, size in calls)])[:-1])
    *whole, (last, size) = calls
    assert all(begin + s <= count for begin, s in whole) and last + size >= count
    assert last < max(count, 1)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("out_axis", [0, -1])
@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 61])
def test_any_number_of_lanes(count, axis, out_axis):
    values = np.random.default_rng(count).normal(size=(3, count))
    seen, lock = [], threading.Lock()

    def program(part):
        x, scale = (np.moveaxis(v, axis, -1) for v in part)
        with lock:
            seen.append(x.shape[-1])
        first = np.stack([np.sin(x[0]), x.sum(axis=0)])
        return np.moveaxis(first, -1, out_axis), {"square": np.moveaxis(scale**2, -1, out_axis)}

    arguments = tuple(np.moveaxis(v, -1, axis) for v in (values, values[:1]))
    first, rest = run_lanes(program, arguments, sizes=(4, 8), axis=axis, out_axis=out_axis)
    assert set(seen) <= {4, 8}
    expected = np.stack([np.sin(values[0]), values.sum(axis=0)])
    np.testing.assert_array_equal(np.moveaxis(first, out_axis, -1), expected)
    np.testing.assert_array_equal(np.moveaxis(rest["square"], out_axis, -1), values[:1] ** 2)
    assert first.flags.writeable


def test_a_device_gets_larger_calls(monkeypatch):
    assert lanes_of_a_call(32) == 32
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    assert lanes_of_a_call(32) > 32
    shapes = []
    run_lanes(lambda x: shapes.append(x.shape) or x, np.zeros(5000), sizes=32, parallel=False)
    assert set(shapes) == {(lanes_of_a_call(32),)}
    assert len(shapes) == -(-5000 // lanes_of_a_call(32))


def test_an_error_in_a_call_is_raised():
    def program(part):
        if part[0] > 20:
            raise ValueError("`x` must be at most 20.")
        return part

    with pytest.raises(ValueError, match="at most 20"):
        run_lanes(program, np.arange(50.0), sizes=4)
