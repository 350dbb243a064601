"""Measure and remove the vibration of a rolling-shutter camera.

Names are imported when they are used; ``__init__.pyi`` lists them for type checkers and editors.
"""

from importlib import import_module
from pathlib import Path

import lazy_loader

from rsvib_torch.results import IMPORTERS

IMPORTERS["files"] = lambda: import_module("rsvib_torch.io.stack_reading")
IMPORTERS["figures"] = lambda: import_module("rsvib_torch.report.plots")
__getattr__, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = [name for name in _names if not (Path(__file__).parent / name).is_dir()]  # without the packages
__version__ = "0.1.0"
