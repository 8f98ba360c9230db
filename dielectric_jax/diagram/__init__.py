"""Bifurcation diagrams: states, branches, special points, ramps, regimes, alone and in batches."""
