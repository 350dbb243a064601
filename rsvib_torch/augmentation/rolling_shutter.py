"""Kornia augmentation: still images as a vibrating rolling-shutter camera records them.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NoReturn

import torch
from kornia.augmentation import GeometricAugmentationBase2D
from kornia.geometry.boxes import Boxes
from kornia.geometry.keypoints import Keypoints
from torch import Tensor

from rsvib_torch.checks.arguments import as_numbers, channels_appear_last, check_tensor, checks_arguments
from rsvib_torch.checks.values import MAX_NUMBER, check_choice, check_number, check_whole_number
from rsvib_torch.execution.parallel import full_precision
from rsvib_torch.files.reading import Table
from rsvib_torch.frames.prepare import frames_from_row_order, frames_to_row_order
from rsvib_torch.imaging import blur_rows, gauss_node_count, rows_showing, trajectory_psf
from rsvib_torch.imaging.blur import Interpolation
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

    vibration: Vibration  # of batch shape (B,)
    starts: Tensor  # (B,) exposure start of the first row of each image, seconds
    exposure_time: Tensor  # (B,) seconds
    timing: RowTiming  # the sensor; its exposure is not used
    size: tuple[int, int]  # (rows, columns) of the images

    def move(self, points: Tensor) -> Tensor:
        """Positions (x, y) in the frame of scene points (B, S, 2) in px."""
        start, exposure = self.starts[:, None], self.exposure_time[:, None, None]
        rows, displacement = rows_showing(points[..., 1], start, self.timing, self.vibration, exposure)
        return torch.stack([points[..., 0] + displacement[..., 0], rows], -1)

    @full_precision
    def move_images(self, images: Tensor, interpolation: Interpolation) -> Tensor:
        """Form frames (B, C, R, W) in row order from still images, with mirrored boundaries, at least in float32."""
        dtype = images.dtype if images.dtype in (torch.float32, torch.float64) else torch.float32
        # 1. The path at the Gauss-Legendre nodes of the exposures of rows.
        rows = torch.arange(self.size[0], dtype=torch.float64, device=self.starts.device)
        starts, exposure = self.starts[:, None] + rows * self.timing.row_time, self.exposure_time[:, None, None]
        count = gauss_node_count(self.vibration, float(exposure.amax()))
        nodes, weights = (values.to(starts.device) for values in gauss_legendre(count))
        # 2. The point spread functions, which are the same for all channels.
        psf = trajectory_psf(self.vibration.path(starts, nodes * exposure), weights, interpolation=interpolation)
        psf = type(psf)(psf.first_tap[:, None], psf.weights[:, None], psf.degree)
        return blur_rows(images.to(dtype), psf).to(images.dtype)

    def move_masks(self, masks: Tensor) -> Tensor:
        """Labels (B, C, R, W) moved by the mean displacement of their rows, to the nearest pixel."""
        _, C, R, W = masks.shape
        rows = torch.arange(R, dtype=torch.float64, device=masks.device)
        columns = torch.arange(W, dtype=torch.float64, device=masks.device)
        starts = self.starts[:, None] + rows * self.timing.row_time
        displacement = self.vibration.mean_displacement(starts, self.exposure_time[:, None])
        x, y = displacement[..., None].unbind(-2)  # (B, R, 1)
        source_rows = mirrored((rows[:, None] - y).round().to(torch.int64), R)
        source_columns = mirrored((columns - x).round().to(torch.int64), W)
        index = (source_rows * W + source_columns).flatten(1)[:, None].expand(-1, C, -1)
        return masks.flatten(-2).gather(-1, index).reshape(masks.shape)

    def move_boxes(self, boxes: Tensor) -> Tensor:
        """Smallest upright boxes (B, N, 4, 2) of corner pixels, in row order, around the moved sides of boxes."""
        sides = boxes.roll(-1, -2) - boxes
        count = int(sides[..., 1].abs().amax().ceil()) + 2  # points of a side, at most one row apart
        steps = torch.linspace(0.0, 1.0, count, dtype=boxes.dtype, device=boxes.device)
        points = boxes[..., None, :] + sides[..., None, :] * steps[:, None]  # (B, N, 4, count, 2)
        corners = self.move(points.flatten(1, -2)).reshape(points.shape).flatten(2, 3)
        lowest, highest = corners.amin(-2)[..., None, :], corners.amax(-2)[..., None, :]
        return torch.where(boxes > boxes.mean(-2, keepdim=True), highest, lowest)  # corners in the given order


def _axis_ranges(name: str, value: Range, *, at_least: float = -MAX_NUMBER) -> Tensor:
    """Lowest and highest value (2, 2) of the axes x and y, from a number or a range for both or for each."""
    ranges = as_numbers(name, value)
    if ranges.shape not in ((), (2,), (2, 2)):
        forms = "a number, (low, high) or ((low, high), (low, high)) for x and y"
        raise TypeError(f"{name} must be {forms}, got {quoted(value)}")
    for low, high in ranges.expand(2, 2).tolist():
        check_number(name, low, at_least=at_least)
        if not low <= high <= MAX_NUMBER:
            raise ValueError(f"{name} must not have low above high or beyond {MAX_NUMBER:g}, got ({low:g}, {high:g})")
    return ranges.expand(2, 2)


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
        for value in exposures.tolist():
            check_number("exposure_rows", value, above=0.0, at_most=timing.frame_rows)
        self.flags = {
            "amplitude": _axis_ranges("amplitude", amplitude, at_least=0.0),
            "frequency": _axis_ranges("frequency", frequency, at_least=0.0),
            "phase": _axis_ranges("phase", phase),
            "image_motion": _axis_ranges("image_motion", image_motion),
            "exposure_rows": exposures,
            "interpolation": interpolation,
        }

    def forward(self, input: Tensor, params: Parameters | None = None, **kwargs: object) -> Tensor:
        """Record images (H, W), (C, H, W) or (B, C, H, W); the other arguments are those of Kornia's augmentations."""
        if not torch.compiler.is_compiling():
            check_tensor("input", input)
            if params is not None and not (isinstance(params, dict) and params.keys() >= set(_DRAWN)):
                raise TypeError(f"params must be the parameters of another call, a dictionary, got {quoted(params)}")
        return super().forward(input, params, **kwargs)

    @checks_arguments
    def generate_parameters(self, batch_shape: tuple[int, ...]) -> Parameters:
        """Draw one motion per image: amplitude, frequency, phase (B, 2, K), image_motion (B, 2), exposure_rows (B,)."""
        draws = 1 if self.same_on_batch else batch_shape[0]

        def uniform(name: str, *shape: int) -> Tensor:
            low, high = self.flags[name].to(self.device, self.dtype).unbind(-1)
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
        transformed = self._motion(params, images).move_images(images, flags["interpolation"])
        return frames_from_row_order(transformed, self.timing)

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
        transformed = move(motion, last + sign * rowwise if reverse else rowwise)
        transformed = last + sign * transformed if reverse else transformed
        return (transformed.flip(-1) if by_columns else transformed).reshape(points.shape).to(points.dtype)

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
