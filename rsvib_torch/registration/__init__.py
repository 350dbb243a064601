"""Offsets of row bands between frames."""

from rsvib_torch.registration.methods import Registration
from rsvib_torch.registration.offset_curve import OffsetCurve
from rsvib_torch.registration.register import register_bands

__all__ = ["OffsetCurve", "Registration", "register_bands"]
