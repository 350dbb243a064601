"""Restoration of the geometry only: every row is moved back by its mean displacement during the exposure.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import check_single, check_whole_number, described
from rsvib_torch.execution.chunking import gathered, runs
from rsvib_torch.frames.orientation import frames_from_row_order, frames_to_row_order
from rsvib_torch.motion.field import check_two_axes
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import MAX_ROWS, SensorTiming, check_timing
from rsvib_torch.numerics.fourier import extend_rows, extended_length, phase_tables, spline_spectra
from rsvib_torch.numerics.splines import bspline_coefficients, bspline_weights, mirrored
from rsvib_torch.options import DewarpOptions
from rsvib_torch.restoration.frame_motion import FrameMotion, MovingFrames, frame_motion

_DEGREE = 5  # of the B-spline across rows
_CHUNK_ROWS = 128  # interpolated at a time


@dataclass(frozen=True, eq=False)
class _Moves:
    """Where the rows of restored frames are found in the frames; all tensors are real."""

    taps: Tensor  # (B, T, H, 6) int64, rows of a frame
    weights: Tensor  # (B, T, H, 6) of these rows
    coarse: Tensor  # (B, T, H, n, 2) phase factors, from ``phase_tables``
    fine: Tensor  # (B, T, H, 64, 2) phase factors

    @classmethod
    def of(cls, motion: FrameMotion, length: int, dtype: torch.dtype) -> "_Moves":
        """Moves by a motion, for rows that are extended to ``length``."""
        rows, moved = motion.frame_rows(torch.arange(motion.num_rows, dtype=torch.float64, device=motion.shift.device))
        cell = rows.detach().floor()
        weights = bspline_weights(rows - cell, _DEGREE).to(dtype)
        taps = cell.to(torch.int64)[..., None] + torch.arange(_DEGREE + 1, device=rows.device) - _DEGREE // 2
        tables = phase_tables(moved[..., 0], length, slice(0, length // 2 + 1), dtype.to_complex())
        return cls(mirrored(taps, motion.num_rows), weights, *(torch.view_as_real(table) for table in tables))


def restore_dewarp(given: MovingFrames, options: DewarpOptions = DewarpOptions()) -> Tensor:  # noqa: B008
    """Undo the displacement of every row of frames, not its blur: sufficient for short exposures.

    Scene row s is interpolated at frame row r(s) by a quintic B-spline across rows and moved back along the row by the
    mean displacement (Eq. 2) of that row with a phase ramp. Noise is not amplified.
    """
    frames, motion = given.images, given.motion
    length = extended_length(frames.shape[-1], motion.displacement_bound())
    moves = _Moves.of(motion, length, frames.dtype)
    spectra = torch.view_as_real(spline_spectra(frames, _DEGREE, length))

    def rows_of(moved: Tensor) -> Tensor:
        return torch.fft.irfft(torch.view_as_complex(moved), n=length)[..., : frames.shape[-1]]

    return _moved_back(spectra, moves, rows_of, _CHUNK_ROWS)


def _moved_back(spectra: Tensor, moves: _Moves, rows_of: Callable[[Tensor], Tensor], chunk_rows: int) -> Tensor:
    """Restored frames (B, T, C, H, W) of transforms along rows (B, T, C, H, U, 2) of spline coefficients.

    Shapes are changed as real tensors: ONNX has no complex ones. ``rows_of`` takes moved spectra (..., U, 2) to rows.
    """
    B, T, C, H, count, _ = spectra.shape
    flat = spectra.movedim(2, 3).reshape(B * T * H, -1)  # one entry per row, with all channels
    image = torch.arange(B * T, device=spectra.device)[:, None, None]
    values = (moves.taps, moves.weights, moves.coarse[..., None, :], moves.fine[:, :, :, None])
    taps, *others = (one.expand(B, *one.shape[1:]).flatten(0, 1) for one in values)
    chunks = zip(*(one.split(chunk_rows, 1) for one in (taps + image * H, *others)), strict=True)

    def restored(taps: Tensor, weights: Tensor, coarse: Tensor, fine: Tensor) -> Tensor:
        """Some rows of all images."""
        fetched = embedding_bag(taps.flatten(0, 1), flat, per_sample_weights=weights.flatten(0, 1), mode="sum")
        products = torch.view_as_real(torch.view_as_complex(coarse) * torch.view_as_complex(fine))
        phases = torch.view_as_complex(products.flatten(2, 3)[:, :, None, :count])
        moved = torch.view_as_complex(fetched.view(B * T, -1, C, count, 2)) * phases
        return rows_of(torch.view_as_real(moved))

    parts = ((part, restored(*chunk)) for part, chunk in zip(runs(H, chunk_rows), chunks, strict=True))
    return gathered(parts, H, 1).unflatten(0, (B, T)).movedim(3, 2)


class FixedDewarp(nn.Module):
    """Restoration by method ``"dewarp"`` with a vibration that does not change, as a fixed graph of tensor operations.

    All that depends on the vibration is computed once. The result is that of ``restore(..., method="dewarp",
    check=False)``. Frames are float32 tensors without missing pixels. ``torch.compile(fullgraph=True)``,
    ``torch.export.export`` and ``torch.onnx.export`` accept the module. Rows are transformed by products with two
    matrices of about W^2 numbers: runtimes of ONNX transform most lengths slowly, with errors of up to 6e-4.

    Args:
        timing: The sensor.
        vibration: One motion along x and y, in image axes.
        size: (height, width) of the frames in px.
        num_frames: Frames of a stack.

    Raises:
        ValueError: If the vibration is a batch or has roll, zoom or a camera, or ``restore`` refuses this size.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, vibration = example_frames()
        >>> dewarp = rsv.FixedDewarp(timing, vibration, frames.shape[-2:], num_frames=2)
        >>> program = torch.export.export(dewarp, (frames,))
        >>> expected = rsv.restore(frames, timing, vibration, method="dewarp", check=False)
        >>> torch.allclose(program.module()(frames), expected, atol=1e-5)
        True
    """

    taps: Tensor
    weights: Tensor
    coarse: Tensor
    fine: Tensor
    to_spectra: Tensor  # (W, 2 U)
    to_rows: Tensor  # (2 U, W)

    @checks_arguments
    def __init__(self, timing: SensorTiming, vibration: Motion, size: tuple[int, int], num_frames: int) -> None:
        super().__init__()
        check_timing(timing)
        check_two_axes(vibration, "FixedDewarp")
        check_single("vibration", vibration.batch_shape)
        check_whole_number("num_frames", num_frames, at_least=1)
        sides = [check_whole_number("size", side, at_least=1, at_most=MAX_ROWS) for side in size]
        height, width = sides if timing.scan_axis == -2 else sides[::-1]
        rowwise, in_rows = vibration.detached().to_row_order(timing).expanded(1), timing.in_row_order()
        in_rows.check_rows(height)
        motion = frame_motion(rowwise, in_rows, num_frames, height)
        motion.check_fits(width)
        self.timing, self.shape = timing, (num_frames, *sides)
        length = extended_length(width, motion.displacement_bound())
        for name, values in vars(_Moves.of(motion, length, torch.float32)).items():
            self.register_buffer(name, values)
        # Both transforms of unit vectors, in float64.
        units = torch.eye(width, dtype=torch.float64, device=motion.shift.device)
        of_rows = torch.view_as_real(torch.fft.rfft(extend_rows(units, length))).flatten(1)
        of_spectra = torch.eye(of_rows.shape[1], dtype=torch.float64, device=units.device).unflatten(1, (-1, 2))
        rows = torch.fft.irfft(torch.view_as_complex(of_spectra), n=length)[:, :width]
        self.register_buffer("to_spectra", of_rows.float())
        self.register_buffer("to_rows", rows.float())
        bspline_coefficients(self.to_spectra[0], _DEGREE, 0)  # the filter is computed now: a graph cannot contain that

    def extra_repr(self) -> str:
        """The frames that it restores."""
        return "{} frames of {} x {} px".format(*self.shape)

    def forward(self, frames: Tensor) -> Tensor:
        """Restore frames (T, H, W), (T, C, H, W) or (B, T, C, H, W)."""
        if not isinstance(frames, Tensor):
            raise TypeError(f"frames must be a tensor, got {described(frames)}")
        if frames.dtype != self.to_spectra.dtype:
            raise TypeError(
                f"frames must be {self.to_spectra.dtype} as the module, got {frames.dtype}; pass frames.float()"
            )
        batch = frames[None, :, None] if frames.ndim == 3 else frames[None] if frames.ndim == 4 else frames
        if batch.ndim != 5 or (batch.shape[1], *batch.shape[-2:]) != self.shape:
            raise ValueError(
                f"frames must be stacks of (frames, height, width) = {self.shape}, got shape {tuple(frames.shape)}"
            )
        coefficients = bspline_coefficients(frames_to_row_order(batch, self.timing), _DEGREE, -2)
        spectra = (coefficients @ self.to_spectra).unflatten(-1, (-1, 2))
        moves = _Moves(self.taps, self.weights, self.coarse, self.fine)
        restored = _moved_back(spectra, moves, lambda moved: moved.flatten(-2) @ self.to_rows, spectra.shape[3])
        return frames_from_row_order(restored, self.timing).reshape(frames.shape)
