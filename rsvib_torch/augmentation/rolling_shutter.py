"""Kornia augmentation: still images as a vibrating rolling-shutter camera records them.

Invariant: the displacement depends on the row only (docs/architecture.md), with roll and zoom in strips of columns.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

import torch
from kornia.augmentation import GeometricAugmentationBase2D
from kornia.geometry.boxes import Boxes
from kornia.geometry.keypoints import Keypoints
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arguments import channels_appear_last, check_tensor, checks_arguments
from rsvib_torch.checks.values import check_choice, check_number, check_whole_number, described
from rsvib_torch.execution.parallel import full_precision
from rsvib_torch.files.reading import Table
from rsvib_torch.frames.prepare import frames_from_row_order, frames_to_row_order
from rsvib_torch.imaging import blur_rows, gauss_node_count, trajectory_psf
from rsvib_torch.imaging.blur import Interpolation
from rsvib_torch.motion.camera import displacement_at, largest_in_frame
from rsvib_torch.motion.motion import ColumnMotion, ColumnStrips, Motion
from rsvib_torch.motion.timing import RowTiming, SensorTiming, check_timing
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.interpolation import gauss_legendre, mirrored
from rsvib_torch.text import quoted

Range = float | Sequence[float] | Sequence[Sequence[float]]
Parameters = dict[str, Tensor]
_DRAWN = ("amplitude", "frequency", "phase", "image_motion", "exposure_rows")


@dataclass(frozen=True, eq=False)
class ImageMotion:
    """Motion of B images in row order, each with its own vibration, start and exposure."""

    vibration: Motion  # motion of batch shape (B,)
    starts: Tensor  # (B,) exposure start of the first row of each image, seconds
    exposure_time: Tensor  # (B,) seconds
    timing: RowTiming  # the sensor; its exposure is not used
    size: tuple[int, int]  # (rows, columns) of the images

    def mean_displacement(self, rows: Tensor) -> Tensor:
        """Mean components (B, S, A) over the exposures of frame rows (B, S) (Eq. 2)."""
        starts = self.starts[:, None] + rows * self.timing.row_time
        return self.vibration.mean_displacement(starts, self.exposure_time[:, None])

    def move(self, points: Tensor) -> Tensor:
        """Positions (x, y) in the frame of scene points (B, S, 2) in px, by Newton's method for their rows."""
        x, y = (points[..., 1 - axis] - 0.5 * (self.size[axis] - 1) for axis in (1, 0))
        rows, exposure = points[..., 1], self.exposure_time[:, None]
        for _ in range(8):
            residual = points[..., 1] + displacement_at(self.mean_displacement(rows), x, y)[..., 1] - rows
            starts = self.starts[:, None] + rows * self.timing.row_time
            components = (self.vibration.displacement(times) for times in (starts, starts + exposure))
            begin, end = (displacement_at(at_time, x, y)[..., 1].detach() for at_time in components)
            slope = (end - begin) * self.timing.row_time / exposure
            rows = rows + residual / (1.0 - slope).clamp(min=0.1)
        return torch.stack([points[..., 0] + displacement_at(self.mean_displacement(rows), x, y)[..., 0], rows], -1)

    @full_precision
    def move_images(self, images: Tensor, interpolation: Interpolation) -> Tensor:
        """Form frames (B, C, R, W) in row order from still images, with mirrored boundaries, at least in float32."""
        dtype = images.dtype if images.dtype in (torch.float32, torch.float64) else torch.float32
        # 1. The motion of all columns of a row, or of strips of columns.
        strips, motion = self._strips(), self.vibration
        if strips is not None:
            frames = len(self.starts.unique())
            motion = ColumnMotion.of_columns(motion, strips.columns, self.timing, frames, self.size[0])
        # 2. Its path at the Gauss-Legendre nodes of the exposures of rows.
        rows = torch.arange(self.size[0], dtype=torch.float64, device=self.starts.device)
        starts, exposure = (
            values.repeat_interleave(motion.batch_shape[0] // len(values), 0)
            for values in (self.starts[:, None] + rows * self.timing.row_time, self.exposure_time[:, None, None])
        )
        count = gauss_node_count(motion, float(exposure.amax()))
        nodes, weights = (values.to(starts.device) for values in gauss_legendre(count))
        # 3. The point spread functions, which are the same for all channels.
        psf = trajectory_psf(motion.path(starts, nodes * exposure), weights, interpolation=interpolation)
        psf = type(psf)(psf.first_tap[:, None], psf.weights[:, None], psf.degree)
        if strips is None:
            return blur_rows(images.to(dtype), psf).to(images.dtype)
        return strips.joined(blur_rows(strips.cut(images.to(dtype)), psf)).to(images.dtype)

    def _strips(self) -> ColumnStrips | None:
        """Strips of columns that move by 0.2 px more or less than their neighbours; None without roll and zoom."""
        if self.vibration.num_axes == 2:
            return None
        first, last = float(self.starts.amin()), float(self.starts.amax()) + self.size[0] * self.timing.row_time
        most = self.vibration.largest_displacement(first, last + float(self.exposure_time.amax()))
        pitch = max(16.0, 0.2 / max(float(most[..., 2:].amax()), 1e-9))
        farthest = float(largest_in_frame(most, self.size[1], self.size[0])[..., 0].amax())
        return ColumnStrips.of(self.size[1], pitch, margin=math.ceil(farthest) + 4)  # 4 px: support of the kernel

    def move_masks(self, masks: Tensor) -> Tensor:
        """Labels (B, C, R, W) moved by the mean displacement of their rows, to the nearest pixel."""
        B, _, R, W = masks.shape
        rows = torch.arange(R, dtype=torch.float64, device=masks.device)
        columns = torch.arange(W, dtype=torch.float64, device=masks.device)
        # the inverse of the displacement field, about the middle of the image
        components = self.mean_displacement(rows.expand(B, -1))[:, :, None]
        x, y, roll, zoom = functional.pad(components, (0, 4 - components.shape[-1])).unbind(-1)  # (B, R, 1)
        middle_x, middle_y, scale = 0.5 * (W - 1), 0.5 * (R - 1), 1.0 + zoom
        right, down = columns - x - middle_x, rows[:, None] - y - middle_y
        size = scale.square() + roll.square()
        right, down = (scale * right + roll * down) / size + middle_x, (scale * down - roll * right) / size + middle_y
        places = (mirrored(place.round().to(torch.int64), length) for place, length in ((down, R), (right, W)))
        source_rows, source_columns = places
        index = (source_rows * W + source_columns).flatten(1)[:, None].expand(-1, masks.shape[1], -1)
        return masks.flatten(-2).gather(-1, index).reshape(masks.shape)

    def move_boxes(self, boxes: Tensor) -> Tensor:
        """Boxes (B, N, 4, 2) of corner pixels, in row order, around the moved content of the given boxes.

        The content of an upright box becomes curved, and its result is the smallest upright box around it. Boxes that
        are not upright are moved corner by corner.
        """
        low, high = boxes.amin(-2), boxes.amax(-2)
        count = int((high - low)[..., 1].amax().ceil()) + 2
        steps = torch.linspace(0.0, 1.0, count, dtype=boxes.dtype, device=boxes.device)
        side_rows = low[..., 1, None] + (high - low)[..., 1, None] * steps  # (B, N, S), at most one row apart
        columns = (x[..., None].expand_as(side_rows) for x in (low[..., 0], high[..., 0]))
        sides = torch.stack([torch.stack([of_side, side_rows], -1) for of_side in columns], -3)
        moved = self.move(sides.flatten(1, -2)).reshape(sides.shape).flatten(2, 3)
        lowest, highest = moved.amin(-2)[..., None, :], moved.amax(-2)[..., None, :]
        is_high = boxes == high[..., None, :]  # per corner and coordinate
        around = torch.where(is_high, highest, lowest)
        upright = (is_high | (boxes == low[..., None, :])).flatten(-2).all(-1)
        corners = self.move(boxes.flatten(1, -2)).reshape(boxes.shape)
        return torch.where(upright[..., None, None], around, corners)


def _axis_ranges(name: str, value: Range, *, at_least: float = -math.inf) -> tuple[tuple[float, float], ...]:
    """Lowest and highest value of the axes x and y, from a number or a range for both or for each."""
    if not isinstance(value, Sequence):
        return ((check_number(name, value, at_least=at_least),) * 2,) * 2
    pairs = value if any(isinstance(part, Sequence) for part in value) else (value, value)
    ranges = []
    for pair in pairs:
        if len(pairs) != 2 or not isinstance(pair, Sequence) or len(pair) != 2:
            forms = "a number, (low, high) or ((low, high), (low, high)) for x and y"
            raise TypeError(f"{name} must be {forms}, got {quoted(value)}")
        low, high = (check_number(name, number, at_least=at_least) for number in pair)
        if low > high:
            raise ValueError(f"{name} must not have low above high, got ({low:g}, {high:g})")
        ranges.append((low, high))
    return tuple(ranges)


class RollingShutterVibration(GeometricAugmentationBase2D):
    """Record images of a still scene with a vibrating rolling-shutter camera (Eq. 9 of Liu et al. 2023).

    Every row is exposed at its own time, with random vibration, image motion and exposure. Images are distorted and
    blurred; keypoints move by the mean displacement of the row that shows them, masks likewise to the nearest pixel;
    boxes become the smallest upright ones around their content. Images and masks are mirrored at their boundaries.

    An image is frame 0 of a recording. In ``VideoSequential`` the frames of a clip that share one draw
    (``same_on_frame=True``, Kornia's default) are consecutive frames of one recording, ``frame_rows`` apart.

    A range is one number, ``(low, high)``, or ``((low, high), (low, high))`` for x and y; values are drawn uniformly
    and independently for each axis.

    Args:
        timing: The sensor; its ``frame_rows`` must not be less than the rows of the images.
        amplitude: Range of A in px.
        frequency: Range of f in Hz.
        phase: Range of phi in rad.
        image_motion: Range of v in px/s.
        roll: Range of the amplitude of the rotation about the optical axis in rad, ``(low, high)`` or a number, with
            frequency and phase from the ranges of x; None for no roll.
        zoom: The same for the relative change of scale.
        exposure_rows: Exposure in row times, a number or ``(low, high)``; by default that of the sensor.
        tones: Number of tones of each axis.
        interpolation: ``"cubic"``, or ``"linear"``, which adds a slight blur.
        p: Probability that an image is augmented.
        same_on_batch: Whether all images share one draw.
        keepdim: Whether the output keeps the rank of the input.

    Example:
        >>> timing = SensorTiming(row_time=20e-6, exposure_rows=20, frame_rows=1080)
        >>> augmentation = RollingShutterVibration(timing, amplitude=(0.5, 3.0), frequency=(40.0, 200.0))
        >>> augmentation(torch.rand(4, 3, 64, 48)).shape
        torch.Size([4, 3, 64, 48])
        >>> augmentation.drawn_vibration().amplitude.shape
        torch.Size([4, 2, 1])
    """

    def __init__(
        self,
        timing: SensorTiming,
        *,
        amplitude: Range = (0.5, 4.0),
        frequency: Range = (20.0, 200.0),
        phase: Range = (-math.pi, math.pi),
        image_motion: Range = 0.0,
        roll: float | tuple[float, float] | None = None,
        zoom: float | tuple[float, float] | None = None,
        exposure_rows: float | tuple[float, float] | None = None,
        tones: int = 1,
        interpolation: Interpolation = "cubic",
        p: float = 1.0,
        same_on_batch: bool = False,
        keepdim: bool = False,
    ) -> None:
        check_timing(timing)
        check_choice("interpolation", interpolation, ("linear", "cubic"))
        check_number("p", p, at_least=0.0, at_most=1.0)
        super().__init__(p=p, p_batch=1.0, same_on_batch=same_on_batch, keepdim=keepdim)
        self.timing = timing
        self.tones = check_whole_number("tones", tones, at_least=1)
        exposures = _axis_ranges("exposure_rows", timing.exposure_rows if exposure_rows is None else exposure_rows)[0]
        for value in exposures:
            check_number("exposure_rows", value, above=0.0, at_most=timing.frame_rows)
        turns: tuple[tuple[float, float], ...] = ()
        for name, of_turn in (("roll", roll), ("zoom", zoom))[: 2 if zoom is not None else int(roll is not None)]:
            if isinstance(of_turn, Sequence) and any(isinstance(part, Sequence) for part in of_turn):
                raise TypeError(f"{name} must be a number or (low, high), got {quoted(of_turn)}")
            turns += _axis_ranges(name, 0.0 if of_turn is None else of_turn, at_least=0.0)[:1]
        self.flags = {"image_motion": _axis_ranges("image_motion", image_motion), "exposure_rows": exposures}
        self.flags |= {"amplitude": _axis_ranges("amplitude", amplitude, at_least=0.0) + turns}
        for name, drawn, lowest in (("frequency", frequency, 0.0), ("phase", phase, -math.inf)):
            ranges = _axis_ranges(name, drawn, at_least=lowest)
            self.flags[name] = ranges + ranges[:1] * len(turns)
        self.flags["interpolation"] = interpolation

    def forward(self, input: Tensor, params: Parameters | None = None, **kwargs: object) -> Tensor:
        """Record images (H, W), (C, H, W) or (B, C, H, W); the other arguments are those of Kornia's augmentations."""
        if not torch.compiler.is_compiling():
            check_tensor("input", input)
        if params is not None and not isinstance(params, Mapping):
            raise TypeError(f"params must be those of a former call, got {described(params)}")
        return super().forward(input, params, **kwargs)

    @checks_arguments
    def generate_parameters(self, batch_shape: tuple[int, ...]) -> Parameters:
        """Draw one motion per image: amplitude, frequency, phase (B, A, K), image_motion (B, 2), exposure_rows (B,)."""
        draws = 1 if self.same_on_batch else batch_shape[0]

        def uniform(name: str, *shape: int) -> Tensor:
            low, high = torch.tensor(self.flags[name], device=self.device, dtype=self.dtype).unbind(-1)
            return low + (high - low) * torch.rand(draws, *shape, *low.shape, device=self.device, dtype=self.dtype)

        drawn = {name: uniform(name, self.tones).mT for name in ("amplitude", "frequency", "phase")}
        drawn |= {name: uniform(name) for name in ("image_motion", "exposure_rows")}
        copies = batch_shape[0] // max(draws, 1)
        return {name: value.repeat(copies, *[1] * (value.ndim - 1)) for name, value in drawn.items()}

    @checks_arguments
    def drawn_vibration(self, params: Parameters | None = None) -> Vibration:
        """The vibration of every image of the last call, in image axes: the ground truth for training.

        Clips whose frames share one draw have one vibration each, as a stack in ``restore``. Images that were not
        augmented (``p`` below 1) have amplitude and image motion 0. ``params`` are those of another call.
        """
        params = self._params if params is None else params
        if "amplitude" not in params:
            raise ValueError("no vibration has been drawn yet: call the augmentation first")
        taken = self._gate(params).to(torch.float64)
        drawn = {name: params[name] for name in ("amplitude", "frequency", "phase", "image_motion")}
        drawn["amplitude"] = drawn["amplitude"] * taken[:, None, None]
        drawn["image_motion"] = drawn["image_motion"] * taken[:, None]
        step = self._recording_length(params)
        return Vibration(**{name: value[::step] for name, value in drawn.items()}, camera=None)

    def compute_transformation(self, input: Tensor, *_: object, **__: object) -> Tensor:
        """Return identities (B, 3, 3): no matrix describes rows that move by different amounts."""
        return self.identity_matrix(input)

    def apply_transform(
        self, input: Tensor, params: Parameters, flags: Table, transform: Tensor | None = None
    ) -> Tensor:
        """Distort and blur images (B, C, H, W)."""
        if channels_appear_last(input.shape):
            shape = tuple(input.shape)
            raise ValueError(f"images of shape {shape} appear to have their channels last: pass images.movedim(-1, -3)")
        if input.numel() == 0:
            return input
        images = frames_to_row_order(input, self.timing)
        moved = self._motion(params, images).move_images(images, flags["interpolation"])
        return frames_from_row_order(moved, self.timing)

    def apply_transform_mask(self, input: Tensor, params: Parameters, *_: object, **__: object) -> Tensor:
        """Move masks (B, C, H, W) to the nearest pixel."""
        if input.numel() == 0:
            return input
        masks = frames_to_row_order(input, self.timing)
        return frames_from_row_order(self._motion(params, masks).move_masks(masks), self.timing)

    def apply_transform_keypoint(self, input: Keypoints, params: Parameters, *_: object, **__: object) -> Keypoints:
        """Move keypoints to their positions in the frame."""
        output = input.clone()
        output._data = self._moved(input.data, params, (2,), ImageMotion.move)
        return output

    def apply_transform_box(self, input: Boxes, params: Parameters, *_: object, **__: object) -> Boxes:
        """Return the smallest upright boxes around the moved content of the boxes."""
        output = input.clone()
        output._data = self._moved(input.data, params, (4, 2), ImageMotion.move_boxes)
        return output

    def _moved(
        self, points: Tensor, params: Parameters, shape: tuple[int, ...], move: Callable[[ImageMotion, Tensor], Tensor]
    ) -> Tensor:
        """Points (..., x and y), moved by ``move`` as (B, N, *shape) in row order."""
        if points.numel() == 0:
            return points
        motion = self._motion(params, points)
        by_columns, reverse = self.timing.scan_axis == -1, self.timing.readout_direction == "reverse"
        last = points.new_tensor([0, self._size(params)[0] - 1], dtype=torch.float64)
        sign = points.new_tensor([1, -1], dtype=torch.float64)
        rowwise = points.to(torch.float64).reshape(len(motion.starts), -1, *shape)
        rowwise = rowwise.flip(-1) if by_columns else rowwise
        moved = move(motion, last + sign * rowwise if reverse else rowwise)
        moved = last + sign * moved if reverse else moved
        return (moved.flip(-1) if by_columns else moved).reshape(points.shape).to(points.dtype)

    def _motion(self, params: Parameters, like: Tensor) -> ImageMotion:
        """The drawn motion of a batch in row order."""
        drawn = {name: params[name].to(dtype=torch.float64, device=like.device) for name in _DRAWN}
        exposure_rows, amplitude = drawn.pop("exposure_rows"), drawn.pop("amplitude")
        vibration = Vibration(amplitude, camera=None, **drawn).to_row_order(self.timing)
        self.timing.check_rows(self._size(params)[0])
        length = self._recording_length(params)
        return ImageMotion(
            vibration=vibration,
            starts=self.timing.frame_starts(length).repeat(len(exposure_rows) // length).to(like.device),
            exposure_time=exposure_rows * self.timing.row_time,
            timing=self.timing.in_row_order(),
            size=self._size(params),
        )

    def _recording_length(self, params: Parameters) -> int:
        """Number of frames of video clips that share one draw; 1 for images and for frames with individual draws."""
        clips = params.get("video_batch_size")
        count = len(params["exposure_rows"])
        if clips is None or count == 0:
            return 1
        drawn = (params[name].unflatten(0, (int(clips), -1)) for name in (*_DRAWN, "batch_prob"))
        return count // int(clips) if all(bool((clip == clip[:, :1]).all()) for clip in drawn) else 1

    def _size(self, params: Parameters) -> tuple[int, int]:
        """Rows and columns of the images in row order."""
        height, width = (int(size) for size in params["forward_input_shape"].tolist()[-2:])
        return (height, width) if self.timing.scan_axis == -2 else (width, height)

    def inverse_transform(self, *args: object, **kwargs: object) -> NoReturn:
        """Raise an error: the blur is inverted by restoration only."""
        remedy = "restore(frames, timing, vibration) removes a known vibration"
        raise NotImplementedError(f"RollingShutterVibration has no inverse; {remedy}")

    inverse_boxes = inverse_keypoints = inverse_transform
