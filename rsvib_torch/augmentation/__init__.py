"""Training data: still images as a vibrating rolling-shutter camera records them."""

from rsvib_torch.augmentation.rolling_shutter import RollingShutterVibration

__all__ = ["RollingShutterVibration"]
