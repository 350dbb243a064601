from dataclasses import replace
from functools import partial

import pytest
import torch
from refusals import refuses

from rsvib_torch import SensorTiming
from rsvib_torch.motion.timing import RowTiming

SECONDS = {"row_time": 20e-6, "exposure_time": 1 / 500, "frame_rate": 30}
GOOD = {"row_time": 20.52e-6, "exposure_rows": 20, "frame_rows": 2048}


def test_times():
    timing = SensorTiming(**GOOD)
    assert timing.exposure_time == pytest.approx(410.4e-6)
    assert timing.frame_period == pytest.approx(42.02496e-3)
    assert timing.frame_rate == pytest.approx(23.79538, abs=1e-5)
    starts = timing.row_starts(3, 100)
    assert starts.shape == (3, 100)
    assert starts.dtype == torch.float64
    for p, i in ((0, 0), (1, 0), (2, 99)):
        assert starts[p, i].item() == pytest.approx((p * 2048 + i) * 20.52e-6, rel=1e-12)


def test_frame_start_times():
    for times in ([0.0, 0.05, 0.2], torch.tensor([0.0, 0.05, 0.2], dtype=torch.float64)):
        timing = SensorTiming(**GOOD, frame_start_times=times)
        assert timing.frame_starts(2).tolist() == [0.0, 0.05]
        assert timing.row_starts(3, 4)[2].tolist() == pytest.approx([0.2 + i * 20.52e-6 for i in range(4)])
        refuses(partial(timing.frame_starts, 4), "frame_start_times has 3 entries for 4 frames")


@pytest.mark.parametrize(("given", "kept"), [(-2, -2), ("y", -2), (-1, -1), ("x", -1)])
def test_scan_axis_names(given, kept):
    timing = SensorTiming(**GOOD, scan_axis=given, readout_direction="reverse")
    assert timing.scan_axis == kept
    in_rows = timing.in_row_order()
    assert (in_rows.scan_axis, in_rows.readout_direction) == (-2, "forward")
    assert in_rows.frame_period == timing.frame_period


def test_row_timing_is_in_row_order():
    timing = SensorTiming(**GOOD, frame_start_times=[0.0, 0.05])
    rows = timing.in_row_order()
    assert isinstance(rows, RowTiming)
    assert rows == rows.in_row_order() == RowTiming(**GOOD, frame_start_times=(0.0, 0.05))
    assert replace(rows, frame_rows=3000).frame_rows == 3000
    for image_order in ({"scan_axis": "x"}, {"readout_direction": "reverse"}):
        assert SensorTiming(**GOOD, **image_order).in_row_order() == RowTiming(**GOOD)


def test_timing_in_seconds_is_that_in_rows():
    seconds = SensorTiming.from_seconds(**SECONDS, scan_axis="x")
    assert (seconds.exposure_rows, seconds.frame_rows, seconds.scan_axis) == (100, pytest.approx(5000 / 3), -1)
