"""Spectrogram of the displacement along both axes, from the offsets of rows between frames."""

import math
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rsvib_torch.checks.values import check_number, needed_package
from rsvib_torch.detection.spectrum import BLIND_GAIN, Offsets
from rsvib_torch.files.atomic import whole
from rsvib_torch.io.zarr_store import consolidate
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array
from rsvib_torch.report.plots import plain_axes, save_figure
from rsvib_torch.tracking import TrackedFrame

_LEAST_OFFSETS = 8
_LINES_OF_COLUMN = 5  # per axis; each takes 5 ms in a column of 0.5 s


class Spectrogram:
    """Amplitude of the displacement over time and frequency.

    Every column is the amplitude spectrum of the offsets of its frames, as in ``DetectionResult.spectrum``: gain and
    exposure are taken out, and lines have no ghosts at multiples of the frame rate beside them. Frequencies at which
    the response is nearly zero (blind) are NaN.

    Args:
        timing: The sensor.
        duration: s, length of a column; the resolution in frequency is its inverse.
        max_frequency: Hz.
        max_columns: Number of columns that are kept; then two become one, so that the memory is bounded.

    Attributes:
        frequencies: (F,) Hz.
    """

    def __init__(
        self, timing: SensorTiming, duration: float = 0.5, max_frequency: float = 250.0, max_columns: int = 4096
    ) -> None:
        self._timing = timing
        self._duration = check_number("duration", duration, at_least=2 * timing.frame_period)
        highest = check_number("max_frequency", max_frequency, above=1.5 / duration)
        self.frequencies = np.arange(2, 1 + math.floor(2 * duration * highest)) / (2 * duration)
        self._max_columns = max_columns
        self._columns: list[tuple[float, NDArray[np.float32]]] = []
        self._parts: list[tuple[Array, Array, Array]] = []  # mid-exposures (N, 2), offsets and weights (N, 2) of frames
        self._start: float | None = None

    def add(self, tracked: TrackedFrame) -> None:
        """Add the offsets of a frame."""
        record = tracked.measurements
        if record is None:
            return
        if self._start is None:
            self._start = tracked.time
        elif tracked.time - self._start >= self._duration:
            self._finish(tracked.time)
        middles = record.exposure_starts[0] + (0.5 * record.exposure_time + tracked.time - self._start)
        offsets = record.displacements[0, :, 1] - record.displacements[0, :, 0]
        weights = record.weights[0] * (record.num_differences[0] > 0)[:, None]
        used = (weights > 0).all(-1)
        self._parts.append((middles[used], offsets[used], weights[used]))

    def _finish(self, time: float) -> None:
        """Complete a column; the next one begins at ``time``."""
        assert self._start is not None
        if sum(len(offsets) for _, offsets, _ in self._parts) >= _LEAST_OFFSETS:
            middles, offsets, weights = map(np.concatenate, zip(*self._parts, strict=True))
            earlier, later = middles.T - 0.5 * (middles.min() + middles.max())
            span, column = float(np.ptp(middles)), []
            for axis in range(2):
                of_axis = offsets[:, axis], weights[:, axis]
                record = Offsets(earlier, later, *of_axis, self._timing.exposure_time, 0.0)
                amplitude, _, _, response = record.spectrum(self.frequencies, span, np.zeros((0, 2)), _LINES_OF_COLUMN)
                column.append(np.where(response < BLIND_GAIN * response.max(), np.nan, amplitude))
            self._columns.append((self._start, np.stack(column).astype(np.float32)))
        self._parts, self._start = [], time
        if len(self._columns) > self._max_columns:
            pairs = zip(self._columns[::2], self._columns[1::2], strict=False)
            self._columns = [(one[0], np.fmax(one[1], other[1])) for one, other in pairs]
            self._duration *= 2

    def result(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]:
        """Times (T,) in s of the beginnings of the columns, frequencies (F,) in Hz, amplitudes (2, T, F) in px.

        Axes are (x, y) of the image. The last, incomplete column is left out, unless it is the only one.
        """
        if self._parts and not self._columns:
            self._finish(math.inf)
        times = np.array([time for time, _ in self._columns])
        empty = np.zeros((2, 0, len(self.frequencies)), np.float32)
        amplitude = np.stack([part for _, part in self._columns], 1) if self._columns else empty
        if self._timing.scan_axis == -1:
            amplitude = amplitude[::-1]
        return times, self.frequencies, np.ascontiguousarray(amplitude)


def save_spectrogram(path: Path, spectrogram: Spectrogram) -> list[Path]:
    """Write ``PATH.png`` and ``PATH.zarr`` (group with ``amplitude`` (2, T, F) in px, ``time``, ``frequency``)."""
    zarr = needed_package("zarr", "writing Zarr", "formats")
    times, frequencies, amplitude = spectrogram.result()
    if len(times) == 0:
        raise ValueError("no offsets were measured: there is no spectrogram")
    figure = Figure(figsize=(9, 6), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    top = float(np.nanmax(amplitude))
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    for panel, values, name in zip(panels, amplitude, "xy", strict=True):
        image = panel.pcolormesh(
            np.append(times, times[-1] + step),
            np.append(frequencies, 2 * frequencies[-1] - frequencies[-2]),
            np.maximum(values.T, 3e-3 * top),
            norm=LogNorm(3e-3 * top, top),
            cmap="viridis",
            rasterized=True,
        )
        plain_axes(panel)
        panel.set_ylabel(f"frequency along {name} (Hz)")
    panels[-1].set_xlabel("time (s)")
    figure.colorbar(image, ax=panels, label="amplitude (px)")
    picture, folder = path.with_name(path.name + ".png"), path.with_name(path.name + ".zarr")
    save_figure(figure, picture)
    with whole(folder, "tree") as part:
        group = zarr.open_group(store=str(part), mode="w", zarr_format=3)
        units = {"amplitude": "px", "time": "s", "frequency": "Hz"}
        arrays = {"amplitude": amplitude, "time": times, "frequency": frequencies}
        dimensions = {"amplitude": ["axis", "time", "frequency"]}  # axes (x, y)
        for name, values in arrays.items():
            names, unit = dimensions.get(name, [name]), {"units": units[name]}
            group.create_array(name, data=values, dimension_names=names, attributes=unit)
        consolidate(part)
    return [picture, folder]
