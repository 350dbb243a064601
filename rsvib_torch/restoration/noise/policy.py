"""Noise level of every frame of a stack, from the estimators that apply to it."""

from collections.abc import Callable

import torch
from torch import Tensor

from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.noise.frame_pair import noise_of_frame_pair
from rsvib_torch.restoration.noise.high_pass import estimate_noise
from rsvib_torch.restoration.noise.motion_blur import noise_of_blurred_frames
from rsvib_torch.restoration.noise.spectral_floor import noise_of_spectral_floor

__all__ = ["ESTIMATORS", "noise_levels"]

# Estimators that separate noise from texture, in order of preference. An estimator is called as
#
#     estimator(frames, motion, stack, ignore, high_pass) -> Tensor
#
#     frames: (T, C, H, W) floating point in row order; ignored pixels hold local means.
#     motion: FrameMotion of the batch; ``stack`` is the index of these frames in it.
#     ignore: (T, C, H, W) bool, pixels that were not measured; None for none.
#     high_pass: (T,) noise power of ``estimate_noise``, texture included; NaN for a frame without content.
#     returns: (T,) noise power (variance per pixel in squared units of the frames); NaN for a frame that it cannot
#         estimate, for all frames if the estimator does not apply to the recording.
#
# It must not change its arguments, and must not raise for small, constant or masked frames.
Estimator = Callable[[Tensor, FrameMotion, int, Tensor | None, Tensor], Tensor]
ESTIMATORS: dict[str, Estimator] = {
    "motion blur": noise_of_blurred_frames,
    "frame pair": noise_of_frame_pair,
    "spectral floor": noise_of_spectral_floor,
}


def noise_levels(frames: Tensor, motion: FrameMotion, stack: int, ignore: Tensor | None = None) -> Tensor:
    """Standard deviation of the noise of each frame of a stack.

    ``estimate_noise`` counts fine texture as noise, which makes it an upper bound. The first estimator of
    ``ESTIMATORS`` that applies to the recording lowers it. A frame without content, or with too few measured pixels,
    is assigned the median noise power of the others.

    Args:
        frames: (T, C, H, W) in row order; ignored pixels hold local means.
        motion: Motion of the batch of stacks.
        stack: Index of the stack in the batch.
        ignore: Boolean mask shaped like the frames of pixels that were not measured.

    Returns:
        (T,), in the dtype and unit of the frames; 0 if no frame has content.
    """
    power = estimate_noise(frames, ignore).square().nanmean(-1).masked_fill(_constant(frames), torch.nan)
    for estimator in ESTIMATORS.values():
        estimated = estimator(frames, motion, stack, ignore, power)
        if not bool(estimated.isnan().all()):
            power = torch.minimum(power, estimated.to(power.dtype).nan_to_num(nan=torch.inf))
            break
    return torch.where(power.isnan(), power.nanmedian(), power).nan_to_num(nan=0.0).sqrt()


def _constant(frames: Tensor, row_step: int = 8, tolerance: float = 1e-6) -> Tensor:
    """Frames (T,) whose values, in every eighth row, are equal to within rounding: they hold not even noise."""
    low, high = frames[..., ::row_step, :].flatten(1).aminmax(dim=-1)
    return high - low <= tolerance * torch.maximum(-low, high)
