"""A colour video from file to file: frames per second, processor time, and PSNR after encoding.

The frames come from benchmarks/independent_camera.py, as planes Y, U and V of a 4:2:0 video: chroma has the motion of
half the amplitude in rows that last twice as long. One second of frames is repeated.
"""

import argparse
import tempfile
import time
from pathlib import Path

import av
import numpy as np
from benchmarks.independent_camera import Array, Shake, closed, take_frames
from benchmarks.live import AMPLITUDE, FREQUENCY, PHASE, RATE, timing_of
from harness import Rows, table_of, write_h264
from numpy.typing import NDArray

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.video import process_video

OPTIONS = {"video_frames": (300, "video: frames"), "video_rows": (1080, "video: rows, 16:9")}
QUICK = {"video_frames": 12, "video_rows": 180}
MARGIN, SEED, NOISE = 32, 3, 0.004
EXPOSURE_ROWS = 15
CRF = "12"  # of the clip
METHODS = ("exact", "dewarp")


def planes_of(rows: int, count: int) -> tuple[list[NDArray[np.uint8]], list[Array]]:
    """Counts (T, H, W) of Y, U and V, and their scenes at rest, full scale 1."""
    timing, counts, still = timing_of(rows, EXPOSURE_ROWS), [], []
    for number, step in enumerate((1, 2, 2)):
        size = (rows // step, 16 * rows // 9 // step)
        scene = city_and_fields(size[0] + 2 * MARGIN, size[1] + 2 * MARGIN, seed=SEED + number).double().numpy()
        if step == 2:  # colours of the middle of the range
            scene = 0.5 + 0.3 * (scene - scene.mean())
        # rows of chroma lie between two rows of luma
        later = 2 * np.pi * FREQUENCY * 0.5 * (step - 1) * timing.row_time
        shake = Shake(AMPLITUDE[:, None] / step, FREQUENCY[:, None], (PHASE + later)[:, None], np.zeros(2))
        chroma = rsv.SensorTiming(step * timing.row_time, EXPOSURE_ROWS / step, timing.frame_rows / step)
        taken = take_frames(closed(scene, MARGIN // 2), shake, chroma, min(count, RATE), size)
        noisy = taken + NOISE / step * np.random.default_rng(SEED + number).standard_normal(taken.shape)
        low, high = (16, 235) if step == 1 else (16, 240)
        counts.append(np.clip(np.round(low + (high - low) * noisy), 0, 255).astype(np.uint8))
        still.append((low + (high - low) * scene[MARGIN:-MARGIN, MARGIN:-MARGIN]) / 255)
    return counts, still


def psnr_of(path: Path, still: list[Array], rim: int = 24) -> list[float]:
    """PSNR of Y and of U with V in dB, over all frames of a video."""
    errors: list[list[float]] = [[], []]
    with av.open(str(path)) as video:
        for frame in video.decode(video=0):
            planes, height = frame.to_ndarray(), frame.height
            chroma = planes[height:].reshape(2, height // 2, frame.width // 2)
            for number, plane in enumerate((planes[:height], *chroma)):
                error = (plane / 255 - still[number])[rim:-rim, rim:-rim]
                errors[min(number, 1)].append(float(np.mean(error**2)))
    return [float(-10 * np.log10(np.mean(values))) for values in errors]


def rows(options: argparse.Namespace) -> Rows:
    count = options.video_frames
    planes, still = planes_of(options.video_rows, count)
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clip.mp4"
        luma, *chroma = planes
        width = luma.shape[-1]
        pictures = [np.concatenate([luma[i], *(one[i].reshape(-1, width) for one in chroma)]) for i in range(len(luma))]
        repeated = (pictures[index % len(pictures)] for index in range(count))
        write_h264(clip, repeated, RATE, crf=CRF, preset="veryfast")
        results: Rows = [{"name": "as taken", "psnr": psnr_of(clip, still), "size": clip.stat().st_size}]
        for method in METHODS:
            target = Path(folder) / f"{method}.mp4"
            begin, cpu = time.perf_counter(), time.process_time()
            timing = timing_of(options.video_rows, EXPOSURE_ROWS)
            process_video(clip, target, timing, restoration={"method": method})
            used, seconds = time.process_time() - cpu, time.perf_counter() - begin
            speed = {"rate": count / seconds, "cpu": used / count}
            size = target.stat().st_size
            results.append({"name": method, **speed, "psnr": psnr_of(target, still), "size": size})
    return results


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    height, count = options.video_rows, options.video_frames
    text = [
        f"{count} frames of {16 * height // 9} x {height} px in colour, H.264 (crf {CRF}), by `process_video` (`rsvib "
        "run --video` without figures and the start of the program). Frames per second depend on other programs of the "
        "machine, processor time much less.",
        "",
    ]
    return text + table_of(
        results,
        ("method", "{name}"),
        ("processor s per frame", lambda row: f"{row['cpu']:.3f}" if "cpu" in row else ""),
        ("frames/s", lambda row: f"{row['rate']:.1f}" if "rate" in row else ""),
        ("PSNR of Y (dB)", "{psnr[0]:.1f}"),
        ("PSNR of U, V (dB)", "{psnr[1]:.1f}"),
        ("MB per s", lambda row: f"{row['size'] / 1e6 / count * RATE:.1f}"),
    )
