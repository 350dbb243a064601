"""Restoration with the true vibration: PSNR and time of all methods and of other software, over scenes and noise.

Peers: unwarping by ``cv2.remap`` (Lanczos-4), and a loop of ``skimage.restoration.wiener`` over the rows, whose balance
has the highest PSNR of several values; the package estimates its parameters from the frames. Frames come from a camera
made without the package.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch
from benchmarks.independent_camera import Shake, closed, take_frames
from benchmarks.restoration_peers import Peer, remap_lanczos, wiener_rows
from harness import Rows, table
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields, resolution_chart
from rsvib_torch.restoration.restore import METHODS

SCENES: dict[str, Callable[[int, int, int], Tensor]] = {
    "city": city_and_fields,
    "chart": lambda height, width, seed: resolution_chart(height, width, seed=seed),
}
OPTIONS = {
    "grid_size": (512, "frame side where quality is compared"),
    "exposures": ((20, 100, 400), "exposures in row times"),
    "noises": ((0.0, 0.005, 0.02), "noise levels of full scale"),
    "scenes": (tuple(SCENES), "drawn scenes to compare on", SCENES),
}
QUICK = {"grid_size": 128, "exposures": (20,), "noises": (0.005,), "scenes": ("city",)}
SEED = 7
RIM, MARGIN, FADE = 32, 48, 24  # px
AMPLITUDE, FREQUENCY = (3.1, 5.2), (50.0, 30.0)
FULL_ROWS = 2048  # of the paper's camera
RESTORED_BY: dict[str, tuple[int, dict[str, Any]]] = {  # number of frames, and options of restore
    **{name: (1, {"method": name}) for name in METHODS},
    "exact, 2 frames jointly": (2, {"joint": True}),
    'exact, prior="edges"': (1, {"prior": "edges"}),
    '2 frames jointly, prior="edges"': (2, {"joint": True, "prior": "edges"}),
}


def camera(exposure: float, num_rows: int = FULL_ROWS) -> rsv.SensorTiming:
    """The paper's camera; fewer rows are slower, so that frame period and exposure time are unchanged."""
    slower = FULL_ROWS / num_rows
    return rsv.SensorTiming(row_time=20.52e-6 * slower, exposure_rows=exposure / slower, frame_rows=num_rows)


def vibration() -> rsv.Vibration:
    """The paper's vibration with random phases."""
    generator = torch.Generator().manual_seed(SEED)
    phase = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * math.pi
    return rsv.Vibration(AMPLITUDE, FREQUENCY, phase)


def recordings(
    options: argparse.Namespace, size: tuple[int, int], num_rows: int = FULL_ROWS
) -> Iterator[tuple[dict[str, Any], Tensor, Tensor, rsv.SensorTiming]]:
    """Scene, exposure and noise of every case, its two frames, the scene at rest, and the timing."""
    for name in options.scenes:
        scene = SCENES[name](size[0] + 2 * MARGIN, size[1] + 2 * MARGIN, SEED)
        still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
        for exposure in options.exposures:
            timing = camera(exposure, num_rows)
            taken = take_frames(closed(scene.double().numpy(), FADE), Shake.of(vibration()), timing, 2, size)
            clean = torch.from_numpy(taken).float()
            for noise in options.noises:
                frames = rsv.SensorNoise(read_noise=noise).apply(clean, torch.Generator().manual_seed(SEED))
                yield {"scene": name, "exposure_rows": exposure, "noise": noise}, frames, still, timing


def quality(figure: Peer, still: Tensor) -> float:
    """PSNR in dB without the border."""
    rows = list(range(RIM, len(still) - RIM)) if figure.rows is None else figure.rows
    restored = figure.restored[RIM:-RIM] if figure.rows is None else figure.restored
    return float(rsv.psnr(restored[:, RIM:-RIM], still[rows, RIM:-RIM], 1.0))


def restored_first_frame(frames: Tensor, timing: rsv.SensorTiming, still: Tensor) -> Iterator[tuple[str, Peer]]:
    """The first frame as taken and restored by every method; the package uses only frames, timing and vibration."""
    yield "raw", Peer(frames[0], 0.0)
    for name, (count, chosen) in RESTORED_BY.items():
        begin = time.perf_counter()
        restored = rsv.restore(frames[:count], timing, vibration(), check=False, **chosen)
        yield name, Peer(restored[0], time.perf_counter() - begin)
    array = frames[0].numpy()
    yield "cv2.remap, Lanczos-4", remap_lanczos(array, timing, vibration())
    yield "skimage wiener, row loop", wiener_rows(array, timing, vibration(), still, RIM)


def rows(options: argparse.Namespace) -> Rows:
    """PSNR and seconds of every method in every case."""
    size = (options.grid_size, options.grid_size)
    return [
        {**case, "method": name, "psnr_db": quality(figure, still), "seconds": figure.seconds}
        for case, frames, still, timing in recordings(options, size)
        for name, figure in restored_first_frame(frames, timing, still)
    ]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """A table for each scene and exposure."""
    text = [
        f"PSNR in dB without a border of {RIM} px, frames of {options.grid_size} x {options.grid_size} px, true "
        "vibration given; seconds with the last noise. The best value of each column has a star. The row loop of "
        "skimage processes a sample of the rows: its time is scaled to all rows, its PSNR is that of the sample.",
        "",
    ]
    tables: dict[tuple[str, int], dict[str, Rows]] = {}
    for row in results:
        of_case = tables.setdefault((row["scene"], row["exposure_rows"]), {})
        of_case.setdefault(row["method"], []).append(row)
    for (scene, exposure), methods in tables.items():
        best = [max(row["psnr_db"] for row in column) for column in zip(*methods.values(), strict=True)]
        cells = []
        for name, of_method in methods.items():
            pairs = zip((row["psnr_db"] for row in of_method), best, strict=True)
            values = (f"{value:.2f}{'*' if value == most else ''}" for value, most in pairs)
            cells.append((name, *values, f"{of_method[-1]['seconds']:.2f}"))
        heads = (f"{scene}, exposure of {exposure} rows", *(f"noise {noise}" for noise in options.noises), "seconds")
        text += table(heads, cells)
    return text
