"""Noise gain of a restoration, measured with a noise probe."""

import torch
from torch import Tensor

from rsvib_torch.frames.entry_points import vibration_options
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.io.stack_reading import FramesOrFiles
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import NoiseGainOptions
from rsvib_torch.restoration.noise import estimate_noise
from rsvib_torch.restoration.restore import restore_prepared
from rsvib_torch.restoration.verdict.trust import vibration_to_undo


@vibration_options(NoiseGainOptions)
def predict_noise_gain(
    frames: FramesOrFiles, timing: SensorTiming, vibration: Motion | DetectedVibration, options: NoiseGainOptions
) -> Tensor:
    """Ratio of the standard deviation of noise after restoration to that before it.

    Restoration is nearly linear in the frames. White noise of half the standard deviation of the noise in the frames is
    added to a strip of them, and the change of the result is measured. A gain below 1 means smoothing; a gain above 1
    is the cost of deblurring.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W).
        timing: The sensor.
        vibration: The motion, or a detection, as in ``restore``.
        options: Options of ``restore``, and the width of the strip.

    Returns:
        Scalar, float64.

    Example:
        >>> from rsvib_torch import Vibration
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> frames = torch.rand(1, 96, 96, generator=torch.Generator().manual_seed(0))
        >>> round(predict_noise_gain(frames, timing, Vibration.still(), method="dewarp").item(), 1)
        1.0
    """
    rim = 16  # px at the borders that are excluded
    count = options.columns
    prepared = prepare_frames(
        frames, timing, full_scale=options.full_scale, channels=options.channels, allow_missing=False
    )
    first = max(0, (prepared.images.shape[-1] - count) // 2)
    strip = prepared.images[..., first : first + count].to(torch.float64)
    vibration, _ = vibration_to_undo(vibration, timing, strip.shape[1], strip.shape[-2])
    level = 0.5 * estimate_noise(strip).square().mean().sqrt().clamp(min=1e-4)  # well above rounding
    generator = torch.Generator(strip.device).manual_seed(0)
    probe = level * torch.randn(strip.shape, generator=generator, dtype=strip.dtype, device=strip.device)
    plain, probed = (
        restore_prepared(prepared.with_images(images), vibration, options)[..., rim:-rim, rim:-rim]
        for images in (strip, strip + probe)
    )
    return (probed - plain).square().mean().sqrt() / probe.square().mean().sqrt()
