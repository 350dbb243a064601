"""Restoration of frames: input preparation, one of the methods, and a check of the result."""

import math

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import ArrayLike, FramesOrFiles
from rsvib_torch.execution.parallel import full_precision, outside_graphs, threads_for
from rsvib_torch.frames.entry_points import TimedModule, module_options, vibration_options
from rsvib_torch.frames.pixels import are_mosaics, enlarged, interpolated_colours
from rsvib_torch.frames.prepare import PreparedFrames, prepare_frames, text_of_lost_rows
from rsvib_torch.imaging.sensor_model import Optics, sharpened
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import OpticsOptions, RestorationOptions, RestoreOptions, RestorerOptions
from rsvib_torch.restoration.exact import restore_exact
from rsvib_torch.restoration.frame_motion import (
    FrameMotion,
    Method,
    MovingFrames,
    motion_of_frames,
    restore_in_strips,
    vibration_to_undo,
    warn_of_restoration,
)
from rsvib_torch.restoration.judge import TooLittleInCommonError, judge_stacks
from rsvib_torch.restoration.row_methods import restore_banded, restore_dewarp, restore_richardson_lucy

# Restoration methods. A method is called as
#
#     function(frames: MovingFrames, options) -> Tensor
#
#     frames: B stacks, whose displacement depends on the row only: frames with roll or zoom are cut into strips of
#         columns, which are stacks of one batch. A method need not use the masks: pixels without data then count as
#         measured with their local means, saturated ones with their values. Only methods whose group has the option
#         ``mosaic`` receive ``colours``, and those with ``optics`` must estimate the scene after the optics.
#     options: the group of its options, in ``METHOD_OPTIONS`` of options.py.
#     returns: frames at rest, of the same shape and dtype, in the coordinates of ``motion.shift``; (B, 1, C, H, W) for
#         option ``joint=True``, and (..., S H, S W) for option ``scale=S``, with point (S i, S j) at pixel (i, j).
#
# Frames of one stack must not affect other stacks, but for the length to which rows are extended; ``frames`` must not
# be changed, and gradients must flow to frames and motion. Recipe of a new method: docs/architecture.md.
METHODS: dict[str, Method] = {
    "exact": restore_exact,
    "banded": restore_banded,
    "dewarp": restore_dewarp,
    "richardson-lucy": restore_richardson_lucy,
}
WITH_SATURATION = ("exact",)  # methods that use ``clipped``


def check_optics(optics: OpticsOptions | None) -> Optics | None:
    """The optics that an option states; refuse some that transmit nothing."""
    if optics is None:
        return None
    camera = optics if isinstance(optics, Optics) else Optics(**vars(optics))
    passed = float(camera.transfer(torch.tensor(0.1, dtype=torch.float64), torch.zeros((), dtype=torch.float64)))
    if passed < 0.01:
        raise ValueError(
            f"optics transmit {passed:.2g} at 0.1 cycles per px, at least 0.01 is needed: there is no detail that can "
            "be sharpened; check the unit of sigma (px) and of frequencies (cycles per px)"
        )
    return camera


@vibration_options(RestoreOptions)
@full_precision
def restore(
    frames: FramesOrFiles, timing: SensorTiming, vibration: Motion | DetectedVibration, options: RestoreOptions
) -> Tensor:
    """Restore frames taken by a vibrating rolling-shutter camera: geometry and sharpness.

    A restored frame contains the scene at rest. With a uniform image motion, the scene is moved by that motion at the
    middle of the frame, in whole pixels. ``visible_pixels`` returns both the shift and the mask of exposed pixels.
    Others, a rim as wide as the displacement, are extrapolated by method ``"exact"``: rows by its prior, columns by the
    smooth extension of the rows to a period. The other methods mirror rows at the ends of frames.

    Pixels without data (NaN, or ``ignore``) do not count, and saturated ones only give a lower bound: method
    ``"exact"`` estimates both from all other pixels, and holds the bounds approximately. ``"richardson-lucy"`` excludes
    pixels without data; ``"banded"`` and ``"dewarp"`` replace them by local means. These three methods treat saturated
    pixels as measured.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) in image orientation: a tensor, an array, a list of
            these, or a path or list of paths of files, which are read as by ``read_stack``.
        timing: The sensor.
        vibration: The motion in image axes: one for all, or a batch (B,) for a batch of stacks. Or a
            ``DetectionResult``: axes without a reliable vibration are then not corrected, see ``trusted_vibration``.
            The result of ``detect_motion`` contains the motion as ``.motion``.
        options: Options, see ``RestoreOptions``.

    Returns:
        Restored frames of the same shape and floating-point dtype (float32 with full scale 1 for integer frames); with
        ``joint=True`` the time axis has length 1. With ``scale=2``, point (2 i, 2 j) lies at pixel (i, j).

    Raises:
        TypeError: If an argument has the wrong type or the method does not know an option.
        ValueError: If a value is out of range, frames, timing and vibration do not fit together, or the motion within a
            frame is larger than the frame.

    Warns:
        RestorationWarning: If an axis is not restored, the restored frames are no better than the raw ones, or frames
            of one channel are a colour mosaic and ``mosaic`` is not given. If all axes of a detection are refused, the
            frames are returned unchanged.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields, example_frames
        >>> frames, timing, _ = example_frames()
        >>> restored = rsv.restore(frames, timing, rsv.detect_vibration(frames, timing))
        >>> still = city_and_fields(320, 240, seed=3)[18:-18, 19:-19]  # the scene, cut to the size of the frames
        >>> for name, images in (("taken", frames), ("restored", restored)):
        ...     print(name, rsv.psnr(images, still, 1.0, rim=16).round(decimals=0).tolist(), "dB")
        taken [23.0, 24.0] dB
        restored [62.0, 63.0] dB
    """
    camera = check_optics(options.optics)
    prepared = prepare_frames(
        frames,
        timing,
        full_scale=options.full_scale,
        channels=options.channels,
        ignore=options.ignore,
        saturation=options.saturation,
        mosaic=options.mosaic,
    )
    warn_of_mosaic(prepared)
    if lost := prepared.lost_rows():
        warn_of_restoration(text_of_lost_rows(lost))
    timing = prepared.image_timing
    vibration, left_alone = vibration_to_undo(vibration, timing)
    for reason in left_alone:
        warn_of_restoration(str(reason))
    if left_alone and not bool(vibration.moving_axes().any()):
        return prepared.from_row_order(as_taken(prepared, options.joint, options.scale))
    motion = motion_of_frames(prepared, vibration)
    restored = _restored(MovingFrames.of(prepared, motion), options)
    if options.check:  # before frames are sharpened: the verdict compares them with raw frames, blurred by the optics
        with threads_for(prepared.images):
            _warn_if_worse(prepared, restored, motion, options.joint)
    restored = sharpened(restored, camera, options.scale)
    if left_alone and not bool((moves := vibration.moving_axes().any(-1)).all()):  # as such a stack alone
        unchanged = as_taken(prepared, options.joint, options.scale)
        restored = torch.where(moves[:, None, None, None, None], restored, unchanged)
    return prepared.from_row_order(restored)


@outside_graphs
@full_precision
def restore_prepared(frames: PreparedFrames, vibration: Motion, options: RestorationOptions) -> Tensor:
    """``restore`` of prepared frames by a motion in image axes, (B, T, C, H, W) in row order, without any checks."""
    return _restored(MovingFrames.of(frames, motion_of_frames(frames, vibration)), options)


def _restored(frames: MovingFrames, options: RestorationOptions) -> Tensor:
    """Restored frames (B, T, C, H, W) by the method of the options."""
    with threads_for(frames.images):
        return restore_in_strips(METHODS[options.method], frames, options)


def as_taken(frames: PreparedFrames, joint: bool | int, scale: int = 1) -> Tensor:
    """The frames as taken, in row order: NaN at missing pixels; with ``joint=True`` the middle one.

    On a finer grid, values between the pixels are interpolated.
    """
    images = frames.images.clone() if frames.colours is None else interpolated_colours(frames.filled, frames.colours)
    if frames.missing is not None:
        images = images.masked_fill(frames.missing, math.nan)
    middle = images.shape[1] // 2
    return enlarged(images[:, middle : middle + 1] if joint is True else images, scale)


def warn_of_mosaic(frames: PreparedFrames) -> None:
    """Warn if frames that are restored as grey ones are mosaics of colours, by the first frame."""
    if frames.colours is None and frames.images.shape[2] == 1 and bool(are_mosaics(frames.filled[:1, 0, 0])[0]):
        warn_of_restoration(
            "frames are raw frames of a colour sensor, whose colours are mixed if they are restored as grey frames: "
            'state the pattern, e.g. mosaic="RGGB" (--mosaic RGGB)'
        )


def _warn_if_worse(frames: PreparedFrames, restored: Tensor, motion: FrameMotion, joint: bool | int) -> None:
    """Judge the stacks that move on 160 columns of two pairs of frames."""
    if frames.images.shape[1] < 2:
        return
    moving = [stack for stack, bounds in enumerate(motion.bounds) if any(bounds)]
    judged = judge_stacks(frames, restored, motion, moving, joint=joint, most_pairs=2, columns=160)
    for stack, verdict in zip(moving, judged, strict=True):
        # frames that share no scene cannot be compared
        if not isinstance(verdict, TooLittleInCommonError) and verdict.overall in ("partly", "worse"):
            where = f"stack {stack}: " if len(restored) > 1 else ""
            warn_of_restoration(f"{where}{verdict.sentence}")


class VibrationRestorer(TimedModule):
    """``restore`` as a module, for stacks (T, H, W) to batches of stacks (B, T, C, H, W).

    The options are those of ``restore``. It has no weights, ignores autocast, and is called by ``torch.compile``
    unchanged, at one break of the graph. Gradients flow to frames and vibration.

    Args:
        timing: The sensor.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, vibration = example_frames()
        >>> restorer = rsv.VibrationRestorer(timing, method="dewarp", check=False)
        >>> batch = frames[None, :, None].requires_grad_()  # (B, T, C, H, W)
        >>> torch.nn.Conv2d(1, 4, 3)(restorer(batch, vibration).flatten(0, 1)).square().mean().backward()
        >>> batch.grad.shape
        torch.Size([1, 2, 1, 284, 202])
    """

    @module_options(RestorerOptions)
    def __init__(self, timing: SensorTiming, options: RestorerOptions) -> None:
        super().__init__(timing, options)
        check_optics(options.optics)

    def forward(
        self, frames: FramesOrFiles, vibration: Motion | DetectedVibration, ignore: ArrayLike | None = None
    ) -> Tensor:
        """Restore a stack of frames."""
        return restore(frames, self.timing, vibration, ignore=ignore, **vars(self.options))
