"""``align_motion``: alignment of the angular rates of a gyroscope with the clock of the frames."""

from collections.abc import Callable
from typing import ParamSpec, Protocol

import torch

from rsvib_torch.checks.arguments import FramesOrFiles
from rsvib_torch.execution.parallel import full_precision, without_gradients
from rsvib_torch.frames.entry_points import entry_point
from rsvib_torch.frames.prepare import frames_from_row_order, grey_frames
from rsvib_torch.gyroscope.corner_tracks import corner_tracks
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates
from rsvib_torch.gyroscope.rotation_alignment import AlignOptions, RotationAlignment, align_rates
from rsvib_torch.motion.timing import SensorTiming

P = ParamSpec("P")


class _AlignsMotion(Protocol[P]):
    """Type of ``align_motion``."""

    def __call__(
        self, frames: FramesOrFiles, timing: SensorTiming, recorded: AngularRates, *args: P.args, **kwargs: P.kwargs
    ) -> RotationAlignment:
        """Call the function."""


def _align_options(
    options: Callable[P, AlignOptions],
) -> Callable[[Callable[..., RotationAlignment]], _AlignsMotion[P]]:
    return lambda function: entry_point(options, function)


@_align_options(AlignOptions)
@full_precision
@without_gradients
def align_motion(
    frames: FramesOrFiles, timing: SensorTiming, recorded: AngularRates, options: AlignOptions
) -> RotationAlignment:
    """Find offset and scale between the clock of a gyroscope and that of the frames, and the axes of the gyroscope.

    Corners are followed between consecutive frames, and compared with the rotation of the camera between the exposures
    of their rows, for all 24 assignments of the axes and all offsets. Bias, clock and, without a camera, the focal
    length are fitted. Robust weights exclude what moves by itself or is fixed to the camera. Every pair of frames has a
    translation of its own: if the scene has parallax, only displacements across its lines (epipolar lines) determine
    the rotation.

    Args:
        frames: Stack (T, H, W) or (T, C, H, W) of at least two frames; tensor, array, list of these, or files; NaN
            marks missing pixels.
        timing: The sensor.
        recorded: The rates of the gyroscope on its own clock.
        options: Options.

    Returns:
        The motion on the clock of the frames, offset and scale with standard deviations, and a verdict.

    Raises:
        TypeError: If frames are not numbers, or the recording is no angular rates.
        ValueError: If the recording is shorter than the frames or does not cover them at any offset in ``offsets``,
            frames have too few corners, or an option is out of range.

    Example:
        See ``RotationAlignment``.
    """
    if not isinstance(recorded, AngularRates):
        raise TypeError(
            f"recorded must be AngularRates (read_gyroscope), got {type(recorded).__name__}; the clock of a motion in "
            "px is set by FreeMotion.retimed"
        )
    stack = grey_frames(frames, timing, options)
    timing = stack.timing
    if stack.batched:
        raise ValueError(f"align_motion takes one stack, got a batch of {len(stack.images)}")
    images = frames_from_row_order(stack.images[0], timing)
    masks = [None] * len(images) if stack.valid is None else frames_from_row_order(stack.valid[0], timing)
    starts = timing.in_row_order().frame_starts(len(images)).tolist()
    tracks = corner_tracks(zip(range(len(images)), images, masks, strict=True), starts, timing)
    with torch.device("cpu"):  # also where another device is the default of PyTorch
        return align_rates(tracks, timing, recorded, options)
