"""Motions recorded by gyroscopes: files, alignment of clocks and axes, checks."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
