"""A colour video from file to file: frames per second, processor time by part of the work, and PSNR after encoding.

The frames come from benchmarks/independent_camera.py, as planes Y, U and V of a 4:2:0 video: chroma has the motion of
half the amplitude in rows that last twice as long. One second of frames is repeated.
"""

import argparse
import functools
import importlib
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from benchmarks.independent_camera import Array, Shake, closed, take_frames
from benchmarks.live import AMPLITUDE, FREQUENCY, PHASE, RATE, timing_of
from harness import Rows, table
from numpy.typing import NDArray

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields
from rsvib_torch.stacks import process_video

OPTIONS = {
    "video_frames": (300, "video: frames"),
    "video_rows": (1080, "video: rows, 16:9"),
}
QUICK = {"video_frames": 12, "video_rows": 180}
MARGIN, SEED, NOISE = 32, 3, 0.004
EXPOSURE_ROWS = 15
CRF = "12"  # of the clip
METHODS = ("exact", "dewarp")
GOALS = {"exact": 0.6, "dewarp": 0.16}  # s of a processor per frame: 3 and 12 frames/s on two cores
# s of a processor per frame of 1920 x 1080 px in colour, before videos were followed: `rsvib run --video`, 24 frames of
# a photograph, 2026-11-25
BEFORE = {"exact": 3.68, "dewarp": 0.98}
# Parts of the work: functions whose processor time is measured, without that of the others within them.
PARTS: dict[str, list[tuple[str, str]]] = {
    "motion": [
        ("rsvib_torch.registration.corners", "CornerFollower.next"),
        ("rsvib_torch.tracking.camera_path", "fit_window"),
    ],
    "restoration": [
        ("rsvib_torch.stacks.video_frames", "restore_prepared"),
        ("rsvib_torch.stacks.video_frames", "prepare_frames"),
        ("rsvib_torch.stacks.video_frames", "source_map"),
        ("rsvib_torch.stacks.video_frames", "moved_back"),
    ],
    "conversion of counts": [
        ("rsvib_torch.stacks.video_frames", "counts_to_frames"),
        ("rsvib_torch.stacks.video_frames", "frames_to_counts"),
        ("rsvib_torch.stacks.video_frames", "FrameLayout.frame"),
    ],
    "verdict": [("rsvib_torch.stacks.process_video", "VideoPasses.verdict")],
    "joining parts, checksums": [
        ("rsvib_torch.stacks.process_video", "_Encoder.close"),
        ("rsvib_torch.stacks.process_video", "_Encoder.finish_part"),
    ],
}
CODECS = "decoding, encoding and the rest"


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
        taken = take_frames(closed(scene, MARGIN // 2), shake, chroma, min(count, RATE), size, between=4)
        noisy = taken + NOISE / step * np.random.default_rng(SEED + number).standard_normal(taken.shape)
        low, high = (16, 235) if step == 1 else (16, 240)
        counts.append(np.clip(np.round(low + (high - low) * noisy), 0, 255).astype(np.uint8))
        still.append((low + (high - low) * scene[MARGIN:-MARGIN, MARGIN:-MARGIN]) / 255)
    return counts, still


def write_clip(path: Path, planes: list[NDArray[np.uint8]], count: int) -> None:
    """Write a video of ``count`` frames, H.264."""
    luma, *chroma = planes
    height, width = luma.shape[1:]
    with av.open(str(path), "w") as output:
        stream: Any = output.add_stream("libx264", rate=RATE, options={"crf": CRF, "preset": "veryfast"})
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        stream.codec_context.colorspace, stream.codec_context.color_range = 1, 1  # BT.709, limited
        for index in range(count):
            rows = [luma[index % len(luma)], *(plane[index % len(luma)].reshape(-1, width) for plane in chroma)]
            frame = av.VideoFrame.from_ndarray(np.concatenate(rows), format="yuv420p")
            frame.pts, frame.time_base = index, Fraction(1, RATE)
            output.mux(stream.encode(frame))
        output.mux(stream.encode())


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


@contextmanager
def processor_times(parts: dict[str, list[tuple[str, str]]]) -> Iterator[Counter[str]]:
    """Seconds of a processor in the functions of each part, in all threads of this program."""
    spent: Counter[str] = Counter()
    local, replaced = threading.local(), []

    def measured(function: Callable[..., Any], part: str) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*arguments: Any, **options: Any) -> Any:
            within: list[float] = local.__dict__.setdefault("within", [])
            within.append(0.0)
            begin = time.thread_time()
            try:
                return function(*arguments, **options)
            finally:
                seconds = time.thread_time() - begin
                spent[part] += seconds - within.pop()
                if within:
                    within[-1] += seconds

        return call

    for part, functions in parts.items():
        for module, name in functions:
            *owners, last = name.split(".")
            owner = functools.reduce(getattr, owners, importlib.import_module(module))
            replaced.append((owner, last, getattr(owner, last)))
            setattr(owner, last, measured(getattr(owner, last), part))
    try:
        yield spent
    finally:
        for owner, name, function in reversed(replaced):
            setattr(owner, name, function)


def rows(options: argparse.Namespace) -> Rows:
    """Figures of each method, and of the video as taken."""
    count = options.video_frames
    planes, still = planes_of(options.video_rows, count)
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clip.mp4"
        write_clip(clip, planes, count)
        results: list[dict[str, Any]] = [
            {"name": "as taken", "psnr": psnr_of(clip, still), "size": clip.stat().st_size}
        ]
        for method in METHODS:
            target = Path(folder) / f"{method}.mp4"
            begin, cpu = time.perf_counter(), time.process_time()
            with processor_times(PARTS) as spent:
                process_video(
                    clip, target, timing_of(options.video_rows, EXPOSURE_ROWS), restoration={"method": method}
                )
            used, seconds = time.process_time() - cpu, time.perf_counter() - begin
            results.append(
                {
                    "name": method,
                    "rate": count / seconds,
                    "cpu": used / count,
                    "parts": {**{part: spent[part] / used for part in PARTS}, CODECS: 1 - sum(spent.values()) / used},
                    "psnr": psnr_of(target, still),
                    "size": target.stat().st_size,
                }
            )
    return results


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The tables in Markdown."""
    taken, *methods = results
    height, count = options.video_rows, options.video_frames
    text = [
        f"{count} frames of {16 * height // 9} x {height} px in colour, H.264 (crf {CRF}), by `process_video` (`rsvib "
        "run --video` without figures and the start of the program). Frames per second depend on other programs of the "
        "machine, processor time much less. The figures before are those of windows of eight frames, on 24 frames of a "
        "photograph of 1920 x 1080 px.",
        "",
    ]
    lines_of_methods = []
    for row in [taken, *methods]:
        timed = [""] * 4
        if "cpu" in row:
            goal = GOALS[row["name"]]
            met = "met" if row["cpu"] <= goal else "**missed**"
            timed = [f"{row['cpu']:.3f}", f"{goal} ({met})", f"{BEFORE[row['name']]:.2f}", f"{row['rate']:.1f}"]
        rate = row["size"] / 1e6 / count * RATE
        lines_of_methods.append((row["name"], *timed, *(f"{value:.1f}" for value in row["psnr"]), f"{rate:.1f}"))
    heads = ("method", "processor s per frame", "goal", "before", "frames/s", "PSNR of Y (dB)", "PSNR of U, V (dB)")
    shares = [(name, *(f"{row['parts'][name]:.0%}" for row in methods)) for name in methods[0]["parts"]]
    text += [*table((*heads, "MB per s"), lines_of_methods), "Shares of the processor time:", ""]
    return text + table(("part", *(row["name"] for row in methods)), shares)
