"""Input preparation: arrays, dtypes, full scale, masks and orientation of stacks of frames."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
