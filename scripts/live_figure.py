#!/usr/bin/env python
"""Draw docs/live.png: a tone that sweeps and grows, as the tracker follows it, and its spectrogram."""

from pathlib import Path

import numpy as np
from benchmarks.live import BEFORE, EXPOSURE_ROWS, FREQUENCY, RATE, Changing, frames_of, timing_of
from matplotlib import pyplot as plt

import rsvib_torch as rsv
from rsvib_torch.live import Spectrogram

SIZE, COUNT = 256, 90
MOTION = Changing(sweep=2.0, doublings=0.5)
FIGURE = Path(__file__).parents[1] / "docs" / "live.png"
COLOURS = ("#14487a", "#c8102e")


def main() -> None:
    timing = timing_of(SIZE)
    middle = 0.5 * (SIZE - 1 + EXPOSURE_ROWS) * timing.row_time
    tracker, spectrogram = rsv.VibrationTracker(timing), Spectrogram(timing, 0.4, 120.0)
    times, values, stds = [], [], []
    for frame in frames_of(SIZE, MOTION, COUNT):
        tracked = tracker.update(frame)
        spectrogram.add(tracked)
        found = tracked.detection
        if found is None:
            continue
        times.append(tracked.time + middle)
        values.append([found.vibration.frequency[:, 0].tolist(), found.vibration.amplitude[:, 0].tolist()])
        stds.append([found.std.frequency[:, 0].tolist(), found.std.amplitude[:, 0].tolist()])
    when, found_values, found_stds = np.array(times), np.array(values), np.array(stds)
    truth = MOTION.frequency(when), MOTION.amplitude(when)
    figure, panels = plt.subplots(
        2, 3, figsize=(13, 5.6), layout="constrained", sharex="col", width_ratios=(1, 1, 1.15)
    )
    for place, unit in enumerate(("frequency (Hz)", "amplitude (px)")):
        for axis, name in enumerate("xy"):
            start = truth[place][axis, 0]
            panels[place, 0].plot(when, truth[place][axis] - start, color="#8a8a8a", linewidth=3, alpha=0.6)
            panels[place, 0].plot(when, found_values[:, place, axis] - start, color=COLOURS[axis], label=name)
            error = found_values[:, place, axis] - truth[place][axis]
            panels[place, 1].plot(when, error, color=COLOURS[axis])
            deviation = 2 * found_stds[:, place, axis]
            panels[place, 1].fill_between(when, -deviation, deviation, color=COLOURS[axis], alpha=0.15, linewidth=0)
        panels[place, 0].set_ylabel(f"change of the {unit}")
        panels[place, 1].set_ylabel(f"error of the {unit}")
    limit = 3 * float(np.quantile(np.abs(found_values[:, 0, 0] - truth[0][0]), 0.8))
    panels[0, 1].set_ylim(-limit, limit)
    panels[1, 1].set_ylim(-0.12, 0.12)
    panels[0, 0].legend(frameon=False)
    columns, frequencies, amplitude = spectrogram.result()
    for panel, picture, name in zip(panels[:, 2], amplitude, "xy", strict=True):
        step = columns[1] - columns[0]
        image = panel.pcolormesh(
            np.append(columns, columns[-1] + step),
            np.append(frequencies, 2 * frequencies[-1] - frequencies[-2]),
            picture.T,
            vmin=0,
            cmap="viridis",
            rasterized=True,
        )
        panel.set_ylabel(f"frequency along {name} (Hz)")
        figure.colorbar(image, ax=panel, label="amplitude (px)")
    for panel in panels[:, :2].flat:
        panel.axvline(BEFORE, color="#d9d9d9", linewidth=1, zorder=0)
        panel.spines[["top", "right"]].set_visible(False)
    for panel in panels[1]:
        panel.set_xlabel("time (s)")
    figure.suptitle(
        f"{FREQUENCY[0]:.0f} Hz along x, swept by {MOTION.sweep:g} Hz/s and grown by "
        f"{100 * (2**MOTION.doublings - 1):.0f} % per second from {BEFORE} s on; {RATE} frames/s (grey: truth)",
        fontsize=10,
    )
    figure.savefig(FIGURE, dpi=100)


if __name__ == "__main__":
    main()
