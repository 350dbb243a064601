from .rolling_shutter import RollingShutterVibration

__all__ = ["RollingShutterVibration"]
