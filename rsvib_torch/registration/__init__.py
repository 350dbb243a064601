"""Offsets of row bands between frames."""

from rsvib_torch.registration.methods import Registration, RegistrationOptions
from rsvib_torch.registration.offset_curve import OffsetCurve
from rsvib_torch.registration.register import register_bands

__all__ = ["OffsetCurve", "Registration", "RegistrationOptions", "register_bands"]
