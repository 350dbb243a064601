"""Image formation: motion within an exposure, point spread functions, blur, optics, noise and simulation of frames."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
