"""A program of a user for the type checker, which reports an ignored error that it does not find; it is never run."""

from typing import assert_type

from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.imaging.trajectory import rows_showing
from rsvib_torch.io import StackInfo

timing = rsv.SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
info: StackInfo = rsv.read_stack_info("frames.tif")
frames, still = rsv.read_stack("frames.tif"), rsv.Vibration.still()
assert_type(rsv.restore(frames, timing, still), Tensor)
rsv.evaluation.cramer_rao_bound  # noqa: B018
rsv.restor  # type: ignore[attr-defined] # noqa: B018

# Options are known from the fields of their groups.
rsv.detect_vibration(frames, timing=timing, tones=2).vibration  # noqa: B018
rsv.detect_motion(frames, timing, knot_rows=20).motion  # noqa: B018
rsv.restore(frames, timing, still, half_rows="x")  # type: ignore[arg-type]
rsv.restore(frames, timing, still, method="magic")  # type: ignore[arg-type]
rsv.register_bands(frames, timing, band_row=3)  # type: ignore[call-arg]
rsv.VibrationTracker(timing, window=4.5)  # type: ignore[arg-type]
rsv.detect_motion(frames, timing, tones=2)  # type: ignore[call-arg]

# Functions of rows require a timing in row order.
row, start = frames[0, :, 0], frames[0, 0, 0]
rows_showing(row, start, timing.in_row_order(), still)
rows_showing(row, start, timing, still)  # type: ignore[arg-type]
