"""The membrane: parameters, materials, loadings, equations, shooting, the explicit map and its scan."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
