"""The package's explicit map at many states, in chunks of one shape, which compile once."""

import jax
import numpy as np

import dielectric_jax as dj


@jax.jit
def of_gent(limit, apex, q, rim, steps):
    """p, V and the slope at the rim of Gent films; the limit and the rim may be those of each state."""
    return dj.model.explicit_map(dj.Gent(limit), apex, q, rim, steps)


def in_chunks(program, columns, size: int) -> np.ndarray:
    """What a program of columns (size,) gives for longer ones (n,): an array (outputs, n)."""
    count, out = len(columns[0]), []
    for i in range(0, count, size):
        part = [np.pad(c[i : i + size], (0, max(0, i + size - count)), mode="edge") for c in columns]
        out.append(np.stack(program(*part))[:, : count - i])
    return np.concatenate(out, axis=1)
