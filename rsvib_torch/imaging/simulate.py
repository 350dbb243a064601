"""Simulation of the frames that a vibrating rolling-shutter camera takes of a still scene (Eq. 9).

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import ArrayLike, as_tensor, channels_appear_last, check_pixels, checks_arguments
from rsvib_torch.checks.values import Count, check_single
from rsvib_torch.files.reading import check_fits
from rsvib_torch.frames.prepare import frames_from_row_order, frames_to_row_order
from rsvib_torch.imaging.blur import form_frames
from rsvib_torch.imaging.sensor_model import SensorNoise
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.motion.camera import largest_in_frame, largest_slope
from rsvib_torch.motion.motion import ColumnMotion, ColumnStrips, Motion
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.numerics.interpolation import bspline_coefficients, extend_rows, fast_length

_DEGREE = 9  # degree of the spline across rows; its error is 2e-5 of the amplitude at a quarter cycle per pixel
# px between the visible part and the edge of the scene; the prefilter of the spline decays to 4e-4 within it
_MARGIN = 16
_SLIDE = 0.032  # px, difference of the displacements of neighbouring strips
_CHUNK_ROWS = 64  # rows of all frames whose kernels are in memory at once


@checks_arguments
def simulate_frames(
    scene: ArrayLike,
    timing: SensorTiming,
    vibration: Motion,
    num_frames: Count = 2,
    *,
    frame_size: tuple[int, int] | None = None,
    noise: SensorNoise | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Simulate the frames that a vibrating rolling-shutter camera takes of a still scene (Eq. 9).

    ``g(x, y) = 1/T_e int f[x - X(t), y - Y(t)] dt`` for every row over its own exposure. Displacement along rows is a
    phase ramp on the row's Fourier transform, across rows a B-spline of degree 9, the integral a Gauss-Legendre sum:
    accurate for any band-limited scene. The scene must be larger than the frame, so that no pixel is extrapolated.

    Args:
        scene: (H, W) or (C, H, W), floating point, full scale 1.
        timing: The sensor.
        vibration: One vibration (not a batch), in image axes.
        num_frames: Number of frames.
        frame_size: (height, width) of the frames, centred on the scene; by default the largest that stays at least
            16 px from the edge of the scene and has no more rows than ``timing.frame_rows``.
        noise: Noise of the sensor, by default none.
        generator: Random number generator of the noise.

    Returns:
        Frames (T, h, w) or (T, C, h, w) in the dtype and on the device of the scene. Frame pixel (r, c) shows, at
        rest, scene pixel ``(r + (H - h) // 2, c + (W - w) // 2)``.

    Raises:
        ValueError: If the scene is too small for the frame and motion, or is not finite, or the frames do not fit into
            the free memory.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> scene = city_and_fields(320, 240, seed=3)
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> rsv.simulate_frames(scene, timing, vibration, num_frames=2).shape  # the rim of the scene is cut off
        torch.Size([2, 284, 202])
    """
    scene = as_tensor("scene", scene)
    if not scene.dtype.is_floating_point:
        raise TypeError(
            f"scene must be a floating-point tensor whose full scale is 1, got {scene.dtype}; divide counts by their "
            "full scale, e.g. scene / 255"
        )
    if scene.ndim not in (2, 3) or not scene.numel():
        raise ValueError(f"scene must be a (H, W) or (C, H, W) tensor, got shape {tuple(scene.shape)}")
    check_pixels("scene", scene)
    if channels_appear_last(scene.shape):
        raise ValueError(
            f"scene of shape {tuple(scene.shape)} appears to have its channels last: pass scene.permute(2, 0, 1)"
        )
    check_single("vibration", vibration.batch_shape)
    height, width = map(min, frame_size or scene.shape[-2:], scene.shape[-2:])
    row_bytes = 400 * min(height, _CHUNK_ROWS) + 12 * height  # per column: spectra of some rows, frames; measured
    if scene.device.type == "cpu":
        check_fits(
            f"num_frames={num_frames} frames of {height} x {width} px",
            num_frames * math.prod(scene.shape[:-2]) * width * row_bytes,
            "simulate fewer frames at a time (timing.frame_start_times)",
        )
    motion = vibration.to_row_order(timing).to(scene.device)
    if timing.scan_axis == -1 and frame_size is not None:
        frame_size = (frame_size[1], frame_size[0])
    scene = frames_to_row_order(scene, timing)
    timing_in_rows = timing.in_row_order()

    frame_starts = timing_in_rows.frame_starts(num_frames)
    end = float(frame_starts[-1]) + timing.frame_period + timing.exposure_time
    reach = largest_in_frame(
        motion.largest_displacement(float(frame_starts[0]), end), scene.shape[-1], scene.shape[-2], motion.camera
    ).tolist()
    margins = tuple(_MARGIN + math.ceil(r) for r in reversed(reach))
    available = tuple(size - 2 * margin for size, margin in zip(scene.shape[-2:], margins, strict=True))
    size = (min(available[0], int(timing.frame_rows)), available[1]) if frame_size is None else frame_size
    if min(size) < 1 or any(requested > free for requested, free in zip(size, available, strict=True)):
        needed = tuple(max(s, 1) + 2 * m for s, m in zip(size, margins, strict=True))
        raise ValueError(
            f"scene of {tuple(scene.shape[-2:])} (rows, columns in read order) is too small: a frame of {tuple(size)} "
            f"with this motion needs at least {needed}"
        )
    timing_in_rows.check_rows(size[0])
    starts = timing_in_rows.row_starts(num_frames, size[0], scene.device)
    dtype = scene.dtype
    scene = scene if dtype == torch.float64 else scene.to(torch.float32)
    frames = _form_frames(scene, starts, timing_in_rows, motion, size[1])
    frames = frames_from_row_order(frames, timing)
    return (frames if noise is None else noise.apply(frames, generator)).to(dtype)


def _form_frames(scene: Tensor, starts: Tensor, timing: RowTiming, motion: Motion, width: int) -> Tensor:
    """``_form_rows``, in strips of columns if the motion has roll or zoom.

    The displacement of neighbouring strips differs by at most ``_SLIDE``, for example 16 px apart with a roll of 2
    mrad; the linear interpolation between them has errors of up to 2e-4 of full scale (rms).
    """
    if motion.same_for_all_columns:
        return _form_rows(scene, starts, timing, motion, width)
    reached = motion.largest_displacement(float(starts.amin()), float(starts.amax()) + timing.exposure_time)
    slope = float(largest_slope(reached, width, starts.shape[-1], motion.camera))
    strips = ColumnStrips.of(width, max_pitch=min(max(_SLIDE / max(slope, 1e-9), 4.0), 16.0), margin=0)
    beyond = 2 * ((scene.shape[-1] - width) // 2)  # columns of the scene beside the frame
    motions = ColumnMotion.of_columns(motion.expanded(1), strips.columns, timing, *starts.shape)
    formed = [
        _form_rows(scene[..., first : first + strips.width + beyond], starts, timing, motions[number], strips.width)
        for number, first in enumerate(strips.firsts)
    ]
    return strips.joined(torch.stack(formed))[0]


def _form_rows(scene: Tensor, starts: Tensor, timing: RowTiming, motion: Motion, width: int) -> Tensor:
    """Form frames (T, ..., R, width) whose rows are exposed from ``starts`` (T, R) on, centred on the scene."""
    height, scene_width = scene.shape[-2:]
    num_rows = starts.shape[-1]
    top, left = (height - num_rows) // 2, (scene_width - width) // 2
    length = fast_length(scene_width + 2 * _MARGIN)
    spectra = torch.fft.rfft(extend_rows(bspline_coefficients(scene, _DEGREE, -2), length, hold=0.0))[..., None, :, :]
    formed, columns = [], slice(left, left + width)
    for rows in torch.arange(num_rows, device=scene.device).split(_CHUNK_ROWS):
        displacement, node_weights = exposure_trajectory(motion, starts[:, rows], timing, "gauss")
        along, across = displacement.unbind(-1)
        place = top + rows[:, None] - across
        formed.append(form_frames(spectra, place, along, node_weights, _DEGREE, length, columns))
    return torch.cat(formed, dim=-2).movedim(-3, 0).contiguous()  # frames before channels
