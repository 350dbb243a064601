"""Angular rates of the camera as a gyroscope log in the format ``.gcsv`` (docs.gyroflow.xyz, GCSV format).

With the attitude as rotation vector w (``Motion.attitude``) and theta = |w|, a gyroscope that is fixed to the camera
measures

    ``omega = dw/dt - (1 - cos theta) / theta^2 w x dw/dt + (theta - sin theta) / theta^3 w x (w x dw/dt)``

(right Jacobian of SO(3)): the attitude is the integral of these rates by composition of rotations.
"""

import os
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from scipy.spatial.transform import Rotation

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import Count, check_single
from rsvib_torch.files.atomic import whole_file
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array

_RATE_STEP = 1e-9  # rad/s, of the integers in the file; 1000 s of equal rounding errors add up to 5e-7 rad
_LOWEST_RATE = 1000.0  # Hz; from here the rate is doubled, so that 1 / rate is a short decimal number
_LARGEST_ERROR = 2e-7  # rad, of the attitude that the trapezoidal rule gives
_MOST_SAMPLES = 5_000_000  # 150 MB of text
_DIRECTIONS = {(-2, "forward"): 0, (-2, "reverse"): 1, (-1, "forward"): 2, (-1, "reverse"): 3}


@checks_arguments
def write_gcsv(
    path: str | os.PathLike[str],
    motion: Motion,
    timing: SensorTiming,
    size: tuple[Count, Count],
    num_frames: Count,
    *,
    sample_rate: Annotated[float, Field(ge=1, le=1e9)] | None = None,
) -> None:
    """Write the angular rates of the camera as ``.gcsv``, the gyroscope log that Gyroflow reads.

    Columns ``gx, gy, gz`` are the rates about the axes of the camera (``Camera``): x to the right, y down, z forward,
    right-handed, in rad/s after multiplication by ``gscale``; the line ``orientation,yxz`` states these axes in terms
    of Gyroflow's (x up, y to the left, z backward). ``t`` times ``tscale`` is the time in seconds since the exposure
    start of the first row of frame 0, even with reverse readout. A sample is the rate at its time, not a mean. The
    attitude at a sample follows from the one before by the rotation ``exp(dt (omega_before + omega) / 2)`` (the
    trapezoidal rule): by default the sample rate is the lowest of 1, 2, 4 ... kHz with which this is within 2e-7 rad
    of ``motion.attitude`` at all times. The first sample lies at or before time 0, where the attitude is
    ``motion.attitude`` of that time; it is not in the file.

    Gyroflow dates a frame at the middle of its readout, so that its synchronisation finds an offset of half of
    ``frame_readout_time`` plus half of the exposure time between this clock and that of the video.

    Args:
        path: The file to write; an existing file is replaced.
        motion: One motion with a camera, in image axes.
        timing: The sensor.
        size: (height, width) of the frames.
        num_frames: Number of frames; the samples cover their exposures.
        sample_rate: Samples per second; by default as stated above.

    Raises:
        ValueError: If the motion has no camera, is a batch, or zooms, which rates do not contain; or if too many
            samples are necessary.

    Example:
        >>> import tempfile
        >>> from rsvib_torch import Camera, SensorTiming, Vibration
        >>> motion = Vibration((2.0, 1.0), (50.0, 80.0), camera=Camera(focal_length=1000.0))
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> path = tempfile.mkdtemp() + "/clip.gcsv"
        >>> write_gcsv(path, motion, timing, (480, 640), num_frames=2, sample_rate=8000.0)
        >>> with open(path) as file:
        ...     lines = file.read().splitlines()
        >>> lines[lines.index("t,gx,gy,gz") + 1]  # 1e-9 rad/s: pitch rate 2 pi 80 / 1000, yaw rate -2 pi 50 2 / 1000
        '0,502654825,-628318531,0'
    """
    check_single("motion", motion.batch_shape)
    rows = int(size[int(timing.scan_axis)])
    timing.check_rows(rows)
    if motion.camera is None:
        raise ValueError(
            "angular rates require the focal length in px: motion.with_camera(Camera(focal_length)), on the command "
            "line --focal-length"
        )
    if motion.num_axes > 3 and bool(motion.moving_axes()[3]):
        raise ValueError("motion has zoom, which angular rates do not contain")
    starts = timing.frame_starts(num_frames)
    first, last = float(starts[0]), float(starts[-1]) + rows * timing.row_time + timing.exposure_time
    rate = sample_rate or _LOWEST_RATE
    index, counts, error = _sampled(motion, first, last, rate)
    while sample_rate is None and error > _LARGEST_ERROR:
        rate *= 2
        index, counts, error = _sampled(motion, first, last, rate)
    header = {
        "version": "1.3",
        "id": "rsvib_torch",
        "orientation": "yxz",
        "note": "rates about x right; y down; z forward",
        "frame_readout_time": f"{1e3 * rows * timing.row_time:.9g}",  # ms
        "frame_readout_direction": str(_DIRECTIONS[int(timing.scan_axis), timing.readout_direction]),
        "tscale": repr(1.0 / rate),
        "gscale": repr(_RATE_STEP),
    }
    lines = ["GYROFLOW IMU LOG", *(f"{name},{value}" for name, value in header.items()), "t,gx,gy,gz"]
    with whole_file(path) as part, part.open("w", encoding="ascii", newline="\n") as file:
        file.write("\n".join(lines) + "\n")
        np.savetxt(file, np.column_stack([index, counts]), fmt="%d", delimiter=",")


def _sampled(motion: Motion, first: float, last: float, rate: float) -> tuple[Array, Array, float]:
    """Sample numbers (N,), rates (N, 3) in steps, and the largest error in rad of attitudes by the trapezoidal rule."""
    index = np.arange(np.floor(first * rate), np.ceil(last * rate) + 1)
    if len(index) > _MOST_SAMPLES:
        raise ValueError(
            f"{len(index):,} samples at {rate:g} Hz, at most {_MOST_SAMPLES:,} are written; export fewer frames, or "
            "pass a lower sample_rate"
        )
    camera = motion.camera
    assert camera is not None  # checked by the caller
    times = torch.from_numpy(index / rate).to(motion.device)
    vector = camera.attitude(motion.displacement(times)).detach().cpu().numpy()
    slope = camera.attitude(motion.velocity(times)).detach().cpu().numpy()  # linear in the components
    counts = np.rint(_body_rates(vector, slope) / _RATE_STEP)
    # attitude by composition: the errors of the single steps, turned into the first axes, add up
    attitude, step = Rotation.from_rotvec(vector), (counts[1:] + counts[:-1]) * (0.5 * _RATE_STEP / rate)
    wrong = (attitude[:-1].inv() * attitude[1:]).inv() * Rotation.from_rotvec(step)
    return index, counts, float(np.linalg.norm(np.cumsum(attitude[1:].apply(wrong.as_rotvec()), 0), axis=1).max())


def _body_rates(vector: Array, slope: Array) -> Array:
    """Rates (N, 3) in axes of the camera for rotation vectors (N, 3) and their derivatives."""
    angle = np.linalg.norm(vector, axis=1)[:, None]
    half = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2  # (1 - cos a) / a^2
    # (a - sin a) / a^3; the series avoids the cancellation of small angles, its next term is a^6 / 362880
    squared = angle**2
    small = 1 / 6 - squared / 120 + squared**2 / 5040
    third = np.where(angle < 0.1, small, (angle - np.sin(angle)) / np.maximum(angle, 0.1) ** 3)
    across = np.cross(vector, slope)
    return slope - half * across + third * np.cross(vector, across)
