"""Offsets of row bands between consecutive frames: the offset curve (Sec. 2.2 of Liu et al. 2023).

The whole-frame offset comes first, then the offset of every band by one of ``BAND_METHODS``. A band has one
offset over its whole width.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arguments import FramesOrFiles
from rsvib_torch.checks.values import check_choice
from rsvib_torch.execution.parallel import at_once, chunks, runs
from rsvib_torch.execution.progress import steps
from rsvib_torch.frames.entry_points import frames_options
from rsvib_torch.frames.pixels import smoothed
from rsvib_torch.frames.prepare import offsets_from_row_order, prepare_frames
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.numerics.interpolation import fast_length
from rsvib_torch.options import BandRegistrationOptions, RegistrationOptions
from rsvib_torch.registration.methods import BAND_METHODS, BandTask, template_margin
from rsvib_torch.results.presentation import Result

# Correlation of bands of independent noise times the root of their pixels: medians of 12.6 (32 x 128 px), 10.4 (32 x
# 256 px) and 10.6 (32 x 320 px) were measured, of the bands that count as registered.
_CHANCE = 14.0
_GAUSSIAN = np.exp(-0.5 * np.arange(-3.0, 4.0) ** 2)  # of 1 px
_GAUSSIAN /= _GAUSSIAN.sum()


@dataclass(frozen=True, eq=False, repr=False)
class OffsetCurve(
    Result,
    units={"times": "s", "later_times": "s", "offsets": "px", "std": "px"},
    shapes={
        "pairs": "P 2",
        "rows": "N",
        "offsets": "... P N A",
        "times": "[...] P N",
        "later_times": "[...] P N",
        "quality": "... P N",
        "std": "... P N A",
    },
):
    """Offsets of row bands between frames.

    The content of the band around row r of the earlier frame lies at r plus the offset in the later frame
    (displacement in the later frame minus that in the earlier one). A batch of stacks has a leading dimension B in
    ``offsets`` and ``quality``, windows of a stack also in ``times`` and ``later_times``.

    Attributes:
        pairs: (P, 2) int64, indices of the earlier and the later frame.
        rows: (N,) float64, centre row of each band in the earlier frame, in readout order; in the still scene, if the
            offsets are those of the direct method.
        times: (..., P, N) float64, exposure start of the centre row in the earlier frame, s.
        later_times: (..., P, N) float64, exposure start in the later frame, s: of the same row, or, in the direct
            method, of the row with the same part of the scene.
        offsets: (..., P, N, 2) float64 px, axes (x, y); NaN where nothing was measured. A detection with roll or zoom
            has three or four components, roll in rad and zoom relative.
        quality: (..., P, N) float64 in 0 ... 1, 0 where nothing was measured: correlation of the matched bands, or, in
            the direct method, weight in the fit (0 for outliers).
        heights: Rows averaged for the offset along x and y, (x, y).
        std: (..., P, N, 2) px, standard deviations of the offsets; None if unknown.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> timing = rsv.SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> scene = torch.rand(96, 132, generator=torch.Generator().manual_seed(0))
        >>> curve = rsv.register_bands(torch.stack([scene[:, 4:], scene[:, :-4]]), timing)
        >>> curve.offsets.shape, curve.quality.shape  # (frame pair, band, axis), (frame pair, band)
        (torch.Size([1, 5, 2]), torch.Size([1, 5]))
    """

    pairs: Tensor
    rows: Tensor
    times: Tensor
    later_times: Tensor
    offsets: Tensor
    quality: Tensor
    heights: tuple[int, int]
    std: Tensor | None = None

    def summary(self) -> str:
        """Number of offsets, and their range along each axis."""
        pairs, rows = self.quality.shape[-2:]
        lines = [
            f"offsets of {pairs} pairs of frames, {rows} rows each, {float(self.good.double().mean()):.0%} measured"
        ]
        if self.batch_shape:
            lines = [f"batch {tuple(self.batch_shape)}: {lines[0]}"]
        values = self.offsets[self.good]
        if len(values):
            low, high = values.amin(0), values.amax(0)
            lines += [f"{name}: {float(low[axis]):.3f} … {float(high[axis]):.3f} px" for axis, name in enumerate("xy")]
        return "\n".join(lines)

    @property
    def good(self) -> Tensor:
        """(..., P, N) bool: bands whose offset was measured."""
        return torch.isfinite(self.offsets).all(-1)


@frames_options(BandRegistrationOptions)
def register_bands(frames: FramesOrFiles, timing: SensorTiming, options: BandRegistrationOptions) -> OffsetCurve:
    """Measure the offset of every row band between consecutive frames (Sec. 2.2 of Liu et al. 2023).

    The whole-frame offset is found first and may be hundreds of px (image motion); the search range counts from it.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) with T >= 2; tensor, array, list of these, or
            files.
        timing: The sensor.
        options: Options; ``band_rows`` and ``band_step`` are the paper's window size and window interval.

    Returns:
        The offset curve, axes (x, y) of the image, rows in readout order.

    Raises:
        ValueError: If there are fewer than two frames, a pixel is NaN or infinite, an option is out of range, or the
            frames are too small for the bands and the search range.

    Example:
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> scene = torch.rand(96, 132, generator=torch.Generator().manual_seed(0))
        >>> curve = register_bands(torch.stack([scene[:, 4:], scene[:, :-4]]), timing)
        >>> curve.offsets.nanmean((0, 1)).round(decimals=2).tolist()
        [4.0, 0.0]
    """
    prepared = prepare_frames(
        frames, timing, full_scale=options.full_scale, channels=options.channels, minimum_frames=2, allow_missing=False
    )
    bands = RegistrationOptions(
        registration=options.method, band_rows=options.band_rows, band_step=options.band_step, search=options.search
    )
    batch = register_rows(prepared.images.mean(2), prepared.timing, bands)
    curve = batch if prepared.batched else batch[0]
    return replace(curve, offsets=offsets_from_row_order(curve.offsets, timing))


def similar_share(curve: OffsetCurve, columns: int) -> Tensor:
    """(B, P) share of the bands of frames of ``columns`` px that correlate more than noise, of those registered."""
    limit = max(0.1, _CHANCE / math.sqrt(max(curve.heights) * columns))
    return ((curve.quality > limit) & curve.good).double().sum(-1) / curve.good.double().sum(-1).clamp(min=1.0)


def fits_frame(num_rows: int, width: int, options: RegistrationOptions) -> bool:
    """Whether frames of ``num_rows`` rows of ``width`` px contain a band and its search range."""
    needed = _needed_size(options)
    return num_rows >= needed[0] and width >= needed[1]


def _needed_size(options: RegistrationOptions) -> tuple[int, int]:
    """Smallest number of rows, and of px in a row."""
    return options.band_rows + 2 * options.search, 4 * (options.search + 8)


def check_frame_size(num_rows: int, width: int, options: RegistrationOptions, parts: int = 1) -> None:
    """Refuse frames that are smaller than a band and its search range, or frames with such ``parts`` of the columns."""
    rows, columns = _needed_size(options)
    if not fits_frame(num_rows, round(width / parts), options):
        more_columns = ", or use more columns" if getattr(options, "columns", None) else ""
        in_parts = f" in {parts} parts of the columns, for roll, zoom or a lens," if parts > 1 else ""
        raise ValueError(
            f"frames of {num_rows} x {width} px (rows in readout order x px per row) are too small for bands of "
            f"{options.band_rows} rows{in_parts} searched over {options.search} px: at least {rows} x "
            f"{parts * columns} are needed; reduce {'band_rows or ' * (num_rows < rows)}search{more_columns}"
        )


def register_rows(grey: Tensor, timing: RowTiming, options: RegistrationOptions) -> OffsetCurve:
    """``register_bands`` of grey frames (B, T, H, W) in row order; the result has axes (x, y) in row order."""
    check_choice("registration", options.registration, tuple(BAND_METHODS))
    band_rows = options.band_rows
    batch, num_frames, num_rows, width = grey.shape
    timing.check_rows(num_rows)
    check_frame_size(num_rows, width, options)
    tops = torch.arange(0, num_rows - band_rows + 1, options.band_step, device=grey.device)
    advance, bytes_of_frame = steps(batch * (num_frames - 1), "pairs"), 3 * num_rows * width * grey.element_size()
    parts = [
        _bands_of_pairs(grey[:, pairs.start : pairs.stop + 1], tops, options, advance)
        for pairs in runs(num_frames - 1, at_once(batch * bytes_of_frame, grey.device, cpu_bytes=2**26))
    ]
    offsets, quality = (torch.cat(values, 1) for values in zip(*parts, strict=True))
    rows = tops.to(torch.float64) + 0.5 * (band_rows - 1)
    starts = timing.frame_starts(num_frames, grey.device)[:, None] + rows * timing.row_time
    index = torch.arange(num_frames, device=grey.device)
    return OffsetCurve(
        pairs=torch.stack([index[:-1], index[1:]], dim=-1),
        rows=rows,
        times=starts[:-1],
        later_times=starts[1:],
        offsets=offsets,
        quality=quality,
        heights=(band_rows, band_rows),
    )


def _bands_of_pairs(
    grey: Tensor, tops: Tensor, options: RegistrationOptions, advance: Callable[..., None]
) -> tuple[Tensor, Tensor]:
    """Offsets (B, T - 1, N, 2) of bands with first rows ``tops`` in frames (B, T, H, W), and their quality."""
    band_rows, search = options.band_rows, options.search
    batch, num_frames, _, width = grey.shape
    # a Gaussian of 1 px band-limits the correlation, so that whole-pixel lags determine its peak, and damps noise
    grey = _without_row_means(smoothed(grey, _GAUSSIAN.tolist()))
    first, second = grey[:, :-1].flatten(0, 1), grey[:, 1:].flatten(0, 1)
    # Few pairs at a time: their transforms (2.5 MB each) stay in the cache of a CPU.
    parts = chunks(num_frames - 1, batch * 2**21, grey.device)
    coarse = torch.cat([_coarse_offsets(grey[:, pair.start : pair.stop + 1]) for pair in parts], 1).flatten(0, 1)
    bytes_of_pair = len(tops) * (band_rows + 2 * search) * (width + 2 * search) * grey.element_size() * 4
    # Templates are as wide as the least overlap of pairs that are registered together. Pairs of similar overlap are
    # registered together, so that none affects the others. Pairs that overlap too little are not measured.
    overlap = width - coarse[:, 0].abs() - 2 * template_margin(search)
    coarse = torch.where((overlap < search)[:, None], 0, coarse)
    quarter = 4 * coarse[:, 0].abs() // width
    together = at_once(bytes_of_pair, grey.device, cpu_bytes=2**27)
    offsets = grey.new_full((len(first), len(tops), 2), torch.nan, dtype=torch.float64)
    quality = offsets.new_zeros(offsets.shape[:2])
    for pairs in [part for value in quarter.unique() for part in (quarter == value).nonzero()[:, 0].split(together)]:
        task = BandTask(first[pairs], second[pairs], coarse[pairs], tops, band_rows, search)
        measured, correlation = BAND_METHODS[options.registration](task)
        is_measured = (correlation > 0.1) & (overlap[pairs, None] >= search)  # chance reaches correlations of 0.1
        offsets[pairs] = torch.where(is_measured[..., None], measured, torch.nan).double()
        quality[pairs] = torch.where(is_measured, correlation, 0.0).double()
        advance(len(correlation))
    shape = (batch, num_frames - 1)
    return offsets.unflatten(0, shape), quality.unflatten(0, shape)


def _without_row_means(images: Tensor) -> Tensor:
    """Images less the row means smoothed over 65 rows, so that products of windows keep their digits in float32."""
    course = images.mean(-1)
    size = min(65, (course.shape[-1] - 1) // 2 * 2 + 1)
    padded = functional.pad(course, (size // 2, size // 2), mode="replicate")
    return images - functional.avg_pool1d(padded, size, stride=1)[..., None]


def _coarse_offsets(frames: Tensor) -> Tensor:
    """Offsets (B, T - 1, 2) int64 px, axes (x, y), of frames (B, T, H, W) from those before, to two reduced pixels.

    Frames of 1024 px and more are reduced to 256 px along the longer side, smaller ones by up to 4 to at least 128 px:
    of 448 pairs of photographs of 256 to 900 px as many are wrong as with 256 px, in half the time.

    The phase correlation of the reduced frames gives four candidates, each with its periodic images. The candidate with
    the largest correlation of the overlapping parts is taken, up to shifts of 70 % of the frame.
    """
    height, width = frames.shape[-2:]
    longer = max(height, width)
    factor = max(1, round(longer / 256), min(4, longer // 128))
    whole = frames[..., : height // factor * factor, : width // factor * factor]
    reduced = _standardised(functional.avg_pool2d(whole, factor))
    rows, columns = reduced.shape[-2:]
    dtype, device = reduced.dtype, reduced.device
    windows = (torch.hann_window(size, periodic=False, dtype=dtype, device=device) for size in (rows, columns))
    spectra = torch.fft.rfft2(reduced * torch.outer(*windows).sqrt())
    cross = spectra[:, 1:] * spectra[:, :-1].conj()
    magnitude = cross.abs()
    floor = magnitude.mean((-2, -1), keepdim=True).clamp(min=torch.finfo(magnitude.dtype).tiny)
    surface = torch.fft.irfft2(cross / (magnitude + 0.1 * floor), s=(rows, columns))
    # local maxima within 5 x 5 px, so that neighbours of a peak are not candidates of their own; and no offset
    peaks = torch.where(surface == _largest_around(surface, 2), surface, -torch.inf).flatten(2).topk(4, dim=-1).indices
    places = torch.cat([peaks, torch.zeros_like(peaks[..., :1])], dim=-1)
    y, x = places // columns, places % columns
    candidates_y = torch.cat([y, y - rows], dim=-1).repeat(1, 1, 2)
    candidates_x = torch.cat([x.repeat(1, 1, 2), x.repeat(1, 1, 2) - columns], dim=-1)
    best = _overlap_correlation(reduced, candidates_x, candidates_y).argmax(-1, keepdim=True)
    return factor * torch.cat([candidates_x.gather(-1, best), candidates_y.gather(-1, best)], dim=-1)


def _largest_around(surface: Tensor, reach: int) -> Tensor:
    """Largest values of (..., H, W) within ``reach`` along both axes; by ``max_pool2d``, detection takes 6 % more."""
    for dim, ends in ((-1, [reach] * 2), (-2, [0, 0] + [reach] * 2)):
        padded = functional.pad(surface, ends, value=-torch.inf)
        surface = reduce(torch.maximum, [padded.narrow(dim, lag, surface.shape[dim]) for lag in range(2 * reach + 1)])
    return surface


def _standardised(images: Tensor) -> Tensor:
    """Images (B, T, H, W) less their mean over 31 x 31 px (light, vignetting, shading), with unit variance."""
    size = min(31, (min(images.shape[-2:]) - 1) // 2 * 2 + 1)
    mean = functional.pad(images, [size // 2] * 4, mode="reflect")
    for dim, left in ((-1, (1, 0)), (-2, (0, 0, 1, 0))):  # running sums
        total = functional.pad(mean.cumsum(dim), left)
        count = total.shape[dim] - size
        mean = (total.narrow(dim, size, count) - total.narrow(dim, 0, count)) / size
    detail = images - mean
    scale = detail.square().mean((-2, -1), keepdim=True).sqrt()
    return detail / scale.clamp(min=torch.finfo(scale.dtype).tiny)


def _overlap_correlation(images: Tensor, shift_x: Tensor, shift_y: Tensor) -> Tensor:
    """Correlation (B, T - 1, C) of frames with the next ones moved back, over their overlap; -1 if it is below 30 %."""
    rows, columns = images.shape[-2:]
    size = [fast_length(2 * length) for length in (rows, columns)]  # no shift is periodic
    spectra = torch.fft.rfft2(images, s=size)
    products = torch.fft.irfft2(spectra[:, 1:] * spectra[:, :-1].conj(), s=size).flatten(2)
    product = products.gather(-1, shift_y % size[0] * size[1] + shift_x % size[1])
    # sums over the overlap, from running sums
    tables = torch.stack([images, images.square()], 2).cumsum(-1).cumsum(-2)
    tables = functional.pad(tables, (1, 0, 1, 0)).flatten(3)  # (B, T, 2, (H + 1) (W + 1))

    def overlap(sum_tables: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Sums (B, T - 1, 2, C) over the part of images that is still inside after a shift."""
        left, right = (-x).clamp(min=0), (columns - x).clamp(max=columns)
        top, bottom = (-y).clamp(min=0), (rows - y).clamp(max=rows)
        corners = [row * (columns + 1) + column for row in (bottom, top) for column in (right, left)]
        values = [sum_tables.gather(-1, corner[:, :, None].expand(-1, -1, 2, -1)) for corner in corners]
        return values[0] - values[1] - values[2] + values[3]

    first, second = overlap(tables[:, :-1], shift_x, shift_y), overlap(tables[:, 1:], -shift_x, -shift_y)
    pixels = (rows - shift_y.abs()).clamp(min=0) * (columns - shift_x.abs()).clamp(min=0)
    total = pixels.clamp(min=1)
    energy = (first[:, :, 1] - first[:, :, 0].square() / total) * (second[:, :, 1] - second[:, :, 0].square() / total)
    correlation = (product - first[:, :, 0] * second[:, :, 0] / total) * energy.clamp(min=1e-30).rsqrt()
    share = total / (rows * columns)
    # the larger of two overlaps that correlate equally well is preferred
    return torch.where(share >= 0.3, correlation * share**0.25, -torch.ones_like(correlation))
