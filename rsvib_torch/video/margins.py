"""Margins that are cut off the frames of a video."""

from dataclasses import dataclass
from typing import TypeVar

from torch import Tensor

from rsvib_torch.checks.arguments import checked_methods
from rsvib_torch.checks.values import check_whole_number, described
from rsvib_torch.numerics.tables import Array

Pixels = TypeVar("Pixels", Tensor, Array)


@dataclass(frozen=True)
@checked_methods
class Margins:
    """Rows and columns (px) to cut from the frames so that no extrapolated pixel remains.

    Example:
        >>> import torch
        >>> Margins(top=2, left=1).cut(torch.zeros(10, 9)).shape
        torch.Size([8, 8])
    """

    top: int = 0
    bottom: int = 0
    left: int = 0
    right: int = 0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_whole_number(name, value, at_least=0)

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
                "border='mirror', or a shorter --steady"
            )
        rows, columns = rows - rows % 2, columns - columns % 2
        return images[..., self.top : self.top + rows, self.left : self.left + columns]
