"""The door to restoration: orientation, batches and dtypes resolved once, then one of the methods."""

import inspect
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from rsvib_torch.core.checks import check_choice
from rsvib_torch.core.precision import full_precision, outside_graphs
from rsvib_torch.frames.arrays import ArrayLike, as_tensor
from rsvib_torch.frames.missing import fill_roughly
from rsvib_torch.frames.orientation import (
    as_float_frames,
    frames_from_row_order,
    frames_to_row_order,
    vibration_to_row_order,
)
from rsvib_torch.frames.pixels import Saturation, hidden_pixels, saturated_pixels
from rsvib_torch.motion.spline import moving_axes
from rsvib_torch.motion.timing import SensorTiming, check_timing
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.restoration.banded import restore_banded
from rsvib_torch.restoration.dewarp import restore_dewarp
from rsvib_torch.restoration.exact.exact import restore_exact
from rsvib_torch.restoration.frame_motion import frame_motion
from rsvib_torch.restoration.richardson_lucy import restore_richardson_lucy
from rsvib_torch.restoration.verdict.judge import judge_frames
from rsvib_torch.restoration.verdict.outcome import RestorationWarning, TooLittleInCommonError
from rsvib_torch.restoration.verdict.pairs import pairs_to_judge
from rsvib_torch.restoration.verdict.trust import Detected, vibration_to_undo

__all__ = ["MASKS", "METHODS", "VibrationRestorer", "method_options", "restore"]

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


def _with_added_axes(frames: Tensor) -> Tensor:
    """A stack as (B, T, C, H, W)."""
    frames = frames[None] if frames.ndim < 5 else frames
    return frames[:, :, None] if frames.ndim < 5 else frames


def _without_lost_pixels(
    images: Tensor, hidden: Tensor | None, clipped: Tensor | None, method: str, options: dict[str, Any]
) -> tuple[Tensor, dict[str, Any]]:
    """Hand the masks (B, T, C, H, W) to a method that knows them; fill what is missing for one that does not."""
    known = inspect.signature(METHODS[method]).parameters
    if clipped is not None and "clipped" in known:
        options = {**options, "clipped": clipped}
    if hidden is None:
        return images, options
    if "ignore" in known:
        return images, {**options, "ignore": hidden}
    return fill_roughly(images, hidden), options


def _without_added_axes(restored: Tensor, ndim: int) -> Tensor:
    """Take the batch and channel axes away that a stack of ``ndim`` axes came without."""
    restored = restored if ndim == 5 else restored[0]
    return restored[:, 0] if ndim == 3 else restored


@outside_graphs
@full_precision
def restore(
    frames: ArrayLike,
    timing: SensorTiming,
    vibration: Vibration | Detected,
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
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> round(restore(torch.full((2, 64, 48), 0.5), timing, Vibration(2.0, 50.0)).mean().item(), 5)
        0.5
    """
    check_choice("method", method, tuple(METHODS))
    _check_options(method, options)
    check_timing(timing)
    given = as_tensor("frames", frames)
    hidden = hidden_pixels(given, None if ignore is None else as_tensor("ignore", ignore))
    clipped = saturated_pixels(given, saturation, full_scale)
    for mask, message in ((hidden, "ignore leaves no pixel"), (clipped, "every pixel is saturated")):
        if mask is not None and bool(mask.all()):
            raise ValueError(message)
    images = as_float_frames(given if hidden is None else given.masked_fill(hidden, 0), full_scale)
    dtype = images.dtype
    if dtype not in (torch.float32, torch.float64):
        images = images.to(torch.float32)
    images = frames_to_row_order(_with_added_axes(images), timing)
    hidden, clipped = (
        None if mask is None else frames_to_row_order(_with_added_axes(mask), timing) for mask in (hidden, clipped)
    )
    B, T, _, H, _ = images.shape
    rowwise = timing.in_row_order()
    rowwise.check_rows(H)
    vibration, left_alone = vibration_to_undo(vibration, timing, T, H)
    for note in left_alone:
        warnings.warn(note, RestorationWarning, stacklevel=_CALLER - 1)
    if vibration.batch_shape not in ((), (B,)) or (vibration.batch_shape and given.ndim < 5):
        raise ValueError(
            f"vibration of batch shape {tuple(vibration.batch_shape)} does not fit frames of shape "
            f"{tuple(given.shape)}; one vibration, or one per stack of a (B, T, C, H, W) batch"
        )
    motion = vibration_to_row_order(vibration, timing).to(images.device)
    motion = motion if motion.batch_shape else motion.expanded(B)
    images, chosen = _without_lost_pixels(images, hidden, clipped, method, options)
    restored = METHODS[method](images, frame_motion(motion, rowwise, T, H), **chosen)
    if check:
        raw = images if hidden is None else fill_roughly(images, hidden)
        _warn_if_worse(raw.detach(), restored.detach(), hidden, motion, timing, options.get("joint", False))
    restored = frames_from_row_order(restored, timing)
    return _without_added_axes(restored, given.ndim).to(dtype)


def _warn_if_worse(
    raw: Tensor,
    restored: Tensor,
    hidden: Tensor | None,
    motion: Vibration,
    timing: SensorTiming,
    joint: bool | int,
) -> None:
    """Judge each stack of a batch in row order on a strip of columns of a few pairs of frames."""
    count = raw.shape[1]
    if count < 2:
        return
    pairs = pairs_to_judge(count, joint, _JUDGED_PAIRS)
    shared = count if joint is True else max(int(joint), 1)
    for stack in range(len(raw)):
        still = motion[stack].detached()
        if not bool(moving_axes(still).any()):
            continue
        moved = frame_motion(still.expanded(1), timing.in_row_order(), count, raw.shape[-2])
        try:
            verdict = judge_frames(
                raw[stack],
                restored[stack],
                moved,
                pairs,
                shared=min(shared, count),
                columns=_JUDGED_COLUMNS,
                hidden=None if hidden is None else hidden[stack],
            )
        except TooLittleInCommonError:
            continue  # frames that share no scene cannot be compared
        if verdict.overall in ("partly", "worse"):
            where = f"stack {stack}: " if len(raw) > 1 else ""
            summary = verdict.in_image_axes(timing).summary
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

    def forward(self, frames: Tensor, vibration: Vibration | Detected, ignore: Tensor | None = None) -> Tensor:
        """Restore a stack of frames."""
        return restore(frames, self.timing, vibration, ignore=ignore, **self.options)
