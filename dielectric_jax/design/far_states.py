"""States beyond the domain of a surface, by shooting, in the form in which equations on the sheet read them."""

import numpy as np

from ..model import Membrane, jacobian_program, run_chunks

__all__ = ["FarStates"]

_TRIES, _SETTLED = 12, 1e-8  # Newton's last move of p as a share, squared in what is left


class FarStates:
    """p and V at given (λa, q) of one membrane, by Newton's method in p from the pressures of the call before.

    `pressure` (n,) are the first guesses, `steps` those of the shots. What does not converge is NaN.
    """

    def __init__(self, membrane: Membrane, pressure: np.ndarray, steps: float):
        self.membrane, self.pressure, self.steps = membrane, np.array(pressure, float), steps

    def linear(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(p, V) at places (n, 2), and their derivatives (n, 2, 2) by (λa, q).

        From λ2(1) = λ0 at the rim, r(λa, p, q) = 0: ∂p/∂x = −r_x/r_p, and V_x + V_p ∂p/∂x.
        """
        apex, load = places.T
        p, rim = self.pressure.copy(), float(self.membrane.prestretch)
        volume, of_lag, of_volume = np.full(len(p), np.nan), np.full((3, len(p)), np.nan), np.full((3, len(p)), np.nan)
        todo = np.flatnonzero(np.isfinite(places).all(axis=1) & (p > 0))
        p[np.setdiff1d(np.arange(len(p)), todo)] = np.nan
        for _ in range(_TRIES):
            if not len(todo):
                break
            u = np.stack([apex[todo], p[todo], load[todo]])
            lag, volume[todo], columns, _ = run_chunks(
                lambda part: jacobian_program(self.membrane.material, part, self.steps), u
            )
            of_lag[:, todo], of_volume[:, todo] = columns[:, 0], columns[:, 1]
            of_lag[0, todo] += 1.0
            with np.errstate(all="ignore"):
                move = -(lag - (rim - u[0])) / of_lag[1, todo]
                move = np.clip(move, -0.5 * u[1], u[1])
            p[todo] += move
            volume[todo] += of_volume[1, todo] * move
            todo = todo[~(np.abs(move) <= _SETTLED * p[todo])]
        p[todo] = np.nan
        self.pressure = np.where(np.isfinite(p), p, self.pressure)
        with np.errstate(all="ignore"):
            slope = -of_lag[[0, 2]] / of_lag[1]
            slopes = np.stack([slope, of_volume[[0, 2]] + of_volume[1] * slope])
        return np.stack([p, np.where(np.isfinite(p), volume, np.nan)], axis=1), np.moveaxis(slopes, -1, 0)
