"""How good a result is, and how good it can be: image quality, MTF, offset errors, Cramér-Rao bound, test targets."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
