"""Sampling maps of restored frames: the position in the recorded frame for every pixel, for compositing programs."""

import math
import os
from collections.abc import Iterator
from pathlib import Path

import tifffile
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.validation import Count
from rsvib_torch.checks.values import check_single
from rsvib_torch.files.atomic import whole_folder
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import StmapConvention
from rsvib_torch.restoration.frame_motion import recorded_places

Size = tuple[Count, Count]  # (height, width) of the frames in px


def num_rows_of(motion: Motion, timing: SensorTiming, size: Size) -> int:
    """Number of rows, along the scan axis, of frames of a size."""
    check_single("motion", motion)
    rows = size[int(timing.scan_axis)]
    timing.check_rows(rows)
    return int(rows)


@checks_arguments
def sampling_map(motion: Motion, timing: SensorTiming, size: Size, num_frames: Count) -> Tensor:
    """Position in the recorded frame that shows each pixel of the restored frame.

    The pixel at s of the restored frame shows the scene at ``s - shift``, which the recorded frame shows at
    ``r = s - shift + D``, where D is the mean displacement over the exposure of the row at r (Eq. 2), with roll, zoom
    and camera that of the pixel. The shift is that of ``restore``: the displacement by a uniform image motion at the
    middle of the frame, in whole px; zero without image motion. Sampling a frame at these positions is
    ``restore(method="dewarp")``.

    Args:
        motion: One motion, in image axes.
        timing: The sensor.
        size: (height, width) of the frames.
        num_frames: Number of frames T.

    Returns:
        (T, H, W, 2) float64 px, (x, y) from the centre of the first pixel, as ``cv2.remap`` uses them. Positions
        outside of the frame were not recorded.

    Example:
        >>> from rsvib_torch import SensorTiming, Vibration
        >>> timing = SensorTiming(row_time=1e-4, exposure_rows=1, frame_rows=100)
        >>> positions = sampling_map(Vibration((2.0, 0.0), (100.0, 0.0)), timing, (80, 60), num_frames=1)
        >>> x, y = positions[0, 25, 30].tolist()  # row 25 is exposed after 2.5 ms, a quarter of a period
        >>> round(x, 2), y
        (32.0, 25.0)
    """
    return torch.stack(list(_maps(motion, timing, size, num_frames)))


def _maps(motion: Motion, timing: SensorTiming, size: tuple[int, int], num_frames: int) -> Iterator[Tensor]:
    """Positions (H, W, 2) for each frame."""
    num_rows_of(motion, timing, size)
    for places, _ in recorded_places(motion, timing, size, num_frames):
        yield torch.from_numpy(places).movedim(0, -1)


@checks_arguments
def write_stmap(
    folder: str | os.PathLike[str],
    motion: Motion,
    timing: SensorTiming,
    size: Size,
    num_frames: Count,
    *,
    convention: StmapConvention = "nuke",
) -> list[Path]:
    """Write the ``sampling_map`` of every frame as a float32 TIFF with three channels: an STMap.

    The first two channels are the position (x, y) in px of ``sampling_map``, counted from the centre of the first
    pixel, in one of two conventions:

    * ``"nuke"``: ``((x + 0.5) / width, (height - 0.5 - y) / height)``: red is 0 at the left and 1 at the right edge of
      the recorded frame, green 0 at its bottom and 1 at its top; a map that changes nothing has
      ``(0.5 / width, 1 - 0.5 / height)`` in its top left pixel. This is what the STMap node of Nuke samples. Load the
      files as raw data, without a colour space.
    * ``"opencv"``: (x, y) themselves, the maps of ``cv2.remap``.

    The third channel is 1 where the position lies in the recorded frame, else 0. In float32 the positions are rounded
    by at most 2.5e-4 px in frames of 8192 px; a TIFF of 16 bits would round them by up to 0.06 px.

    Args:
        folder: Folder for ``stmap_0000.tif``, ``stmap_0001.tif`` ...; it is created, files of these names are replaced.
        motion: One motion, in image axes.
        timing: The sensor.
        size: (height, width) of the frames.
        num_frames: Number of frames.
        convention: ``"nuke"`` or ``"opencv"``.

    Returns:
        The files.

    Example:
        >>> import tempfile
        >>> from rsvib_torch import SensorTiming, Vibration
        >>> timing = SensorTiming(row_time=1e-4, exposure_rows=1, frame_rows=100)
        >>> vibration = Vibration((2.0, 0.0), (100.0, 0.0))
        >>> files = write_stmap(tempfile.mkdtemp(), vibration, timing, (80, 60), 1, convention="opencv")
        >>> import cv2, numpy as np
        >>> map_x, map_y, inside = cv2.split(tifffile.imread(files[0]))
        >>> frame = np.tile(np.arange(60, dtype=np.float32), (80, 1))
        >>> round(float(cv2.remap(frame, map_x, map_y, cv2.INTER_LINEAR)[25, 30]), 2)  # a quarter of a period: X = 2 px
        32.0
    """
    digits, (height, width) = max(4, math.ceil(math.log10(num_frames + 1))), size
    names = []
    with whole_folder(folder) as part:
        for frame, positions in enumerate(_maps(motion, timing, size, num_frames)):
            x, y = positions.unbind(-1)
            inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
            if convention == "nuke":
                x, y = (x + 0.5) / width, (height - 0.5 - y) / height
            names.append(f"stmap_{frame:0{digits}d}.tif")
            channels = torch.stack([x, y, inside.to(x)], -1).to(torch.float32).cpu().numpy()
            tifffile.imwrite(part / names[-1], channels, photometric="rgb")
    return [Path(folder, name) for name in names]
