"""Displacements of row bands and of single rows between frames, measured on the images."""

from rsvib_torch.registration.methods import Registration, RegistrationOptions
from rsvib_torch.registration.register import OffsetCurve, register_bands

__all__ = ["OffsetCurve", "Registration", "RegistrationOptions", "register_bands"]
