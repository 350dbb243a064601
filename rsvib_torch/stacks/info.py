"""What is known about a stack before its pixels are read."""

from dataclasses import dataclass

__all__ = ["StackInfo"]


@dataclass(frozen=True)
class StackInfo:
    """Shape, data type and full scale of a stack in a file.

    Attributes:
        shape: (T, H, W) or (T, C, H, W).
        dtype: NumPy name of the pixels' type in the file, e.g. ``"uint16"``.
        full_scale: Count that means 1.0: stated in the file, or 255 for ``uint8``; None for other integers, and for
            floats, whose values are left as they are.
    """

    shape: tuple[int, ...]
    dtype: str
    full_scale: float | None

    @property
    def axes(self) -> str:
        """``"THW"`` (grey) or ``"TCHW"``."""
        return "THW" if len(self.shape) == 3 else "TCHW"

    @property
    def is_integer(self) -> bool:
        """Whether the pixels are counts."""
        return "int" in self.dtype
