"""Bifurcation diagrams: states, branches, special points, ramps, regimes, alone and in batches."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
