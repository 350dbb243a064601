"""What all exports of a motion share."""

from rsvib_torch.checks.validation import Count
from rsvib_torch.checks.values import check_single
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming

Size = tuple[Count, Count]  # (height, width) of the frames in px


def num_rows_of(motion: Motion, timing: SensorTiming, size: Size) -> int:
    """Number of rows, along the scan axis, of frames of a size."""
    check_single("motion", motion)
    rows = size[int(timing.scan_axis)]
    timing.check_rows(rows)
    return int(rows)
