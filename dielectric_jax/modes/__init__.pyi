from .spectrum import ModeShape, ModeSpectrum, checked_numbers, lowest_eigenvalues, mode_spectrum, unstable_numbers

__all__ = ["ModeShape", "ModeSpectrum", "checked_numbers", "lowest_eigenvalues", "mode_spectrum", "unstable_numbers"]
