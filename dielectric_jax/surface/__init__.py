"""All equilibria of a membrane, or of a family of prestretches, as a piecewise polynomial."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
