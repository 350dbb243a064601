"""What is known about a stack before its pixels are read."""

from dataclasses import dataclass, field

__all__ = ["FrameError", "StackInfo"]


class FrameError(ValueError):
    """One frame of a stack cannot be read; the others may be all right."""


@dataclass(frozen=True)
class StackInfo:
    """Shape, data type and full scale of a stack in a file.

    Attributes:
        shape: (T, H, W) or (T, C, H, W).
        dtype: NumPy name of the pixels' type in the file, e.g. ``"uint16"``.
        full_scale: Count that means 1.0: stated in the file, or 255 for ``uint8``; None for other integers, and for
            floats, whose values are left as they are.
        frame_times: Exposure start of the first row of every frame in seconds, where the file states it.
        resolution: Pixels per unit along x and y, and the unit (``"inch"``, ``"centimeter"``), where stated.
        channels_last: Whether the file keeps the channels of a pixel next to each other.
        times_of_playback: Whether ``frame_times`` are when frames are to be shown, as in videos: rounded, and perhaps
            at another rate than they were taken.
    """

    shape: tuple[int, ...]
    dtype: str
    full_scale: float | None
    frame_times: tuple[float, ...] | None = None
    resolution: tuple[float, float, str] | None = None
    channels_last: bool = field(default=False, compare=False)
    times_of_playback: bool = field(default=False, compare=False)

    @property
    def axes(self) -> str:
        """``"THW"`` (grey) or ``"TCHW"``."""
        return "THW" if len(self.shape) == 3 else "TCHW"

    @property
    def stored_shape(self) -> tuple[int, ...]:
        """Shape in the order of the file: channels go last where they lie next to each other."""
        if self.axes == "TCHW" and self.channels_last:
            return (self.shape[0], *self.shape[2:], self.shape[1])
        return self.shape

    @property
    def stored_axes(self) -> str:
        """Axes in the order of the file."""
        return "THWC" if self.axes == "TCHW" and self.channels_last else self.axes

    @property
    def is_integer(self) -> bool:
        """Whether the pixels are counts."""
        return "int" in self.dtype
