"""A small vibrating stack, simulated by the independent camera of tests/truth.py, and its processing."""

import h5py
import numpy as np
import tifffile
from scipy import ndimage
from truth import Motion, crop, take_frames

from rsvib_torch import SensorTiming, process_stack

HEIGHT, WIDTH, FRAMES = 96, 64, 17
TIMING = SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=104)
MOTION = Motion(amplitude=(1.2, 0.8), frequency=(130.0, 170.0), phase=(0.3, 0.9))
OPTIONS = {
    "window": 3,
    "detection": {"method": "bands", "band_rows": 16, "band_step": 8, "search": 6, "tones": 1},
    "restoration": {"method": "dewarp"},
    "workers": 1,
}
WINDOWS = 8
CAMERA = """
[sensor]
row_time = 1e-4
exposure_rows = 6
frame_rows = 104
full_scale = 4095

[detection]
method = "bands"
band_rows = 16
band_step = 8
search = 6
tones = 1

[restoration]
method = "dewarp"
"""
CONFIG = f"""{CAMERA}
[stack]
window = 3
"""
_TEXTURE = ndimage.gaussian_filter(np.random.default_rng(4).standard_normal((HEIGHT + 80, WIDTH + 80)), 1.1)
SCENE = np.clip(0.5 + 0.15 * _TEXTURE / _TEXTURE.std(), 0.0, 1.0)
STILL = crop(SCENE)


def draw_counts(frames=FRAMES):
    taken = take_frames(SCENE, TIMING, MOTION, frames, noise=0.002, seed=1)
    return np.clip(np.round(taken * 4095), 0, 4095).astype(np.uint16)


def write_small(path, frames=FRAMES):
    """Write the stack as a TIFF file without metadata, like another program."""
    tifffile.imwrite(path, draw_counts(frames), photometric="minisblack", metadata=None)


def write_with_gaps(folder, kept, start=0.0):
    """Write the kept frames of the stack as big-endian counts that state their times."""
    times = [start + index * TIMING.frame_period for index in kept]
    with h5py.File(folder / "frames.h5", "w") as file:
        file["frames"] = draw_counts(max(kept) + 1)[list(kept)].astype(">u2")
        file["frames"].attrs.update(full_scale=4095, frame_times=times)
    return times


def stop_after(frames):
    """A function of the progress of a run that interrupts it."""

    def stop(done, total):
        if done > frames:
            raise KeyboardInterrupt

    return stop


def process_small(source, sink, **options):
    return process_stack(source, sink, TIMING, full_scale=4095, **{**OPTIONS, **options})
