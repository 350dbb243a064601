"""Stacks of any length, processed window by window: windows, engines, runs and how they resume, manifest, memory."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
