"""Displacements of row bands and of single rows between frames, measured on the images."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
