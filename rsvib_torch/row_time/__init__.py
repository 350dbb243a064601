"""Row time, readout direction and exposure from frames of flickering light or of a moving camera."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
