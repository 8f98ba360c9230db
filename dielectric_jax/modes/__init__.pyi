from .spectrum import ModeShape, ModeSpectrum, checked_numbers, lowest_eigenvalues, lowest_of_numbers, mode_spectrum

__all__ = ["ModeShape", "ModeSpectrum", "checked_numbers", "lowest_eigenvalues", "lowest_of_numbers", "mode_spectrum"]
