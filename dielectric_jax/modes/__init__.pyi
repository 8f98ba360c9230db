from .spectrum import ModeShape, ModeSpectrum, lowest_eigenvalues, mode_spectrum, unstable_numbers

__all__ = ["ModeShape", "ModeSpectrum", "lowest_eigenvalues", "mode_spectrum", "unstable_numbers"]
