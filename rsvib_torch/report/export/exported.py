"""What all exports of a motion share."""

from rsvib_torch.core.validation import Count
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming

Size = tuple[Count, Count]  # (height, width) of the frames in px


def num_rows_of(motion: Motion, timing: SensorTiming, size: Size) -> int:
    """Number of rows, along the scan axis, of frames of a size.

    Raises:
        ValueError: If the motion is a batch (a file holds one), or the frame period is shorter than the readout.
    """
    if motion.batch_shape:
        raise ValueError(f"motion is a batch of shape {tuple(motion.batch_shape)}; export one of them: motion[0]")
    rows = size[int(timing.scan_axis)]
    timing.check_rows(rows)
    return int(rows)
