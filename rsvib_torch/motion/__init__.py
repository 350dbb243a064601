"""Motion of the image on the sensor: timing of rows, the base class of motions, vibrations, splines, recordings."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
