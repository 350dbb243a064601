"""Restoration compared with other software: quality over scenes, exposures and noise, and speed.

Peers: unwarping by ``cv2.remap`` (Lanczos-4), loops of ``skimage.restoration.wiener`` and ``richardson_lucy`` over the
rows, CGLS on ``pylops.signalprocessing.NonStationaryConvolve2D`` where pylops is installed (extra ``compare``), and
``deepinv.physics.TiledSpaceVaryingBlur`` with its least-squares solver where deepinv can be imported. Parameters of
peers (balance, damping, iterations) have the highest PSNR of several values; the package estimates its own from the
frames. Frames come from a camera made without the package.
"""

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks.independent_camera import Shake, closed, take_frames
from benchmarks.restoration_peers import LOOPS, Peer, loop_rows, remap_lanczos
from harness import Rows, in_turns, named, shown_seconds, table
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields, resolution_chart
from rsvib_torch.restoration.restore import METHODS

LEFT_OUT: dict[str, str] = {}  # peers that are not available, with the reason
try:
    from benchmarks.pylops_peer import cgls_restore
except ImportError as missing:  # pylops or numba is not installed
    LEFT_OUT["pylops"] = str(missing)
try:
    from benchmarks.deepinv_peer import tiled_restore
except (ImportError, RuntimeError) as missing:  # RuntimeError: its torchvision was built for another torch
    LEFT_OUT["deepinv"] = str(missing)

SCENES: dict[str, Callable[[int, int, int], Tensor]] = {
    "city": city_and_fields,
    "chart": lambda height, width, seed: resolution_chart(height, width, seed=seed),
}
OPTIONS = {
    "grid_size": (512, "frame side where quality is compared"),
    "exposures": ((20, 100, 400), "exposures in row times"),
    "noises": ((0.0, 0.005, 0.02), "noise levels of full scale"),
    "scenes": (tuple(SCENES), "drawn scenes to compare on", SCENES),
    "images": ((), "image files as further scenes", Path),
    "no_pylops": (False, "without pylops, which takes minutes"),
    "no_deepinv": (False, "without deepinv, which takes minutes"),
}
QUICK = {"grid_size": 128, "exposures": (20,), "noises": (0.005,), "scenes": ("city",)}
QUICK |= {"no_pylops": True, "no_deepinv": True}
SEED = 7
RIM, MARGIN, FADE = 32, 48, 24  # px
AMPLITUDE, FREQUENCY = (3.1, 5.2), (50.0, 30.0)
TIMED_NOISE = 0.005
ROUND_TRIP = "FFT round trip"


def camera(exposure_rows: int) -> rsv.SensorTiming:
    """The paper's camera with another exposure."""
    return rsv.SensorTiming(row_time=20.52e-6, exposure_rows=exposure_rows, frame_rows=2048)


def vibration() -> rsv.Vibration:
    """The paper's vibration with random phases."""
    generator = torch.Generator().manual_seed(SEED)
    phase = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * math.pi
    return rsv.Vibration(AMPLITUDE, FREQUENCY, phase)


def read_picture(path: Path) -> Tensor:
    """A grey image (H, W), scaled so that its values cover 0.05 to 0.95."""
    info = rsv.read_stack_info(path)
    largest = np.iinfo(info.dtype).max if info.is_integer and info.full_scale is None else None
    image = rsv.read_stack(path, full_scale=largest)[0]
    image = image if image.ndim == 2 else image.mean(0)
    low, high = np.percentile(image.numpy(), (0.1, 99.9))
    return (0.05 + 0.9 * (image - low) / (high - low)).clamp(0.0, 1.0)


def scenes(options: argparse.Namespace) -> dict[str, Tensor]:
    """Scenes of the comparison, larger than the frames by a margin."""
    size = options.grid_size + 2 * MARGIN
    found = {name: SCENES[name](size, size, SEED) for name in options.scenes}
    for path in options.images:
        image = read_picture(path)
        if min(image.shape) < size:
            raise SystemExit(f"{path}: at least {size} x {size} px required, got {tuple(image.shape)}")
        top, left = ((side - size) // 2 for side in image.shape)
        found[path.stem] = image[top : top + size, left : left + size].contiguous()
    return found


def quality(figure: Peer, still: Tensor) -> float:
    """PSNR in dB without the border."""
    rows = list(range(RIM, len(still) - RIM)) if figure.rows is None else figure.rows
    restored = figure.restored[RIM:-RIM] if figure.rows is None else figure.restored
    return float(rsv.psnr(restored[:, RIM:-RIM], still[rows, RIM:-RIM], 1.0))


def methods(
    frames: Tensor,
    timing: rsv.SensorTiming,
    truth: rsv.Vibration,
    still: Tensor,
    options: argparse.Namespace,
    *,
    timed: bool,
) -> dict[str, Callable[[], Peer]]:
    """Every method that restores the first frame; those of the package use only frames, timing and vibration.

    Timed methods are run once before, as warm-up.
    """

    def ours(number: int = 1, **chosen: Any) -> Callable[[], Peer]:
        def run() -> Peer:
            for _ in range(2 if timed else 1):
                begin = time.perf_counter()
                restored = rsv.restore(frames[:number], timing, truth, check=False, **chosen)
                seconds = time.perf_counter() - begin
            return Peer(restored[0], seconds, "")

        return run

    found = {name: ours(method=name) for name in METHODS}
    found["exact, 2 frames jointly"] = ours(2, method="exact", joint=True)
    found['exact, prior="edges"'] = ours(method="exact", prior="edges")
    found['2 frames jointly, prior="edges"'] = ours(2, method="exact", joint=True, prior="edges")
    array = frames[0].numpy()
    found["cv2.remap, Lanczos-4"] = lambda: remap_lanczos(array, timing, truth)
    for name in LOOPS:
        found[name] = lambda n=name: loop_rows(n, array, timing, truth, still, RIM)
    if "pylops" not in LEFT_OUT and not options.no_pylops:
        found["pylops CGLS"] = lambda: cgls_restore(array, timing, truth, still, RIM)
    if "deepinv" not in LEFT_OUT and not options.no_deepinv:
        found["deepinv tiled blur, CG"] = lambda: tiled_restore(frames[0], timing, truth, still, RIM)
    return found


def compare(name: str, scene: Tensor, exposure: int, options: argparse.Namespace) -> Rows:
    """PSNR of all methods on one scene with one exposure, for every noise."""
    timing, truth, size = camera(exposure), vibration(), (options.grid_size, options.grid_size)
    taken = take_frames(closed(scene.double().numpy(), FADE), Shake.of(truth), timing, 2, size)
    clean = torch.from_numpy(taken).float()
    still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
    results: dict[str, dict[str, Any]] = {}
    for noise in options.noises:
        generator = torch.Generator().manual_seed(SEED)
        frames = rsv.SensorNoise(read_noise=noise).apply(clean, generator)
        figures = {"raw": Peer(frames[0], 0.0, "")}
        timed = noise == timed_noise(options)
        figures |= {name: run() for name, run in methods(frames, timing, truth, still, options, timed=timed).items()}
        for method, figure in figures.items():
            case = {"scene": name, "exposure_rows": exposure, "method": method}
            row = results.setdefault(method, {**case, "psnr_db": {}, "seconds": {}, "setting": {}})
            row["psnr_db"][str(noise)] = quality(figure, still)
            row["seconds"][str(noise)] = figure.seconds
            row["setting"][str(noise)] = figure.setting
    return list(results.values())


def timed_noise(options: argparse.Namespace) -> float:
    """Noise level of the timed runs."""
    return TIMED_NOISE if TIMED_NOISE in options.noises else float(options.noises[0])


def fft_round_trip(frame: Tensor) -> Tensor:
    """The unit of time: forward and inverse ``torch.fft`` in float32."""
    image: Tensor = torch.fft.irfft2(torch.fft.rfft2(frame), s=frame.shape)
    return image


def speed(options: argparse.Namespace) -> Rows:
    """Seconds and FFT round trips of the methods of the package for one large frame."""
    size = options.size
    timing, truth = camera(20), vibration()
    scene = city_and_fields(size + 2 * MARGIN, size + 2 * MARGIN, SEED)
    noise, generator = rsv.SensorNoise(read_noise=TIMED_NOISE), torch.Generator().manual_seed(SEED)
    frame = rsv.simulate_frames(scene, timing, truth, 1, frame_size=(size, size), noise=noise, generator=generator)
    results = []
    for device in options.device:
        taken = frame.to(device)
        works: dict[str, Callable[[], Any]] = {ROUND_TRIP: lambda f=taken: fft_round_trip(f[0])}
        works |= {name: lambda m=name, f=taken: rsv.restore(f, timing, truth, method=m) for name in METHODS}
        if device == "cpu":
            array = frame[0].numpy()
            works["cv2.remap, Lanczos-4"] = lambda a=array: remap_lanczos(a, timing, truth)
        done = in_turns(works, options.runs)
        unit = done[ROUND_TRIP].seconds
        results += [
            {"method": named(name, device), **timed.figures(), "round_trips": timed.seconds / unit}
            for name, timed in done.items()
        ]
    return results


def rows(options: argparse.Namespace) -> Rows:
    """Quality of every method on every scene and exposure, then speed."""
    compared = [
        row
        for name, scene in scenes(options).items()
        for exposure in options.exposures
        for row in compare(name, scene, exposure, options)
    ]
    return [
        *({"part": "quality", **row} for row in compared),
        *({"part": "speed", **row} for row in speed(options)),
        *({"part": "left out", "peer": peer, "why": why} for peer, why in LEFT_OUT.items()),
    ]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The figures as Markdown tables."""
    compared = [row for row in results if row["part"] == "quality"]
    noises, timed = [str(noise) for noise in options.noises], str(timed_noise(options))
    text = [
        f"PSNR in dB without a border of {RIM} px, frames of {options.grid_size} x {options.grid_size} px, true "
        f"vibration given; seconds at noise {timed}. Peers use the setting with the highest PSNR; the best value of "
        "each column has a star.",
        "",
    ]
    for scene, exposure in dict.fromkeys((row["scene"], row["exposure_rows"]) for row in compared):
        here = [row for row in compared if (row["scene"], row["exposure_rows"]) == (scene, exposure)]
        best = {noise: max(row["psnr_db"][noise] for row in here) for noise in noises}
        cells = []
        for row in here:
            values = [f"{row['psnr_db'][n]:.2f}{'*' if row['psnr_db'][n] == best[n] else ''}" for n in noises]
            cells.append((row["method"], *values, f"{row['seconds'][timed]:.2f}"))
        heads = (f"{scene}, exposure of {exposure} rows", *(f"noise {noise}" for noise in noises), "seconds")
        text += table(heads, cells)
    text += table(
        (f"one frame of {options.size} x {options.size} px", "seconds", "FFT round trips"),
        [(row["method"], shown_seconds(row), f"{row['round_trips']:.1f}") for row in results if row["part"] == "speed"],
    )
    text.append(
        "The row loops of skimage process a sample of the rows: their time is scaled to all rows, their PSNR is that "
        f"of the sample. Speed: medians of {options.runs} alternating runs (range)."
    )
    for row in (row for row in results if row["part"] == "left out"):
        text.append(f"Not compared with {row['peer']}, which cannot be imported: {row['why'].splitlines()[0]}.")
    return text
