"""Checks that all exports of a motion share."""

from rsvib_torch.core.checks import check_whole_number
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming


def check_exportable(motion: Motion) -> None:
    """Raise a ``ValueError`` for a batch of motions: a file holds one."""
    if motion.batch_shape:
        raise ValueError(f"motion is a batch of shape {tuple(motion.batch_shape)}; export one of them: motion[0]")


def num_rows_of(timing: SensorTiming, size: tuple[int, int]) -> int:
    """Number of rows, along the scan axis, of frames of ``size`` (height, width).

    Raises:
        ValueError: If the size is not two positive numbers, or the frame period is shorter than the readout.
    """
    if len(size) != 2:
        raise ValueError(f"size must be (height, width), got {size}")
    for name, count in zip(("height", "width"), size, strict=True):
        check_whole_number(f"{name} in size", count, at_least=1)
    rows = size[int(timing.scan_axis)]
    timing.check_rows(rows)
    return int(rows)
