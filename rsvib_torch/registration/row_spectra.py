"""Fourier transforms along the rows of frames: warping by a motion, differences of frames, fixed column patterns.

A row is displaced by a phase factor of its spectrum. Frames have rows on axis -2 in readout order.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from collections.abc import Iterator
from copy import copy

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.execution.parallel import at_once, chunks, runs
from rsvib_torch.numerics.interpolation import (
    bspline_coefficient_rows,
    bspline_weights,
    extend_rows,
    fast_length,
    phase_products,
    phase_tables,
    shift_phases,
    squared_modulus,
)

DEGREE = 7  # of the B-spline across rows: its smoothing and the noise it correlates lie above the pass band in use
MARGIN = 8  # px; rows and columns this close to an edge have no weight: they are interpolated from extended values


class RowSpectra:
    """Fourier transforms along the rows of frames (B, T, H, W) in row order, of their splines across rows.

    ``valid`` pixels have weight. The level (B, T, 1, 1) is subtracted from each frame, and the difference divided by
    the contrast.
    """

    def __init__(
        self, frames: Tensor, valid: Tensor | None = None, level: Tensor | float = 0.0, contrast: Tensor | float = 1.0
    ) -> None:
        self.height, self.width = frames.shape[-2:]
        self.length = fast_length(self.width + 64)  # 32 px of boundary extension per end close the period smoothly
        # Few frames at a time limit the memory for copies, and few of their rows at a time stay in the cache.
        bytes_of_frame = 4 * frames[:, 0].numel() * frames.element_size()
        level, contrast = (
            torch.as_tensor(x, dtype=frames.dtype, device=frames.device).expand(*frames.shape[:2], 1, 1)
            for x in (level, contrast)
        )

        def transformed(part: slice) -> Tensor:
            rows = (
                extend_rows(coefficients.sub_(level[:, part]).div_(contrast[:, part]), self.length, hold=0.0)
                for coefficients in bspline_coefficient_rows(frames[:, part], DEGREE)
            )
            return torch.cat([torch.fft.rfft(values) for values in rows], dim=2)

        parts = runs(frames.shape[1], at_once(bytes_of_frame, frames.device, cpu_bytes=2**26))
        self.values = torch.cat([transformed(part) for part in parts], dim=1)
        self._index_rows()
        self.frequencies = torch.fft.rfftfreq(self.length, dtype=torch.float64, device=frames.device)
        self._band = slice(0, len(self.frequencies))
        self.valid = None
        if valid is not None and not bool(valid.all()):
            # pixels that are interpolated from an invalid one are invalid as well
            self.valid = functional.max_pool2d((~valid).to(frames.dtype), 2 * (DEGREE // 2) + 1, 1, DEGREE // 2) == 0

    def _index_rows(self) -> None:
        """Set the table of all rows of all frames (shared by parts) and the index of each frame's first row in it."""
        frames = self.values.shape[:2]
        self._all_rows = torch.view_as_real(self.values).view(-1, 2 * self.values.shape[-1])
        self._first_rows = self.height * torch.arange(frames.numel(), device=self.values.device).view(frames)

    def part(self, frames: slice) -> "RowSpectra":
        """The spectra of some of the frames."""
        selection = copy(self)
        selection.values, selection._first_rows = self.values[:, frames], self._first_rows[:, frames]
        selection.valid = None if self.valid is None else self.valid[:, frames]
        return selection

    def in_groups(self, count: int) -> "RowSpectra":
        """Spectra (B M, G) of ``count`` groups of each stack, see ``overlapping``; ``values`` stay those of frames."""
        if count == 1:
            return self
        grouped = copy(self)
        grouped._first_rows = overlapping(self._first_rows, count)
        grouped.valid = None if self.valid is None else overlapping(self.valid, count)
        return grouped

    def _with(self, values: Tensor, valid: Tensor | None) -> "RowSpectra":
        """Other spectra of the same frequencies, with a mask."""
        spectra = copy(self)
        spectra.values, spectra.valid = values, valid
        spectra._index_rows()
        return spectra

    def stacks(self, index: Tensor) -> "RowSpectra":
        """The spectra of some of the stacks; the values are copied."""
        return self._with(self.values[index], None if self.valid is None else self.valid[index])

    def band(self, frequencies: slice) -> "RowSpectra":
        """Some of the frequencies of all frames; the values are copied."""
        selection = self._with(self.values[..., frequencies].contiguous(), self.valid)
        selection.frequencies, selection._band = self.frequencies[frequencies], frequencies
        return selection

    def followed_by(self, later: "RowSpectra") -> "RowSpectra":
        """The spectra of these and of later frames of the same size."""
        masks, valid = [part.valid for part in (self, later)], None
        if any(mask is not None for mask in masks):
            everything = self._first_rows.new_ones(1, 1, self.height, self.width, dtype=torch.bool)
            valid = torch.cat([everything if mask is None else mask for mask in masks], 1)
        return self._with(torch.cat([self.values, later.values], 1), valid)

    def warped(self, rows: Tensor, shift: Tensor) -> Tensor:
        """Spectra (B, T, S, U) of frames at fractional rows, moved back by ``shift`` px; both (B, T, S)."""
        return next(self.warped_copies(rows[None], shift[None]))

    def warped_copies(self, rows: Tensor, shift: Tensor) -> Iterator[Tensor]:
        """``warped`` for N rows and shifts (N, B, T, S) in turn, with one computation of weights and phases."""
        cell = rows.floor()
        weights = bspline_weights((rows - cell).to(self._all_rows.dtype), DEGREE).flatten(1, 3)
        taps = torch.arange(-(DEGREE // 2), DEGREE - DEGREE // 2 + 1, device=rows.device)
        index = (cell.to(torch.int64)[..., None] + taps).clamp_(0, self.height - 1)
        index = index.add_(self._first_rows[..., None, None]).flatten(1, 3)
        phases = phase_tables(shift, self.length, self._band, self.values.dtype)
        shape = (*rows.shape[1:], self.values.shape[-1])
        values_of_nodes = (values.unbind(0) for values in (index, weights, *phases))
        for taps, factors, coarse, fine in zip(*values_of_nodes, strict=True):
            interpolated = functional.embedding_bag(  # weighted sums of rows of the table
                taps, self._all_rows, per_sample_weights=factors, mode="sum"
            )
            warped = torch.view_as_complex(interpolated.view(*shape, 2))
            yield warped.mul_(phase_products(coarse, fine, shape[-1]))

    def runs(self, count: int, arrays: int) -> list[slice]:
        """Runs of ``count`` rows for computations that hold ``arrays`` arrays of the size of these spectra."""
        row = self.values[0, 0, 0]
        bytes_of_row = row.element_size() * row.numel() * self._first_rows.numel()  # of all frames
        return chunks(count, arrays * bytes_of_row, row.device)

    def ramp(self, shift: Tensor) -> Tensor:
        """exp(2 pi i u shift) for all frequencies u, (..., U)."""
        return shift_phases(shift, self.length, self._band, self.values.dtype)

    def without(self, pattern: Tensor) -> "RowSpectra":
        """The spectra less a pattern (B, U) that every row of these frames contains."""
        return self._with(self.values - pattern[:, None, None].to(self.values.dtype), self.valid)

    def warped_valid(self, rows: Tensor, shift: Tensor) -> Tensor | None:
        """(B, S, W) bool, pixels of the scene that are valid in all frames; None for all."""
        if self.valid is None:
            return None
        place = rows.round().to(torch.int64).clamp(0, self.height - 1)
        columns = torch.arange(self.width, device=rows.device)
        result = torch.ones(1, dtype=torch.bool, device=rows.device)
        for frame in range(rows.shape[1]):  # one at a time: indices take eight times the memory of the flags
            rows_of_frame = self.valid[:, frame].gather(1, place[:, frame, :, None].expand(-1, -1, self.width))
            column = (columns + shift[:, frame, :, None].round().to(torch.int64)).clamp(0, self.width - 1)
            result = result & rows_of_frame.gather(2, column)
        return result


def overlapping(values: Tensor, count: int) -> Tensor:
    """Values (B, F, ...) of frames in ``count`` groups (B M, G, ...), the last frame of each the first of the next.

    Example:
        >>> overlapping(torch.arange(5)[None], 2).tolist()
        [[0, 1, 2], [2, 3, 4]]
    """
    step = (values.shape[1] - 1) // count
    groups: Tensor = values.unfold(1, step + 1, step)
    return groups.movedim(-1, 2).flatten(0, 1)


def combined(spectra: Tensor, factors: Tensor) -> Tensor:
    """Sum (B, S, U) over the frames of spectra (B, G, S, U), each row times its factor (B, G, S)."""
    parts = torch.view_as_real(spectra)
    factors = factors.to(parts.dtype)[..., None, None]
    total = parts[:, 0] * factors[:, 0]
    for frame in range(1, spectra.shape[1]):
        total.addcmul_(parts[:, frame], factors[:, frame])
    return torch.view_as_complex(total)


def mean_over_frames(spectra: Tensor, visible: Tensor) -> Tensor:
    """Mean (B, S, U) of spectra (B, G, S, U) over the frames in which a row is visible (B, G, S)."""
    return combined(spectra, visible / visible.sum(1, keepdim=True).clamp(min=1.0))


def differences(spectra: Tensor, visible: Tensor) -> Tensor:
    """Differences (B, G, S, U) of the rows of each frame from their mean over the frames in which they are visible.

    For two frames, only that of the first, (B, 1, S, U), because the other is its negative. 0 for invisible rows.
    """
    if spectra.shape[1] == 2:
        half = 0.5 * visible.prod(1, keepdim=True)
        return combined(spectra, torch.cat([half, -half], 1))[:, None]
    different = spectra - mean_over_frames(spectra, visible)[:, None]
    return different.mul_(visible[..., None].to(spectra.real.dtype))


def inner_columns(width: int, shift: Tensor, like: Tensor) -> Tensor:
    """(B, 1, W) weight of columns: 1 where all frames of a group show the scene, falling to 0 over 8 px."""
    largest = shift.abs().amax((1, 2)).nan_to_num(width).clamp(max=width)  # that of a fit that diverges may be infinite
    place = torch.arange(width, dtype=like.dtype, device=like.device)
    inside = torch.minimum(place, width - 1 - place) - (largest.ceil() + MARGIN).to(like.dtype)[:, None]
    return (inside / MARGIN).clamp(0.0, 1.0)[:, None]


EVERY = 4  # rows; every fourth row is enough to estimate a column pattern
# mean square of the slope of a pattern over that of the scene. A pattern of 4e-4 (0.001 with noise of 0.005) changed
# amplitudes by a tenth of their standard deviation; errors of interpolation of up to 6e-5 were subtracted as a pattern
# in 5 of 36 recordings without one, which took up to 1.6 times as long
_LEAST_PATTERN = 3e-4


def column_pattern(groups: list[tuple[RowSpectra, Tensor, Tensor, Tensor, Tensor]]) -> Tensor:
    """Spectrum (B, U), shrunk by its noise, of a pattern that every row of every frame has at the same columns.

    It is fixed to the sensor and biases displacements towards zero. In frames warped back by the motion, the pattern p
    appears as ``p(x + shift)`` while the scene stands still. For each frequency u, the differences of the frames d are
    therefore regressed on the differences r of ``exp(2 pi i u shift)``, which excludes the scene: ``p(u) = sum conj(r)
    d / sum |r|^2``. 0 where no pattern is significant, or if it is too weak to bias displacements.

    The groups are spectra of frames, M of each stack, with the rows, shifts and visibility (B M, G, S each) that warp
    some of their rows, and the residual variance (B M, S) of these rows. Objects that move by themselves are left out:
    rows whose variance exceeds three times the median.
    """
    correlation, power, energy, count = (torch.zeros((), dtype=torch.float32, device="cpu") for _ in range(4))
    stacks = len(groups[0][0].values)

    def stack_sums(values: Tensor) -> Tensor:
        """Sums (B, ...) over the groups of each stack of values (B M, ...)."""
        return torch.stack(values.tensor_split(stacks)).sum(1)

    for spectra, rows, shift, shown, variance in groups:
        typical = torch.where(variance > 0, variance, torch.nan).nanmedian(dim=-1, keepdim=True).values
        visible = shown * ((variance > 0) & (variance < 3.0 * typical))[:, None]
        visible = visible * (visible.sum(1, keepdim=True) > 1)
        # the ends of rows stay in place as well
        inner = inner_columns(spectra.width, shift, spectra.values.real)[:, None]
        for run in spectra.runs(rows.shape[-1], 5):
            warped, ramp = spectra.warped(rows[..., run], shift[..., run]), spectra.ramp(shift[..., run])
            pixels = torch.fft.irfft(differences(warped, visible[..., run]), n=spectra.length)
            difference = torch.fft.rfft(pixels[..., : spectra.width] * inner, n=spectra.length)
            regressor = differences(ramp, visible[..., run])
            correlation = correlation + stack_sums((regressor.conj() * difference).sum((1, 2)))
            power = power + stack_sums(squared_modulus(regressor).sum((1, 2)))
            energy = energy + stack_sums(squared_modulus(difference).sum((1, 2)))
        count = count + stack_sums(visible.sum((1, 2)) - (visible.sum(1) > 0).sum(-1)).to(energy.dtype)[:, None]
    pattern = correlation / power.clamp(min=1e-6)
    # power of the pattern over that of its noise, a mean over 17 neighbouring frequencies; 3 is beyond chance
    strength = pattern.abs().square() * power / (energy / count.clamp(min=1.0)).clamp(min=1e-30)
    strength = functional.avg_pool1d(functional.pad(strength[:, None], (8, 8), mode="replicate"), 17, 1)[:, 0]
    share = torch.where(strength > 3.0, 1 - 1 / strength.clamp(min=1.0), 0.0)
    shrunk: Tensor = pattern * share
    u = groups[0][0].frequencies.to(power.dtype)
    scene = torch.stack([squared_modulus(spectra.values[:, :, ::16]).mean((1, 2)) for spectra, *_ in groups]).mean(0)
    slopes, scene_slope = ((u.square() * values).sum(-1) for values in (squared_modulus(shrunk), scene))
    return shrunk * (slopes > _LEAST_PATTERN * scene_slope)[:, None]
