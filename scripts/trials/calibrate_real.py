#!/usr/bin/env python
"""Calibration on published recordings: frames of a 1000 Hz LED, and a strobe at two exposures.

The recordings are not part of this project. FOLDER holds gyroflow_rollingshutter/frame_example.png (of
github.com/gyroflow/rollingshutter, readout 15.730 +- 0.004 ms published) and hearv_strobe/rolling0.png, rolling1.png
(of github.com/jia-kai/hearv, exposures 1/1000 and 1/4000 s, 16 to 18.3 us published).
"""

import argparse
import sys
from pathlib import Path

import torch

import rsvib_torch as rsv

LED = "gyroflow_rollingshutter/frame_example.png"
STROBE = ("hearv_strobe/rolling0.png", "hearv_strobe/rolling1.png")
PUBLISHED, PUBLISHED_ERROR = 15.730, 0.004  # ms


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    missing = [name for name in (LED, *STROBE) if not (folder / name).is_file()]
    if missing:
        print(f"{folder}: {', '.join(missing)} not there", file=sys.stderr)
        return 2
    frame = rsv.read_stack(folder / LED)
    rows = frame.shape[-2]
    found = rsv.calibrate_row_time(frame, 1000.0, on_fraction=0.5, gamma=2.2)
    plain = rsv.calibrate_row_time(frame, 1000.0)
    print(f"LED: {1e6 * plain.row_time:.4f} +- {1e6 * plain.row_time_std:.4f} us a row")
    for count, name in ((rows - 1, "from the first row to the last"), (rows, "of all rows")):
        readout = 1e3 * plain.row_time * count
        apart = 100 * (readout / PUBLISHED - 1)
        print(f"     readout {name}: {readout:.4f} ms, {apart:+.3f} % from {PUBLISHED} +- {PUBLISHED_ERROR} ms")
    print(f"     exposure 1/{1 / (found.exposure_time or 1):.0f} s, taking gamma 2.2 and a square wave")
    strobe = torch.cat([rsv.read_stack(folder / name) for name in STROBE])
    found = rsv.calibrate_row_time_by_exposure(strobe, [1 / 1000, 1 / 4000])
    print(f"strobe: {1e6 * found.row_time:.2f} +- {1e6 * found.row_time_std:.2f} us a row (published: 16 to 18.3 us)")
    still = strobe.new_full((1, 256, 256), 0.5) + 0.05 * torch.rand(1, 256, 256)
    try:
        rsv.calibrate_row_time(still, 1000.0)
    except ValueError as error:
        print(f"no flicker: refused ({error})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
