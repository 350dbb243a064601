"""Vibration followed frame by frame at the rate of a camera, and the path of a camera."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
