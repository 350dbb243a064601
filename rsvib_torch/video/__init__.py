"""Videos and running cameras: path of the camera, steadying, restoration of a file, live session."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
