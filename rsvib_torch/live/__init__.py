"""Frames of a running camera: sources, outputs, a page in the browser, spectrogram, and the loop between them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
