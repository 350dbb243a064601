"""Drawn still scenes, and example frames made from them: a resolution chart, and a landscape from above."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
