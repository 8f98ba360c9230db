from .jacobi import ConjugatePoints, conjugate_points
from .spectrum import (
    ModeShape,
    ModeSpectrum,
    checked_numbers,
    lowest_eigenvalue,
    lowest_eigenvalues,
    lowest_of_numbers,
    mode_spectrum,
)

__all__ = [
    "ConjugatePoints",
    "ModeShape",
    "ModeSpectrum",
    "checked_numbers",
    "conjugate_points",
    "lowest_eigenvalue",
    "lowest_eigenvalues",
    "lowest_of_numbers",
    "mode_spectrum",
]
