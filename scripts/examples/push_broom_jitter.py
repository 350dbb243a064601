#!/usr/bin/env python
"""Jitter of a push-broom satellite from the parallax of its sensor lines.

The lines of a push-broom sensor see the same ground one after another. Registered to the ground, their images are
frames with the same row time, whose start times differ by the delays of the lines. Two lines are blind to jitter at
multiples of the inverse of their delay; a third line with another delay is not. The jitter along the lines of this
example has such a frequency. Printed: the jitter detected with two and with three lines, and the accuracy of the
restored image.
"""

import argparse
import warnings
from collections.abc import Sequence

import torch
from rich import box
from rich.console import Console
from rich.table import Table

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

LINE_TIME = 1e-4  # s
DELAYS = (0.0, 73 * LINE_TIME, 200 * LINE_TIME)  # s; delay of each line
JITTER = rsv.Vibration(amplitude=[0.9, 1.3], frequency=[1 / DELAYS[1], 41.0], phase=[0.4, 1.3])
MARGIN, RIM = 24, 24  # px of ground beyond the images; px of the images that are not evaluated
NOISE = 0.004  # of full scale


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, nargs=2, default=(900, 256), metavar=("H", "W"), help="size of the images")
    parser.add_argument("--seed", type=int, default=1, help="seed of ground and noise")
    options = parser.parse_args(arguments)
    size = tuple(options.size)
    generator = torch.Generator().manual_seed(options.seed)
    ground = city_and_fields(size[0] + 2 * MARGIN, size[1] + 2 * MARGIN, options.seed)
    timing = rsv.SensorTiming(LINE_TIME, 4, size[0], frame_start_times=DELAYS)
    noise = rsv.SensorNoise(read_noise=NOISE)
    images = rsv.simulate_frames(ground, timing, JITTER, len(DELAYS), frame_size=size, noise=noise, generator=generator)
    still = ground[MARGIN:-MARGIN, MARGIN:-MARGIN]

    def quality(image: torch.Tensor) -> float:
        inside = (..., slice(RIM, -RIM), slice(RIM, -RIM))
        return float(rsv.psnr(image[inside], still.expand_as(image)[inside], 1.0).mean())

    table = Table("", "along the lines (x)", "across (y)", "PSNR", box=box.SIMPLE_HEAD)
    table.add_row("truth", *(_tone(JITTER, axis) for axis in range(2)), f"{quality(images[:1]):.1f} dB input")
    for count in (2, 3):
        lines = rsv.SensorTiming(LINE_TIME, 4, size[0], frame_start_times=DELAYS[:count])
        found = rsv.detect_vibration(images[:count], lines)
        cells = [
            _tone(found.vibration, axis) if found.reliable[axis] else f"refused: {found.reasons[axis][0]}"
            for axis in range(2)
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rsv.RestorationWarning)  # the table contains the verdict
            restored = rsv.restore(images[:count], lines, found, joint=True, check=False)
        table.add_row(f"{count} lines", *cells, f"{quality(restored):.1f} dB restored")
    Console(highlight=False, width=140).print(table)


def _tone(vibration: rsv.Vibration, axis: int) -> str:
    amplitude, frequency = vibration.amplitude[axis, 0].item(), vibration.frequency[axis, 0].item()
    return f"{amplitude:.3f} px at {frequency:.2f} Hz"


if __name__ == "__main__":
    main()
