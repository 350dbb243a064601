"""Strips of columns that overlap by half and are added up with triangular weights.

Roll and zoom displace the content of a row by amounts that change slowly along the row. What requires a displacement
per row is applied to strips, each with the displacement of its middle; between middles the result is interpolated.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class ColumnStrips:
    """Strips of equal width that cover a frame."""

    frame_width: int  # columns of the frame
    width: int  # columns of a strip
    firsts: tuple[int, ...]  # first column of each strip
    middles: tuple[float, ...]  # columns, not necessarily whole, where the weight of each strip is 1

    @classmethod
    def of(cls, frame_width: int, max_pitch: float, margin: int) -> "ColumnStrips":
        """Strips whose middles are at most ``max_pitch`` px apart, with ``margin`` px without weight at both ends.

        Example:
            >>> strips = ColumnStrips.of(100, max_pitch=40, margin=4)
            >>> strips.width, strips.firsts
            (75, (0, 12, 25))
            >>> bool(torch.allclose(strips.joined(strips.cut(torch.ones(1, 100))), torch.ones(1, 100)))
            True
        """
        count = max(1, math.ceil(frame_width / max_pitch))
        step = frame_width / count
        return cls._around(frame_width, step, margin, [(number + 0.5) * step - 0.5 for number in range(count)])

    @classmethod
    def between_ends(cls, frame_width: int, max_pitch: float, margin: int) -> "ColumnStrips":
        """Strips as from ``of``, but the middles of the first and the last are the ends of the frame."""
        count = max(1, math.ceil((frame_width - 1) / max_pitch))
        step = (frame_width - 1) / count
        return cls._around(frame_width, step, margin, [number * step for number in range(count + 1)])

    @classmethod
    def _around(cls, frame_width: int, step: float, margin: int, middles: list[float]) -> "ColumnStrips":
        width = min(frame_width, math.ceil(2 * step) + 2 * margin)
        firsts = tuple(min(max(round(middle - 0.5 * (width - 1)), 0), frame_width - width) for middle in middles)
        return cls(frame_width, width, firsts, tuple(middles))

    @property
    def columns(self) -> Tensor:
        """(S,) float64 px, middles of the strips from the centre of the frame."""
        return torch.tensor(self.middles, dtype=torch.float64) - 0.5 * (self.frame_width - 1)

    @property
    def edges(self) -> tuple[int, ...]:
        """Columns where a part that is nearer to one middle than to the others begins, and the end of the frame."""
        step = self.frame_width / len(self.firsts)
        return (*(round(number * step) for number in range(len(self.firsts))), self.frame_width)

    def cut(self, images: Tensor) -> Tensor:
        """Strips (B S, ..., w) of images (B, ..., W)."""
        return torch.stack([images[..., first : first + self.width] for first in self.firsts], 1).flatten(0, 1)

    def finer(self, scale: int) -> "ColumnStrips":
        """The same strips on a grid of ``scale`` points per px; point 0 lies at column 0."""
        return ColumnStrips(
            scale * self.frame_width,
            scale * self.width,
            tuple(scale * first for first in self.firsts),
            tuple(scale * middle for middle in self.middles),
        )

    def joined(self, strips: Tensor) -> Tensor:
        """Images (B, ..., W) from strips (B S, ..., w)."""
        last = len(self.firsts) - 1
        step = self.middles[1] - self.middles[0] if last else 1.0
        each = strips.unflatten(0, (-1, last + 1))
        total = strips.new_zeros(*each[:, 0].shape[:-1], self.frame_width)
        place = torch.arange(self.width, device=strips.device)
        for number, (first, middle) in enumerate(zip(self.firsts, self.middles, strict=True)):
            away = (place + first - middle) / step
            away = away.clamp(min=0.0) if number == 0 else away
            away = away.clamp(max=0.0) if number == last else away
            total[..., first : first + self.width] += (1 - away.abs()).clamp(min=0.0).to(strips.dtype) * each[:, number]
        return total
