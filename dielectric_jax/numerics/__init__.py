"""Methods that know no membrane: continuation, compiled programs, codes, caches."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
