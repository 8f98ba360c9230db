"""Designs: regimes over parameters, optimisation, calibration."""
