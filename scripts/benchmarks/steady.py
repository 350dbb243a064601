"""Hand-held clips made steady: shaking before and after, beside the stabiliser vidstab of FFmpeg where it is installed.

The clips come from a camera of their own: a photograph (or a drawn scene) is moved row by row by the rates of a
gyroscope in a hand (or a drawn path), with tones of vibration, nearer content on a part of the area, and a subject that
moves; then compressed (H.264, 2.5 Mb/s). The figures are measured apart from the package, by corners in neighbouring
frames and one similarity transform for each pair.
"""

import argparse
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from harness import Rows, table, write_h264
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.video import process_video

Array = NDArray[np.float64]
Frames = list[NDArray[np.uint8]]

OPTIONS = {
    "steady_frames": (112, "steady: frames of a clip"),
    "steady_photo": ("", "steady: photograph to move, a file that OpenCV reads; without, a drawn scene"),
    "steady_rates": ("", "steady: CSV of time (s) and rates (rad/s) about x, y, z; without, a drawn path"),
}
QUICK = {"steady_frames": 24}
WIDTH, HEIGHT, RATE, FOCAL, SAMPLES = 640, 360, 30, 520.0, 4  # px, px, Hz, px, of an exposure
ROW_TIME, EXPOSURE = 55e-6, 4e-3  # s
RIM = 0.1  # of the sides, which are not compared


@dataclass(frozen=True)
class Clip:
    """How a clip is taken."""

    name: str
    hand: float  # factor of the rates
    order: tuple[int, int, int] = (0, 1, 2)  # of the axes of the rates
    tones: tuple[tuple[int, float, float, float], ...] = ()  # axis, px, Hz, rad
    parallax: float = 0.0  # px, amplitude of nearer content on 40 % of the area; a subject moves on 15 %
    decay: float = 0.0  # 1/s, by which the tones decay
    sweep: float = 0.0  # Hz/s, by which the frequencies of the tones change
    pan: float = 0.0  # px, by which the camera turns within half a second, there and back


CLIPS = (
    Clip("hand", 0.7),
    Clip("hand, tones of 93 and 61 Hz", 0.4, (1, 0, 2), ((0, 1.2, 93.0, 0.3), (1, 0.8, 61.0, 1.0))),
    Clip("tones of 71 and 110 Hz", 0.02, (0, 1, 2), ((1, 1.5, 110.0, 1.0), (0, 2.0, 71.0, 0.0))),
    Clip("hand, tones, parallax, subject", 1.0, (0, 1, 2), ((0, 0.9, 137.0, 0.3), (1, 1.7, 47.0, 1.0)), 6.0),
    Clip("fast hand, blind tone, parallax, subject", 1.5, (1, 0, 2), ((1, 1.7, 210.0, 1.0),), 4.0),
    Clip("tones that decay with 0.8 s", 0.7, (0, 1, 2), ((0, 3.0, 71.0, 0.3), (1, 2.0, 98.0, 1.0)), decay=1 / 0.8),
    Clip("tones that sweep by 24 Hz/s", 0.7, (0, 1, 2), ((0, 1.5, 60.0, 0.3), (1, 0.8, 80.0, 1.0)), sweep=24.0),
    Clip("fast pan, tone of 66 Hz", 0.7, (0, 1, 2), ((1, 1.2, 66.0, 1.0),), pan=320.0),
)


def scene_of(photo: str) -> NDArray[np.float32]:
    """The scene (H, W) in counts, 1400 px wide."""
    image = cv2.imread(photo, cv2.IMREAD_UNCHANGED) if photo else city_and_fields(1400, 1400, seed=7).numpy()
    if image is None:
        raise ValueError(f"{photo} cannot be read")
    grey = image.astype(np.float32) if image.ndim == 2 else image.astype(np.float32).mean(2)
    low, high = np.percentile(grey, (0.5, 99.5))
    scale = 1400 / grey.shape[1]
    counts = np.clip((grey - low) / (high - low), 0, 1) * 230 + 12
    return np.asarray(cv2.resize(counts, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.float32)


def angles_of(rates: str, count: int) -> tuple[Array, Array]:
    """Times (N,) in s and angles (N, 3) in rad of a hand."""
    if rates:
        table_of = np.loadtxt(rates, delimiter=",", skiprows=1)
        times, turning = table_of[:, 0] - table_of[0, 0], table_of[:, 1:4] - table_of[:, 1:4].mean(0)
        return times, cumulative_trapezoid(turning, times, axis=0, initial=0.0)
    rng, times = np.random.default_rng(11), np.arange(0.0, count / RATE + 1.0, 0.002)
    frequencies = np.geomspace(0.3, 18.0, 24)  # Hz; a hand trembles less at higher frequencies
    waves = 2 * np.pi * frequencies * times[:, None, None] + rng.uniform(0, 2 * np.pi, (3, 24))
    return times, (0.012 * frequencies**-1.1 * np.sin(waves)).sum(-1)


def taken(clip: Clip, scene: NDArray[np.float32], hand: tuple[Array, Array], count: int) -> Frames:
    """The frames of a clip."""
    rng = np.random.default_rng(len(clip.name))
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    middle = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    patch = cv2.GaussianBlur(rng.normal(size=(200, 260)).astype(np.float32), (0, 0), 2)
    patch = (patch - patch.min()) / np.ptp(patch) * 220 + 15
    centred = hand[1][:, clip.order] * clip.hand
    centred = centred - centred[np.searchsorted(hand[0], 0.5 * count / RATE)]

    def recorded(t: Array) -> Array:
        pitch, yaw, roll = (np.interp(t, hand[0], centred[:, axis])[:, None] for axis in range(3))
        turned = clip.pan * (np.clip(2 * t - 1, 0, 1) - np.clip(2 * t - 4, 0, 1))
        shift = [FOCAL * yaw + turned[:, None], FOCAL * pitch]
        for axis, size, frequency, phase in clip.tones:
            wave = np.exp(-clip.decay * t) * np.sin(2 * np.pi * (frequency + 0.5 * clip.sweep * t) * t + phase)
            shift[axis] = shift[axis] + size * wave[:, None]

        def sampled(near_x: Any, near_y: Any) -> tuple[Array, Array]:
            u, v = x - middle[0] - shift[0] - near_x, y - middle[1] - shift[1] - near_y
            at_x = (u * np.cos(roll) + v * np.sin(roll) + scene.shape[1] / 2).astype(np.float32)
            at_y = (v * np.cos(roll) - u * np.sin(roll) + scene.shape[0] / 2).astype(np.float32)
            return cv2.remap(scene, at_x, at_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), at_x

        image, _ = sampled(0.0, 0.0)
        if clip.parallax:
            sway = clip.parallax * np.sin(np.pi * t)[:, None], 0.4 * clip.parallax * np.cos(0.8 * np.pi * t)[:, None]
            near, at_x = sampled(*sway)
            image = np.where(at_x - scene.shape[1] / 2 < -0.1 * WIDTH, near, image)
            across, down = x - (0.35 * WIDTH + 60 * t[:, None] + shift[0]), y - (0.3 * HEIGHT + shift[1])
            inside = (across > 0) & (across < 258) & (down > 0) & (down < 133)
            subject = cv2.remap(patch, across.astype(np.float32), down.astype(np.float32), cv2.INTER_LINEAR)
            image = np.where(inside, subject, image)
        return image

    frames = []
    for number in range(count):
        starts = number / RATE + np.arange(HEIGHT) * ROW_TIME
        parts = [recorded(starts + (part + 0.5) / SAMPLES * EXPOSURE) for part in range(SAMPLES)]
        counts = np.mean(parts, 0) + rng.normal(size=(HEIGHT, WIDTH))
        frames.append(np.clip(np.rint(counts), 0, 255).astype(np.uint8))
    return frames


def figures(path: Path) -> dict[str, Any]:
    """PSNR of neighbouring frames (dB), rms change of their shift along x and y, and motion of rows in bands (px)."""
    with av.open(str(path)) as video:
        frames = [frame.to_ndarray(format="gray") for frame in video.decode(video=0)]
    height, width = frames[0].shape
    inner = slice(int(RIM * height), height - int(RIM * height)), slice(int(RIM * width), width - int(RIM * width))
    levels, shifts, bands = [], [], []
    for first, second in pairwise(frames):
        error = np.square(first[inner].astype(float) - second[inner]).mean()
        levels.append(10 * np.log10(255**2 / max(error, 1e-3)))
        start = cv2.goodFeaturesToTrack(first, 400, 0.01, 8)
        end, there, _ = cv2.calcOpticalFlowPyrLK(first, second, start, start.copy(), maxLevel=5)
        back, again, _ = cv2.calcOpticalFlowPyrLK(second, first, end, end.copy(), maxLevel=5)
        good = (there[:, 0] == 1) & (again[:, 0] == 1) & (np.abs(back - start).max((1, 2)) < 0.5)
        before, after = start[good, 0], end[good, 0]
        transform, inliers = cv2.estimateAffinePartial2D(before, after, method=cv2.RANSAC, ransacReprojThreshold=1.0)
        centre = np.array([width / 2, height / 2])
        shifts.append(transform[:, :2] @ centre + transform[:, 2] - centre)
        rest, used = before @ transform[:, :2].T + transform[:, 2] - after, inliers[:, 0] > 0
        part = (before[:, 1] * 12 // height).astype(int)
        parts = [rest[used & (part == number)] for number in range(12)]
        medians = [np.median(of_part, 0) for of_part in parts if len(of_part) > 4]
        bands.append(np.square(medians).mean())
    return {
        "itf": float(np.mean(levels)),
        "shaking": np.sqrt(np.square(np.diff(shifts, axis=0)).mean(0)).tolist(),
        "rows": float(np.sqrt(np.mean(bands))),
        "area": height * width / (HEIGHT * WIDTH),
    }


def with_vidstab(source: Path, target: Path) -> dict[str, Any] | None:
    """The figures of FFmpeg's vidstab with its default options; None without it."""
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        return None
    begin = [ffmpeg, "-hide_banner", "-loglevel", "info", "-y", "-i", str(source)]
    found = target.with_suffix(".trf")
    detect = [*begin, "-vf", f"vidstabdetect=result={found}", "-f", "null", "-"]
    if subprocess.run(detect, check=False, capture_output=True).returncode:  # FFmpeg without vidstab
        return None
    moved = [*begin, "-vf", f"vidstabtransform=input={found}", "-c:v", "libx264", "-crf", "14", str(target)]
    log = subprocess.run(moved, capture_output=True, check=True, text=True).stderr
    zoom = float(log.partition("Final zoom: ")[2].split()[0])  # %
    return {**figures(target), "area": (1 + zoom / 100) ** -2}


def rows(options: argparse.Namespace) -> Rows:
    scene, hand = scene_of(options.steady_photo), angles_of(options.steady_rates, options.steady_frames)
    timing = rsv.SensorTiming(ROW_TIME, EXPOSURE / ROW_TIME, 1 / RATE / ROW_TIME)
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for number, clip in enumerate(CLIPS):
            source = Path(folder) / f"{number}.mp4"
            frames = taken(clip, scene, hand, options.steady_frames)
            grey = (av.VideoFrame.from_ndarray(frame, format="gray") for frame in frames)
            planes = (frame.reformat(format="yuv420p").to_ndarray() for frame in grey)
            write_h264(source, planes, RATE, bit_rate=2_500_000)
            target = source.with_name(f"{number}_steady.mp4")
            process_video(source, target, timing, steady=1.0, border="crop", restoration={"method": "dewarp"})
            vidstab = with_vidstab(source, source.with_name(f"{number}_vidstab.mp4"))
            results.append({"clip": clip.name, "input": figures(source), "vidstab": vidstab, "rsvib": figures(target)})
    return results


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    scene = "a photograph" if options.steady_photo else "a drawn scene"
    hand = "the rates of a gyroscope in a hand" if options.steady_rates else "a drawn path of a hand"
    text = (
        f"{options.steady_frames} frames of {WIDTH} x {HEIGHT} px: {scene}, moved by {hand}; rows of "
        f"{1e6 * ROW_TIME:.0f} us, exposure {1e3 * EXPOSURE:.0f} ms, H.264 of 2.5 Mb/s. ITF: mean PSNR of neighbouring "
        "frames, which blur raises as well. Shaking: rms change of the shift from frame to frame along x and y. Rows: "
        "rms motion of twelfths of the rows beside the frame. Area: part of the frame that remains."
    )
    cells = []
    for row in results:
        for name in ("input", "vidstab", "rsvib"):
            if row[name] is not None:
                of = row[name]
                shaking = ", ".join(f"{value:.2f}" for value in of["shaking"])
                cells.append((row["clip"], name, f"{of['itf']:.1f}", shaking, f"{of['rows']:.3f}", f"{of['area']:.0%}"))
    return [text, "", *table(("clip", "frames", "ITF (dB)", "shaking (px)", "rows (px)", "area"), cells)]
