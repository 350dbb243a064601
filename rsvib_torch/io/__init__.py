"""Stacks of frames in files: the registry of formats, one module per format, and atomic writes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
