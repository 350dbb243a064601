"""Restoration of frames: input preparation, one of the methods, and a check of the result."""

import inspect
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor, nn

from rsvib_torch.core.checks import check_choice
from rsvib_torch.core.precision import full_precision, outside_graphs
from rsvib_torch.frames.arrays import ArrayLike
from rsvib_torch.frames.prepare import PreparedFrames, Saturation, prepare_frames
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.restoration.banded import restore_banded
from rsvib_torch.restoration.dewarp import restore_dewarp
from rsvib_torch.restoration.exact.exact import restore_exact
from rsvib_torch.restoration.frame_motion import frame_motion
from rsvib_torch.restoration.richardson_lucy import restore_richardson_lucy
from rsvib_torch.restoration.verdict.judge import judge_frames
from rsvib_torch.restoration.verdict.outcome import RestorationWarning, TooLittleInCommonError
from rsvib_torch.restoration.verdict.pairs import pairs_to_judge
from rsvib_torch.restoration.verdict.trust import Detected, vibration_to_undo

__all__ = ["MASKS", "METHODS", "VibrationRestorer", "method_options", "restore", "restore_prepared"]

MASKS = ("ignore", "clipped")  # what a method is told of pixels; no options of the user's
_CALLER = 5  # levels up from where a warning is given: helper, restore and its two decorators
_JUDGED_PAIRS, _JUDGED_COLUMNS = 2, 160  # of every stack

METHODS: dict[str, Callable[..., Tensor]] = {
    "exact": restore_exact,
    "banded": restore_banded,
    "dewarp": restore_dewarp,
    "richardson-lucy": restore_richardson_lucy,
}


def method_options(method: str) -> tuple[str, ...]:
    """Options of a restoration method.

    Raises:
        ValueError: If there is no such method.

    Example:
        >>> method_options("dewarp")
        ('chunk_rows',)
    """
    check_choice("method", method, tuple(METHODS))
    parameters = inspect.signature(METHODS[method]).parameters.values()
    return tuple(p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in MASKS)


def _check_options(method: str, options: dict[str, Any]) -> None:
    known = method_options(method)
    for name in options:
        if name not in known:
            raise TypeError(f"method={method!r} has no option {name!r}; its options are {', '.join(known)}")


def _method_input(frames: PreparedFrames, method: str, options: dict[str, Any]) -> tuple[Tensor, dict[str, Any]]:
    """Images and options for a method: masks if it takes them, otherwise images with missing pixels filled."""
    parameters = inspect.signature(METHODS[method]).parameters
    if frames.saturated is not None and "clipped" in parameters:
        options = {**options, "clipped": frames.saturated}
    if frames.missing is not None and "ignore" in parameters:
        return frames.images, {**options, "ignore": frames.missing}
    return frames.filled, options


@outside_graphs
@full_precision
def restore(
    frames: ArrayLike,
    timing: SensorTiming,
    vibration: Motion | Detected,
    *,
    method: str = "exact",
    full_scale: float | None = None,
    ignore: Tensor | None = None,
    saturation: Saturation = "auto",
    check: bool = True,
    **options: Any,
) -> Tensor:
    """Restore frames taken by a vibrating rolling-shutter camera: geometry and sharpness.

    A restored frame shows the scene at rest. With a uniform image motion it shows the scene moved by the whole pixels
    of that motion at the middle of the frame (``visible_pixels`` tells them); what a frame never exposed, a rim as
    wide as the displacement, is continued by mirroring (``visible_pixels`` tells which pixels those are).

    Pixels without data (NaN, or ``ignore``) do not count, and saturated ones say only that they are no darker than
    their level. Method ``"exact"`` finds what they would have shown from all others, jointly from all frames where it
    is told to; ``"banded"`` and ``"dewarp"`` put local means in place of pixels without data, and take saturated
    pixels at their level.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) in image orientation; tensor or NumPy array.
        timing: The sensor.
        vibration: The motion in image axes: one for all, or a batch (B,) for a batch of stacks. Or what
            ``detect_vibration`` returned: axes that it does not trust are then left alone, see ``trusted_vibration``.
        method: ``"exact"``: all rows coupled, several frames jointly on demand; ``"banded"``: row by row within
            slabs (Sec. 3.2 of Liu et al. 2023); ``"dewarp"``: geometry only, fastest; ``"richardson-lucy"``: iterated,
            nowhere negative, several frames jointly on demand.
        full_scale: Count that means 1.0, for integer frames other than uint8.
        ignore: Boolean mask shaped like the frames of pixels that do not count; they may hold anything. Stuck columns,
            and a rim that never sees light, are to be named here: they show no noise, and do not move with the scene.
        saturation: Level from which pixels are saturated, in the unit of the frames; ``"auto"``: full scale for
            integer frames, none for floats, which do not say where they were cut; None for none.
        check: Judge the result on a part of the frames, and warn where it is no better than what came in; needs two
            frames. ``judge_restoration`` does it on all of them.
        **options: Options of the method, see ``restore_exact``, ``restore_banded``, ``restore_dewarp`` and
            ``restore_richardson_lucy``.

    Returns:
        Restored frames of the same shape and floating dtype (float32 where integers went in, full scale 1); with
        ``joint=True`` the time axis has length 1.

    Raises:
        TypeError: If an argument has the wrong type or the method does not know an option.
        ValueError: If a value is out of range, or frames, timing and vibration do not fit together.

    Warns:
        RestorationWarning: If an axis is left alone, or the restored frames are no better than the raw ones.

    Example:
        >>> import torch
        >>> from rsvib_torch import Vibration
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> round(restore(torch.full((2, 64, 48), 0.5), timing, Vibration(2.0, 50.0)).mean().item(), 5)
        0.5
    """
    check_choice("method", method, tuple(METHODS))
    _check_options(method, options)
    prepared = prepare_frames(frames, timing, full_scale=full_scale, ignore=ignore, saturation=saturation)
    _, count, _, height, _ = prepared.images.shape
    vibration, left_alone = vibration_to_undo(vibration, timing, count, height)
    for note in left_alone:
        warnings.warn(note, RestorationWarning, stacklevel=_CALLER - 1)
    restored = restore_prepared(prepared, vibration, method, options)
    if check:
        _warn_if_worse(prepared, restored.detach(), vibration, options.get("joint", False))
    return prepared.from_row_order(restored)


@outside_graphs
@full_precision
def restore_prepared(
    frames: PreparedFrames, vibration: Motion, method: str = "exact", options: Mapping[str, Any] | None = None
) -> Tensor:
    """``restore`` of frames that are already prepared, without a check of the result.

    Args:
        frames: The frames.
        vibration: The motion in image axes, batch shape () or (B,).
        method: As in ``restore``.
        options: Options of the method.

    Returns:
        Restored frames (B, T, C, H, W) in row order.
    """
    options = dict(options or {})
    check_choice("method", method, tuple(METHODS))
    _check_options(method, options)
    images, chosen = _method_input(frames, method, options)
    motion = _motion_in_row_order(frames, vibration)
    return METHODS[method](images, frame_motion(motion, frames.timing, images.shape[1], images.shape[-2]), **chosen)


def _motion_in_row_order(frames: PreparedFrames, vibration: Motion) -> Motion:
    """The vibration in row order on the frames' device, batch shape (B,).

    Raises:
        ValueError: If there is neither one vibration nor one for each stack of a batch.
    """
    batch = frames.images.shape[0]
    if vibration.batch_shape not in ((), (batch,)) or (vibration.batch_shape and not frames.batched):
        raise ValueError(
            f"vibration of batch shape {tuple(vibration.batch_shape)} does not fit frames of shape {frames.shape}; "
            "one vibration, or one per stack of a (B, T, C, H, W) batch"
        )
    motion = vibration.to_row_order(frames.image_timing).to(frames.images.device)
    return motion if motion.batch_shape else motion.expanded(batch)


def _warn_if_worse(frames: PreparedFrames, restored: Tensor, vibration: Motion, joint: bool | int) -> None:
    """Judge each stack of a batch on a strip of columns of a few pairs of frames."""
    raw = frames.filled.detach()
    count = raw.shape[1]
    if count < 2:
        return
    motion = _motion_in_row_order(frames, vibration)
    pairs = pairs_to_judge(count, joint, _JUDGED_PAIRS)
    shared = count if joint is True else max(int(joint), 1)
    for stack in range(len(raw)):
        still = motion[stack].detached()
        if not bool(still.moving_axes().any()):
            continue
        try:
            verdict = judge_frames(
                raw[stack],
                restored[stack],
                frame_motion(still.expanded(1), frames.timing, count, raw.shape[-2]),
                pairs,
                shared=min(shared, count),
                columns=_JUDGED_COLUMNS,
                hidden=None if frames.missing is None else frames.missing[stack],
            )
        except TooLittleInCommonError:
            continue  # frames that share no scene cannot be compared
        if verdict.overall in ("partly", "worse"):
            where = f"stack {stack}: " if len(raw) > 1 else ""
            summary = verdict.in_image_axes(frames.image_timing).summary
            warnings.warn(f"{where}{summary}", RestorationWarning, stacklevel=_CALLER)


class VibrationRestorer(nn.Module):
    """``restore`` as a module, for stacks (T, H, W) to batches of stacks (B, T, C, H, W).

    It has no weights. Autocast does not reach it, and ``torch.compile`` calls it as it is, at one break of the graph.
    Gradients flow to frames and vibration.

    Args:
        timing: The sensor.
        method: As in ``restore``.
        full_scale: As in ``restore``.
        saturation: As in ``restore``.
        check: As in ``restore``.
        **options: As in ``restore``.
    """

    def __init__(
        self,
        timing: SensorTiming,
        *,
        method: str = "exact",
        full_scale: float | None = None,
        saturation: Saturation = "auto",
        check: bool = True,
        **options: Any,
    ) -> None:
        super().__init__()
        check_choice("method", method, tuple(METHODS))
        _check_options(method, options)
        self.timing = timing
        self.options = {
            "method": method,
            "full_scale": full_scale,
            "saturation": saturation,
            "check": check,
            **options,
        }

    def forward(self, frames: Tensor, vibration: Motion | Detected, ignore: Tensor | None = None) -> Tensor:
        """Restore a stack of frames."""
        return restore(frames, self.timing, vibration, ignore=ignore, **self.options)
