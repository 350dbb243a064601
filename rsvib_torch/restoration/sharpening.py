"""Restored frames as a sharper camera would take them."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rsvib_torch.core.checks import described
from rsvib_torch.imaging.sensor_model import Optics, filtered

__all__ = ["check_optics", "sharpened", "target_optics"]

_LEAST = 0.1  # response of the camera below which the gain does not increase: 0.02 and 0.2 lose up to 5 and 3 dB


def check_optics(optics: Optics | Mapping[str, Any] | None, method: str) -> Optics | None:
    """Optics from their fields, if that is what was given.

    Raises:
        TypeError: If they are neither ``Optics`` nor their fields.
        ValueError: If they transmit nothing, or the method does not restore frames that can be sharpened.
    """
    if optics is None:
        return None
    if method != "exact":
        raise ValueError(f"optics goes with method='exact', not with method={method!r}")
    if isinstance(optics, Mapping):
        unknown = sorted(optics.keys() - Optics.__dataclass_fields__.keys())
        if unknown:
            fields = ", ".join(Optics.__dataclass_fields__)
            raise TypeError(f"optics has no field {unknown[0]!r}; its fields are {fields}")
        optics = Optics(**optics)
    if not isinstance(optics, Optics):
        raise TypeError(f"optics must be rsv.Optics(...) or a mapping of its fields, got {described(optics)}")
    passed = float(optics.transfer(torch.tensor(0.1, dtype=torch.float64), torch.zeros((), dtype=torch.float64)))
    if passed < 0.01:
        raise ValueError(
            f"optics transmit {passed:.2g} at 0.1 cycles per px, at least 0.01 is needed: there is no detail that can "
            "be sharpened; check the unit of sigma (px) and of frequencies (cycles per px)"
        )
    return optics


def target_optics(scale: int) -> Optics:
    """Optics of which ``sharpened`` images have the response: pixels of the grid behind a Gaussian of half a pixel.

    The MTF at the Nyquist frequency of the grid is 0.19.
    """
    return Optics(sigma=0.5 / scale, pixel=1.0 / scale)


def sharpened(images: Tensor, optics: Optics, scale: int) -> Tensor:
    """Restored frames (..., S H, S W) with the response of ``target_optics`` instead of that of a camera.

    The restored frames are the posterior mean of the scene after the optics of the camera. The posterior mean of what
    follows from it by a linear filter is the filtered posterior mean, so that the prior limits the gain of noise: the
    filter is ``max(1, H_target / max(H_camera, 0.1))``. Frequencies that the camera transmits better are not changed.

    Args:
        images: Restored frames.
        optics: Optics of the camera, pixel included.
        scale: S, points per px.
    """

    def gain(u: Tensor, v: Tensor) -> Tensor:
        response = optics.transfer(scale * u, scale * v).clamp(min=_LEAST)
        return (target_optics(scale).transfer(scale * u, scale * v) / response).clamp(min=1.0)

    return filtered(images, gain)
