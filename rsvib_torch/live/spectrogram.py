"""Spectrogram of the displacement along both axes, from the offsets of rows between frames."""

import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.core.atomic import whole_folder
from rsvib_torch.core.checks import check_number
from rsvib_torch.core.tables import tensor
from rsvib_torch.io.stack_format import needed_package
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.report.plots import plain_axes, save_figure
from rsvib_torch.tracking import TrackedFrame


class Spectrogram:
    """Amplitude of the displacement over time and frequency.

    For every frequency f, one tone is fitted to the offsets y between frames (weights w) of each column of the
    spectrogram, ``C = sum w conj(h) y / sum w |h|^2`` with the response h of Eq. (4): gain and exposure are taken out.
    Frequencies at which the response is nearly zero (blind) are NaN.

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
        highest = check_number("max_frequency", max_frequency, above=1 / duration)
        self.frequencies = torch.arange(1, 1 + math.floor(2 * duration * highest), dtype=torch.float64) / (2 * duration)
        self._max_columns = max_columns
        self._columns: list[tuple[float, Tensor]] = []
        self._sums: list[Tensor] = []
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
        middles = tensor(record.exposure_starts[0]) + (
            0.5 * record.exposure_time + tracked.time - self._start
        )  # (N, 2)
        offsets = tensor(record.displacements[0, :, 1] - record.displacements[0, :, 0])  # (N, 2)
        # Hann window: less leakage of strong tones into other frequencies
        window = (
            math.sin(math.pi * (tracked.time - self._start + 0.5 * self._timing.frame_period) / self._duration) ** 2
        )
        weights = window * tensor(record.weights[0] * (record.num_differences[0] > 0)[:, None])
        # the mean is image motion
        mean = (weights * offsets).sum(0) / weights.sum(0).clamp(min=1e-300)
        angle = 2 * math.pi * self.frequencies[:, None] * middles[:, 0]
        wave = torch.complex(angle.cos(), angle.sin())  # (F, N)
        turn = 2j * math.pi * self.frequencies * (middles[:, 1] - middles[:, 0]).mean()
        response = torch.sinc(self.frequencies * record.exposure_time) * (turn.exp() - 1)
        right = (wave.conj() @ (weights * (offsets - mean)).to(wave.dtype)) * response.conj()[:, None]
        # real offsets: a tone of amplitude A contributes A / 2 at f and at -f
        normal = 0.5 * weights.sum(0) * response.abs().square()[:, None]
        parts = [right, normal]
        self._sums = parts if not self._sums else [total + part for total, part in zip(self._sums, parts, strict=True)]

    def _finish(self, time: float) -> None:
        """Complete a column; the next one begins at ``time``."""
        assert self._start is not None
        if self._sums:
            right, normal = self._sums
            blind = normal < 0.01 * normal.amax(0)  # gain below a tenth of the largest one
            amplitude = torch.where(blind, torch.nan, (right / normal).abs())
            self._columns.append((self._start, amplitude.T.float()))
        self._sums, self._start = [], time
        if len(self._columns) > self._max_columns:
            pairs = zip(self._columns[::2], self._columns[1::2], strict=False)
            self._columns = [(one[0], torch.fmax(one[1], other[1])) for one, other in pairs]
            self._duration *= 2

    def result(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]:
        """Times (T,) in s of the beginnings of the columns, frequencies (F,) in Hz, amplitudes (2, T, F) in px.

        Axes are (x, y) of the image. The last, incomplete column is left out, unless it is the only one.
        """
        if self._sums and not self._columns:
            self._finish(math.inf)
        times = np.array([time for time, _ in self._columns])
        empty = np.zeros((2, 0, len(self.frequencies)), np.float32)
        amplitude = np.stack([part.numpy() for _, part in self._columns], 1) if self._columns else empty
        if self._timing.scan_axis == -1:
            amplitude = amplitude[::-1]
        return times, self.frequencies.numpy(), np.ascontiguousarray(amplitude)


def save_spectrogram(path: Path, spectrogram: Spectrogram) -> list[Path]:
    """Write ``PATH.png`` and ``PATH.zarr`` (group with ``amplitude`` (2, T, F) in px, ``time``, ``frequency``).

    Returns:
        The files.
    """
    from matplotlib.colors import LogNorm  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

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
    with whole_folder(folder) as part:
        group = zarr.open_group(store=str(part), mode="w", zarr_format=3)
        units = {"amplitude": "px", "time": "s", "frequency": "Hz"}
        arrays = {"amplitude": amplitude, "time": times, "frequency": frequencies}
        for name, values in arrays.items():
            array = group.create_array(name, data=values)
            array.attrs["unit"] = units[name]
        group["amplitude"].attrs["axes"] = ["axis (x, y)", "time", "frequency"]
    return [picture, folder]
