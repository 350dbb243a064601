"""Displacements of parts of row bands between consecutive frames, as vectors at places of the image.

Invariant: the displacement depends on the row only (docs/architecture.md), in each part of the columns.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection.start import band_curve
from rsvib_torch.detection.strips import cut_into_strips
from rsvib_torch.frames.grey import GreyFrames
from rsvib_torch.frames.orientation import offsets_from_row_order
from rsvib_torch.motion.field import displacement_factors
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import RegistrationOptions


@dataclass(frozen=True, eq=False)
class BandVectors:
    """Displacements of M parts of bands, on the CPU in float64, in image axes."""

    pair: Tensor  # (M,) index of the pair of frames
    row: Tensor  # (M,) index of the band
    location: Tensor  # (M,) index of the part of the band: the same place in all pairs
    starts: Tensor  # (M, 2) s, exposure starts of the first rows of both frames
    rows: Tensor  # (M, 2) row times from there to the rows that contain the part, in both frames
    place: Tensor  # (M, 2) px from the centre of the frame, (x, y) in the earlier frame
    offsets: Tensor  # (M, 2) px, (x, y)
    weight: Tensor  # (M,) inverse variances up to a common factor: signal to noise, q / (1 - q) for a correlation q
    # (M, 2, 2) structure of the detail with trace 2: edges along one direction determine one component only
    shape: Tensor
    radius: float  # px, root-mean-square distance of the pixels from the centre
    num_pairs: int  # pairs of frames
    num_rows: int  # bands of a frame
    num_columns: int  # parts of a band
    overlap: float  # rows of a band over those from one band to the next, at least 1

    def times(self, row_time: float) -> Tensor:
        """(M, 2) s, exposure starts of the part in both frames."""
        return self.starts + self.rows * row_time

    def factors(self) -> Tensor:
        """(M, 2, 3) displacement by X, Y and ``radius`` theta, all in px."""
        factors = displacement_factors(self.place[:, 0], self.place[:, 1], 3)
        return factors / factors.new_tensor([1.0, 1.0, self.radius])


def band_vectors(stack: GreyFrames, timing: SensorTiming, options: RegistrationOptions) -> BandVectors:
    """Register the bands of consecutive frames of one stack in parts of their columns.

    An error is raised if frames are too small for two parts, or fewer than a tenth of the bands are found.
    """
    height, width = stack.images.shape[-2:]
    narrowest = 4 * (options.search + 8)
    if width < 2 * narrowest:
        raise ValueError(
            f"rows of {width} px are too short to measure roll: with search={options.search}, {2 * narrowest} px are "
            "needed"
        )
    # at most 8: narrower parts have larger errors, together the same information
    count = max(2, min(8, width // max(narrowest, 128)))
    rowwise = timing.in_row_order()
    rowwise.check_rows(height)
    parts, columns = cut_into_strips(stack.images, count)
    valid = None if stack.valid is None else cut_into_strips(stack.valid, count)[0]
    curve = band_curve(parts, valid, rowwise, options, mere_start=False)
    good = curve.good
    if float(good.double().mean()) < 0.1:
        raise ValueError(
            f"only {float(good.double().mean()):.0%} of the parts of row bands are found in the next frame: the motion "
            f"exceeds search={options.search} px within a frame (use a larger search), or the frames show different "
            "scenes"
        )
    part, pair, row = (index.cpu() for index in good.nonzero(as_tuple=True))
    offsets = curve.offsets[good].cpu()
    quality = curve.quality[good].cpu()
    structure = _structure(parts, rows=curve.rows.cpu(), height=max(curve.heights))[part, pair, :, row].cpu()
    structure = offsets_from_row_order(offsets_from_row_order(structure, timing).mT, timing).mT
    frame_starts = rowwise.frame_starts(stack.images.shape[1]).cpu()
    rows = curve.rows.cpu()
    place = torch.stack([columns.cpu()[part], rows[row] - 0.5 * (height - 1)], -1)
    return BandVectors(
        pair=pair,
        row=row,
        location=part * len(rows) + row,
        starts=torch.stack([frame_starts[:-1][pair], frame_starts[1:][pair]], -1),
        rows=torch.stack([rows[row], rows[row] + offsets[:, 1]], -1),
        place=offsets_from_row_order(place, timing),
        offsets=offsets_from_row_order(offsets, timing),
        weight=quality / (1.05 - quality.clamp(max=1.0)),
        shape=structure,
        radius=float((height**2 + width**2 - 2) / 12) ** 0.5,
        num_pairs=len(curve.pairs),
        num_rows=len(rows),
        num_columns=count,
        overlap=max(1.0, max(curve.heights) / options.band_step),
    )


def _structure(parts: Tensor, rows: Tensor, height: int) -> Tensor:
    """(S, T, 2, R, 2) products of gradients along x and y, summed over bands of parts (S, T, H, w), with trace 2."""
    smooth = parts - functional.avg_pool2d(parts, 5, 1, 2, count_include_pad=False)
    y, x = torch.gradient(smooth, dim=(-2, -1))
    products = torch.stack([x * x, x * y, y * y]).mean(-1).double()  # (3, S, T, H)
    tops = (rows - 0.5 * (height - 1)).round().to(device=parts.device, dtype=torch.int64)
    total = functional.pad(products.cumsum(-1), (1, 0))
    xx, xy, yy = total[..., (tops + height).clamp(max=parts.shape[-2])] - total[..., tops.clamp(min=0)]
    size = (xx + yy).clamp(min=1e-300) / 2
    products = torch.stack([torch.stack([xx, xy], -1), torch.stack([xy, yy], -1)], -3)
    scaled: Tensor = products / size[..., None, :, None]
    return scaled
