"""Gain of a restoration at every spatial frequency, and its noise gain, measured with waves and noise.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.checks.arrays import FramesOrFiles
from rsvib_torch.frames.entry_points import vibration_options
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.imaging.sensor_model import sharpened
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.field import check_two_axes
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.fourier import waves
from rsvib_torch.options import RestorationMtfOptions
from rsvib_torch.restoration.frame_motion import FrameMotion, motion_of_frames
from rsvib_torch.restoration.noise import estimate_noise
from rsvib_torch.restoration.restore import check_optics, restore_prepared
from rsvib_torch.restoration.verdict.trust import vibration_to_undo
from rsvib_torch.results.presentation import AXIS_NAMES, Result
from rsvib_torch.text import text_table

# Waves of neighbouring frequencies are in different probes: uneven sampling mixes them
_GROUPS = 2
_RIM = 16  # px at the borders that are excluded
_LEVEL = 1e-3  # rms of waves and noise, in units of the noise of the frames: nothing that is estimated depends on them


@dataclass(frozen=True, eq=False, repr=False)
class RestorationMtf(
    Result,
    units={"frequency": "cycles/px", "resolution": "cycles/px"},
    shapes={"frequency": "F", "mtf": "2 F", "resolution": "2"},
):
    """Modulation transfer function of a restoration, relative to the scene after optics and pixels.

    Attributes:
        frequency: (F,) cycles per px of the frames, up to 1/2, with ``scale=2`` up to 1.
        mtf: (2, F) contrast of sine waves along x and along y in the restored frames, divided by that in the scene
            after optics and pixels; mean over the frame.
        resolution: (2,) frequency up to which ``mtf`` is at least 0.5.
        noise_gain: Standard deviation of white noise after restoration, divided by that before it.
    """

    frequency: Tensor
    mtf: Tensor
    resolution: Tensor
    noise_gain: float

    def summary(self) -> str:
        """Effective resolution of each axis, and the noise gain."""
        rows = [
            [name, f"{float(limit):.2f}", *(f"{float(gain):.2f}" for gain in self._at(axis))]
            for axis, (name, limit) in enumerate(zip(AXIS_NAMES, self.resolution, strict=False))
        ]
        head = ["axis", "resolution (cycles/px)", *(f"MTF at {level}" for level in (0.25, 0.5, 0.75))]
        return "\n".join([text_table(head[: len(rows[0])], rows), f"noise gain {self.noise_gain:.3f}"])

    def _at(self, axis: int) -> list[Tensor]:
        levels = [level for level in (0.25, 0.5, 0.75) if level <= float(self.frequency[-1]) + 0.02]
        return [self.mtf[axis, int((self.frequency - level).abs().argmin())] for level in levels]


def _waves_at_rest(frequency: Tensor, places: Tensor) -> Tensor:
    """Waves (N, F) at places (N,) in px, complex; phases that grow with the square avoid a peak of their sums."""
    number = torch.arange(len(frequency), dtype=torch.float64, device=places.device)
    phases = waves(number.square() / len(frequency), number.new_tensor([0.5]))[:, 0]
    return (2 / len(frequency)) ** 0.5 * waves(places, -frequency) * phases


def _probes(motion: FrameMotion, frequency: Tensor, size: tuple[int, int]) -> Tensor:
    """Frames (T, 2 G, H, W) of waves along the rows and across them, sums of every G-th frequency, float64."""
    places = [torch.arange(side, dtype=torch.float64, device=frequency.device) for side in size]
    displacement, weights = exposure_trajectory(
        motion.vibration, motion.row_starts(places[0])[None], motion.timing, "gauss"
    )
    along, across = (
        torch.einsum("n,thnf->thf", weights.to(torch.complex128), waves(displacement[0, ..., axis], frequency))
        for axis in (0, 1)
    )
    probes = []
    for group in range(_GROUPS):
        chosen = slice(group, None, _GROUPS)
        at_rows, at_columns = (_waves_at_rest(frequency, place)[:, chosen] for place in places)
        columns = (along[..., chosen] @ at_columns.T).real
        rows = (across[..., chosen] * at_rows).sum(-1).real
        probes += [columns, rows[..., None].expand_as(columns)]
    return torch.stack(probes, dim=1)


def _gains(images: Tensor, frequency: Tensor, points: int) -> Tensor:
    """Mean gain (2, F) of the waves in restored probes (T, 2 G, points H, points W)."""
    gains = frequency.new_zeros(2, len(frequency))
    for number, image in enumerate(images.to(torch.float64).unbind(1)):
        axis, chosen = number % 2, slice(number // 2, None, _GROUPS)
        line = (image if axis == 0 else image.transpose(-2, -1))[..., _inner(image, points), :].mean(-2)
        inside = _inner(line[..., None], points)
        places = torch.arange(line.shape[-1], dtype=torch.float64, device=line.device)[inside] / points
        taper = torch.hann_window(len(places) + 2, periodic=False, dtype=torch.float64, device=line.device)[1:-1]
        found, true = (
            (values[..., None] * taper[:, None] * waves(places, frequency[chosen])).sum(-2).abs()
            for values in (line[..., inside], _waves_at_rest(frequency, places)[:, chosen].sum(-1).real)
        )
        gains[axis, chosen] = (found / true).mean(0)
    return gains


def _inner(image: Tensor, points: int) -> slice:
    """Rows without the borders."""
    rim = min(_RIM * points, image.shape[-2] // 8)
    return slice(rim, image.shape[-2] - rim)


@vibration_options(RestorationMtfOptions)
def restoration_mtf(
    frames: FramesOrFiles, timing: SensorTiming, vibration: Motion | DetectedVibration, options: RestorationMtfOptions
) -> RestorationMtf:
    """MTF and noise gain of ``restore`` with method ``"exact"`` for these frames.

    With a Gaussian prior, the restored scene is a linear function of the frames; the prior and the noise level that are
    estimated from the frames determine it. Frames of sine waves, moved and blurred by the motion, and frames of white
    noise are restored as further channels, too weak to change the estimates. Their contrast and standard deviation
    after restoration are the result. An MTF of 0.5 at a frequency means that half of the contrast of the scene after
    optics and pixels is restored, the rest is below the noise or not sampled.

    Args:
        frames: Stack (T, H, W) or (T, C, H, W), as in ``restore``.
        timing: The sensor.
        vibration: The motion along x and y, or a detection.
        options: Options of ``restore`` with method ``"exact"`` and ``prior="gaussian"``.

    Returns:
        MTF along x and y, effective resolution, and noise gain; means over the frame and over all restored frames.

    Raises:
        ValueError: If the restoration is not linear, for a batch of stacks, for frames of less than 32 px, and for a
            motion with roll or zoom, whose MTF depends on the column.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> scene = city_and_fields(164, 164, seed=3)
        >>> frames = rsv.simulate_frames(scene, timing, vibration, 4, noise=rsv.SensorNoise(read_noise=0.005))
        >>> mtf = rsv.restoration_mtf(frames, timing, vibration, joint=True, scale=2)
        >>> mtf.frequency.max().item() > 0.9, bool((mtf.resolution > 0.4).all()), mtf.noise_gain < 1
        (True, True, True)
    """
    if options.method != "exact" or options.prior != "gaussian":
        raise ValueError("restoration_mtf requires a linear restoration: method='exact' with prior='gaussian'")
    if options.mosaic is not None:
        raise ValueError(
            f"restoration_mtf takes grey or colour frames, got mosaic={options.mosaic!r}, whose colours have different "
            "MTFs; take a plane of one colour"
        )
    prepared = prepare_frames(
        frames,
        timing,
        full_scale=options.full_scale,
        channels=options.channels,
        ignore=options.ignore,
        saturation=options.saturation,
    )
    timing = prepared.image_timing
    _, count, colours, *size = prepared.images.shape
    if prepared.batched or min(size) < 32:
        raise ValueError(f"one stack of frames of at least 32 x 32 px required, got shape {prepared.shape}")
    vibration, _ = vibration_to_undo(vibration, timing, count, size[0])
    check_two_axes(vibration, "the MTF of a restoration")
    motion = motion_of_frames(prepared, vibration)
    points = options.scale
    # neighbours and their aliases 1 - u are at least half a step apart: more than the taper mixes
    cycles = max(4, min(40, min(size) // 5))
    frequency = torch.arange(0.25, cycles * points / 2, dtype=torch.float64, device=prepared.images.device) / cycles
    generator = torch.Generator("cpu").manual_seed(0)
    noise = torch.randn(count, 1, *size, generator=generator, dtype=torch.float64, device="cpu")
    probes = torch.cat([_probes(motion, frequency, (size[0], size[1])), noise.to(frequency.device)], dim=1)
    level = _LEVEL * float(estimate_noise(prepared.filled).square().nanmean().sqrt().clamp(min=1e-4))
    images = torch.cat([prepared.images, level * probes[None].to(prepared.images.dtype)], dim=2)
    if options.noise != "auto":  # estimates are means over all channels
        options = replace(options, noise=options.noise * (colours / images.shape[2]) ** 0.5)
    missing, saturated = (
        None if mask is None else torch.cat([mask, mask.any(2, keepdim=True).expand_as(images[:, :, colours:])], dim=2)
        for mask in (prepared.missing, prepared.saturated)
    )
    probed = replace(prepared, images=images, missing=missing, saturated=saturated)
    restored = restore_prepared(probed, vibration, options)[0, :, colours:]
    restored = sharpened(restored, check_optics(options.optics), options.scale)
    gains = _gains(restored[:, :-1], frequency, points) / level
    if timing.scan_axis == -1:
        gains = gains.flip(0)
    # linear interpolation between the last frequency with 0.5 and the next
    lower = (gains < 0.5).to(torch.int64)
    first = torch.where(lower.any(1), lower.argmax(1), len(frequency) - 1).clamp(min=1)
    after, before = (gains.gather(1, (first - back)[:, None])[:, 0] for back in (0, 1))
    share = ((before - 0.5) / (before - after).clamp(min=1e-9)).clamp(0, 1)
    resolution = torch.lerp(frequency[first - 1], frequency[first], share)
    inside = _inner(restored, points), _inner(restored.transpose(-2, -1), points)
    gain = float(restored[:, -1, *inside].to(torch.float64).square().mean().sqrt() / level)
    return RestorationMtf(frequency, gains, resolution, gain)
