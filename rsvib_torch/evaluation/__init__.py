"""How good a result is, and how good it can be: image quality, MTF, Cramér-Rao bound."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
