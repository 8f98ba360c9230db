"""Bifurcation diagrams of a dielectric-elastomer membrane on an air chamber, exact to nine digits, in JAX."""

import lazy_loader

__version__ = "0.1.0"

# names are imported when they are first asked for, so that the command line answers bad input at once
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
