"""Detection and restoration by other libraries, for comparison with the package: OpenCV, SciPy, scikit-image.

Bands are registered by ``cv2.matchTemplate`` with a parabola, and the offsets of each axis are fitted by
``scipy.optimize.curve_fit`` with Eqs. (4), (6)-(8) of Liu et al. 2023: a sine of amplitude A, frequency f and phase φ
averaged over an exposure T_e, between frames m T_row apart. The fit starts from the best frequency of a grid. Frames
are unwarped with OpenCV, or deconvolved with scikit-image row by row.
"""

import math
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from benchmarks.independent_camera import Array
from numpy.typing import NDArray
from scipy.optimize import curve_fit
from skimage.restoration import wiener
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.imaging import rows_showing

BAND_ROWS, BAND_STEP = 32, 16
SEARCH = 16  # px
_LEAST_BANDS = 8
_LOWEST_GAIN = 0.2  # smallest gain of a frequency of the grid
_LARGEST = 32.0  # px of amplitude
_OUTLIER = 0.1  # px; scale of the robust loss
_GRID_STEP = 0.25  # of the frequency resolution
Frame = NDArray[np.float32]
HALF_ROWS = 16  # of the slab that a row is deconvolved in
SAMPLED_ROWS = 32
BALANCES = (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1)  # of skimage.restoration.wiener


def _between(before: float, at: float, after: float) -> float:
    """Position of the maximum of the parabola through three values, between -1/2 and 1/2."""
    bend = before - 2.0 * at + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


def by_match_template(frames: NDArray[np.float32], tops: Sequence[int], band_rows: int) -> Array:
    """``cv2.matchTemplate`` (normalised correlation), and a parabola through its peak along either axis.

    Offsets (N, 2) are (x, y) in px, the displacement in the later frame minus that in the earlier one; NaN for a
    failed band.
    """
    offsets = []
    for top in tops:
        first = max(0, top - SEARCH)
        template = np.ascontiguousarray(frames[0, top : top + band_rows, SEARCH:-SEARCH])
        window = frames[1, first : top + band_rows + SEARCH]
        score = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
        y, x = np.unravel_index(int(score.argmax()), score.shape)
        if not (0 < x < score.shape[1] - 1 and 0 < y < score.shape[0] - 1):
            offsets.append((np.nan, np.nan))  # the maximum may be outside
            continue
        fine_x = _between(*score[y, x - 1 : x + 2].tolist())
        fine_y = _between(*score[y - 1 : y + 2, x].tolist())
        offsets.append((x + fine_x - SEARCH, y + fine_y + first - top))
    return np.array(offsets, dtype=float)


def offset_model(timing: rsv.SensorTiming) -> Callable[..., Array]:
    """The offset in px at times in s of a vibration (amplitude, frequency, phase) and a uniform motion in px/s."""
    period, exposure = timing.frame_period, timing.exposure_time

    def offset(times: Array, amplitude: float, frequency: float, phase: float, motion: float) -> Array:
        gain = 2 * np.sin(np.pi * frequency * period) * np.sinc(frequency * exposure)
        middle = times + 0.5 * exposure + 0.5 * period
        return amplitude * gain * np.cos(2 * np.pi * frequency * middle + phase) + motion * period

    return offset


def start_values(times: Array, offsets: Array, timing: rsv.SensorTiming) -> list[float]:
    """Amplitude, frequency, phase and motion of the best frequency of a grid, each fitted linearly."""
    period, exposure = timing.frame_period, timing.exposure_time
    resolution = 1.0 / (times[-1] - times[0])
    highest = 0.5 / (BAND_STEP * timing.row_time) / 4
    best, values = np.inf, [1.0, resolution, 0.0, 0.0]
    for frequency in np.arange(0.5 * resolution, highest, _GRID_STEP * resolution):
        gain = 2 * np.sin(np.pi * frequency * period) * np.sinc(frequency * exposure)
        if abs(gain) < _LOWEST_GAIN:
            continue
        angle = 2 * np.pi * frequency * (times + 0.5 * exposure + 0.5 * period)
        basis = np.stack([np.cos(angle), -np.sin(angle), np.ones_like(angle)], axis=1)
        (c, s, constant), *_ = np.linalg.lstsq(basis, offsets, rcond=None)
        wrong = float(np.square(basis @ (c, s, constant) - offsets).sum())
        amplitude = float(np.hypot(c, s) / abs(gain))
        if wrong < best and amplitude < _LARGEST:
            phase = float(np.arctan2(s / gain, c / gain))
            best, values = wrong, [amplitude, float(frequency), phase, float(constant / period)]
    return values


def fit_axis(times: Array, offsets: Array, timing: rsv.SensorTiming) -> Array:
    """Amplitude in px, frequency in Hz, phase in rad and motion in px/s of one axis; NaN if the fit failed."""
    known = np.isfinite(offsets)
    if known.sum() < _LEAST_BANDS:
        return np.full(4, np.nan)
    times, offsets = times[known], offsets[known]
    start = start_values(times, offsets, timing)
    limits = ([0.0, 0.0, -np.inf, -np.inf], [_LARGEST, np.inf, np.inf, np.inf])
    scale = [1.0, 0.1 * start[1], 1.0, 1.0 / timing.frame_period]
    try:
        found, _ = curve_fit(
            offset_model(timing),
            times,
            offsets,
            p0=start,
            bounds=limits,
            x_scale=scale,
            loss="soft_l1",
            f_scale=_OUTLIER,
            max_nfev=200,
        )
    except RuntimeError:  # no convergence
        return np.array(start)
    return np.asarray(found, dtype=float)


def detect_by_libraries(frames: NDArray[np.float32], timing: rsv.SensorTiming) -> rsv.Vibration:
    """The vibration of a pair of frames (2, H, W)."""
    tops = list(range(0, frames.shape[1] - BAND_ROWS + 1, BAND_STEP))
    offsets = by_match_template(frames, tops, BAND_ROWS)
    times = (np.array(tops) + 0.5 * (BAND_ROWS - 1)) * timing.row_time
    values = np.stack([fit_axis(times, offsets[:, axis], timing) for axis in range(2)], axis=1)
    amplitude, frequency, phase, _ = torch.from_numpy(np.nan_to_num(values))  # the constant models the image motion
    return rsv.Vibration(amplitude, frequency, phase)


def kernel_of_row(vibration: rsv.Vibration, start: float, timing: rsv.SensorTiming, moved: int) -> Array:
    """The centred kernel of a row whose exposure begins at ``start`` in s, by bilinear spreading (Eqs. 26-39).

    The slab around the row is ``moved`` by some rows.
    """
    count = int(np.ceil(timing.exposure_rows))
    times = start + (np.arange(count) + 0.5) / count * timing.exposure_time
    tone = vibration.amplitude, vibration.frequency, vibration.phase
    amplitude, frequency, phase = (values[:, 0].numpy() for values in tone)
    x, y = amplitude[:, None] * np.sin(2 * np.pi * frequency[:, None] * times + phase[:, None])
    y = y - moved
    half = [int(np.floor(np.abs(values).max())) + 1 for values in (y, x)]
    kernel = np.zeros((2 * half[0] + 1, 2 * half[1] + 1))
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    for down in (0, 1):
        for right in (0, 1):
            weight = np.abs(1 - down - (y - top)) * np.abs(1 - right - (x - left))
            np.add.at(kernel, (top + half[0] + down, left + half[1] + right), weight / count)
    return kernel


def rows_and_displacements(
    scene_rows: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration, index: int = 0
) -> tuple[Tensor, Tensor]:
    """Rows of frame ``index`` in which rows of the scene appear, and their mean displacements (N, 2)."""
    start = timing.frame_starts(index + 1)[index]
    shown_by, _ = rows_showing(scene_rows.double(), start, timing, truth)
    return shown_by, truth.mean_displacement(start + shown_by * timing.row_time, timing.exposure_time)


def remap_lanczos(frame: Frame, timing: rsv.SensorTiming, truth: rsv.Vibration, index: int = 0) -> Tensor:
    """Unwarp with the mean displacement of every row, by Lanczos-4."""
    height, width = frame.shape
    shown_by, mean = rows_and_displacements(torch.arange(height), timing, truth, index)
    map_x = (np.arange(width)[None] + mean[:, :1].numpy()).astype(np.float32)
    map_y = np.broadcast_to(shown_by[:, None].numpy().astype(np.float32), map_x.shape)
    fetched = cv2.remap(frame, map_x, np.ascontiguousarray(map_y), cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    return torch.from_numpy(fetched)


def sampled_rows(height: int, rim: int) -> Tensor:
    """Random rows of a frame whose slabs are inside the frame."""
    safe = rim + HALF_ROWS
    generator = torch.Generator().manual_seed(0)
    return (torch.randperm(height - 2 * safe, generator=generator)[:SAMPLED_ROWS] + safe).sort().values


def slabs_and_kernels(
    frame: Frame, scene_rows: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration, index: int
) -> list[tuple[Frame, NDArray[np.float64]]]:
    """The slab of rows of frame ``index`` around each row of the scene, and its kernel (Secs. 3.1 and 3.2)."""
    shown_by, _ = rows_and_displacements(scene_rows, timing, truth, index)
    starts = (timing.frame_starts(index + 1)[index] + shown_by * timing.row_time).tolist()
    middles = shown_by.round().long()
    moved = (middles - scene_rows).tolist()
    return [
        (frame[middle - HALF_ROWS : middle + HALF_ROWS + 1], kernel_of_row(truth, start, timing, rows))
        for middle, start, rows in zip(middles.tolist(), starts, moved, strict=True)
    ]


def wiener_loop(pairs: list[tuple[Frame, NDArray[np.float64]]], balance: float) -> NDArray[np.float32]:
    """Middle rows of slabs deconvolved one after another."""
    return np.stack([wiener(slab, kernel, balance, clip=False)[HALF_ROWS] for slab, kernel in pairs])


def wiener_rows(
    frame: Frame, timing: rsv.SensorTiming, truth: rsv.Vibration, still: Tensor, rim: int, index: int = 0
) -> float:
    """PSNR in dB of random rows that are restored one by one, with the balance of the highest PSNR."""
    sampled = sampled_rows(len(frame), rim)
    pairs = slabs_and_kernels(frame, sampled, timing, truth, index)
    scene = still[sampled][:, rim:-rim].numpy()
    errors = [float(np.square(wiener_loop(pairs, balance)[:, rim:-rim] - scene).mean()) for balance in BALANCES]
    finite = [error for error in errors if math.isfinite(error)]
    if not finite:
        raise ValueError("wiener: no balance gives finite values")
    return -10 * math.log10(min(finite))
