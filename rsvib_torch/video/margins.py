"""Margins that are cut off the frames of a video."""

from dataclasses import dataclass
from typing import TypeVar

from torch import Tensor

from rsvib_torch.numerics.tables import Array

Pixels = TypeVar("Pixels", Tensor, Array)


@dataclass(frozen=True)
class Margins:
    """Rows and columns (px) to cut from the frames so that no extrapolated pixel remains."""

    top: int
    bottom: int
    left: int
    right: int

    def cut(self, images: Pixels) -> Pixels:
        """Images (..., H, W) without the margins; height and width remain even, as video encoders require.

        Raises:
            ValueError: If nothing remains.
        """
        height, width = images.shape[-2:]
        rows, columns = height - self.top - self.bottom, width - self.left - self.right
        if rows < 2 or columns < 2:
            raise ValueError(
                f"the margins {self} leave nothing of frames of {height} x {width} px: the image moves too far; use "
                "border='mirror', or a shorter --steady"
            )
        rows, columns = rows - rows % 2, columns - columns % 2
        return images[..., self.top : self.top + rows, self.left : self.left + columns]
