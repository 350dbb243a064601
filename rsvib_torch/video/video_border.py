"""Pixels of restored video frames that the sensor did not record: a border that moves from frame to frame."""

from dataclasses import astuple, dataclass
from typing import TypeVar

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import checked_methods, checks_arguments
from rsvib_torch.checks.values import check_whole_number, described
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import BorderName
from rsvib_torch.tracking.tracked_frame import TrackedFrame

Pixels = TypeVar("Pixels", Tensor, Array)


@dataclass(frozen=True)
@checked_methods
class Margins:
    """Rows and columns (px) to cut from the frames so that no extrapolated pixel remains.

    Example:
        >>> visible = torch.ones(6, 8, dtype=torch.bool)
        >>> visible[:2], visible[:, -1:] = False, False
        >>> Margins.of(visible)
        Margins(top=2, bottom=0, left=0, right=1)
    """

    top: int = 0
    bottom: int = 0
    left: int = 0
    right: int = 0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_whole_number(name, value, at_least=0)

    @classmethod
    def of(cls, visible: Tensor) -> "Margins":
        """Margins of one frame, from its visible pixels (H, W); the visible part has no holes.

        Rows without any visible pixel belong to the top and bottom; of the other rows, the widest margin counts.
        """
        height, width = visible.shape
        rows = visible.any(-1).nonzero()[:, 0]
        if not len(rows):
            return cls(height, 0, width, 0)
        inner = visible[rows[0] : rows[-1] + 1].to(torch.uint8)
        left, right = int(inner.argmax(-1).amax()), int(inner.flip(-1).argmax(-1).amax())
        return cls(int(rows[0]), height - 1 - int(rows[-1]), left, right)

    def widest(self, other: "Margins") -> "Margins":
        """The wider margin of each side."""
        return Margins(*map(max, astuple(self), astuple(other)))

    def cut(self, images: Pixels) -> Pixels:
        """Images (..., H, W) without the margins; height and width remain even, as video encoders require.

        Raises:
            ValueError: If nothing remains.
        """
        if not hasattr(images, "shape") or len(images.shape) < 2:
            raise TypeError(f"images must be a tensor or an array (..., H, W), got {described(images)}")
        height, width = images.shape[-2:]
        rows, columns = height - self.top - self.bottom, width - self.left - self.right
        if rows < 2 or columns < 2:
            raise ValueError(
                f"the margins {self} leave nothing of frames of {height} x {width} px: the image moves too far; use "
                "border='hold', or a shorter --steady"
            )
        rows, columns = rows - rows % 2, columns - columns % 2
        return images[..., self.top : self.top + rows, self.left : self.left + columns]


class VideoBorder:
    """Frames of a video without a border that jumps.

    A restored frame has a rim, as wide as the motion, whose content was outside of the sensor. It changes from frame to
    frame.

    Args:
        border: ``"mirror"``: the rim is extrapolated from each frame by itself, as ``restore`` does; ``"hold"``: pixels
            outside keep the value that they had in the frame before; ``"crop"``: all frames are cut by constant
            margins. Pixels outside that remain keep their value.
        margins: For ``"crop"``: the widest margins of all frames, from ``Margins.of(tracked.visible)``.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=6)
        >>> tracker, border = rsv.VibrationTracker(timing, window=4), rsv.VideoBorder("hold")
        >>> video = [border(tracker.update(frame)) for frame in frames]
        >>> video[0].shape == frames[0].shape
        True
    """

    @checks_arguments
    def __init__(self, border: BorderName = "hold", margins: Margins | None = None) -> None:
        if (border == "crop") != (margins is not None):
            raise ValueError(
                f"margins go with border='crop' and only with it, got border={border!r}, margins={margins}"
            )
        self.border, self.margins = border, margins
        self._before: Tensor | None = None

    def __call__(self, tracked: TrackedFrame) -> Tensor:
        """The restored frame (..., H, W) as a frame of the video."""
        frame = tracked.restored
        if self.border == "mirror":
            return frame
        if self._before is not None and self._before.shape == frame.shape:
            frame = torch.where(tracked.visible, frame, self._before)
        self._before = frame.clone()  # the caller may draw on the frame of the video
        return frame if self.margins is None else self.margins.cut(frame)
