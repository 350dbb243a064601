from .methods import Registration, RegistrationOptions
from .register import OffsetCurve, register_bands

__all__ = ["OffsetCurve", "Registration", "RegistrationOptions", "register_bands"]
