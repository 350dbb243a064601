from .register import OffsetCurve, register_bands

__all__ = ["OffsetCurve", "register_bands"]
