"""PSNR of restored frames over the optics that a scene is seen through: ``python -m benchmarks.optics``.

How well a frame can be restored depends on the scene: what lies near the Nyquist frequency is lost first. Plain
unwarping of a noiseless frame (``cv2.remap``, Lanczos-4) measures that, so drawn scenes are blurred by Gaussian optics
until it reaches a given PSNR, and everything else is compared there. The true vibration is given, the strength of the
prior comes from the frames, and these from a camera made without the package.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks.regularisation import two_frames
from benchmarks.restoration import MARGIN, SCENES, SEED, camera, quality, vibration
from benchmarks.restoration_peers import Peer, remap_lanczos
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

import rsvib_torch as rsv

CASES = ((20, 0.0), (20, 0.005), (20, 0.02), (100, 0.005), (400, 0.005))  # exposure in rows, noise
GOALS = ((68.0, 72.0), (47.0, 49.2), (38.0, 40.0), (45.0, 47.0), (39.8, 42.8))  # dB of one frame, of two jointly
UNWARPED = (61.5, 46.5, 34.6, 44.3, 33.2)  # dB by plain unwarping on the scene that the goals were set on
_STEPS = 9


def frames_of(scene: NDArray[np.float64], exposure: int, noise: float) -> Tensor:
    """Two frames of a scene."""
    frames = two_frames(torch.from_numpy(scene), exposure, len(scene) - 2 * MARGIN)
    generator = torch.Generator().manual_seed(SEED)
    return rsv.SensorNoise(read_noise=noise).apply(frames, generator) if noise else frames


def still_of(scene: NDArray[np.float64]) -> Tensor:
    """What a still camera without noise shows."""
    return torch.from_numpy(scene[MARGIN:-MARGIN, MARGIN:-MARGIN]).float()


def unwarped(frames: Tensor, scene: NDArray[np.float64], exposure: int) -> float:
    """PSNR in dB that plain unwarping of the first frame reaches."""
    return quality(remap_lanczos(frames[0].numpy(), camera(exposure), vibration()), still_of(scene))


def seen_through(scene: NDArray[np.float64], wanted: float) -> tuple[NDArray[np.float64], float]:
    """A scene through the sharpest Gaussian optics for which plain unwarping reaches ``wanted`` dB, and their sigma."""
    low, high = 0.0, 1.5
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        blurred = gaussian_filter(scene, middle)
        sharp = unwarped(frames_of(blurred, *CASES[0]), blurred, CASES[0][0]) < wanted
        low, high = (middle, high) if sharp else (low, middle)
    return gaussian_filter(scene, high), high


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """PSNR of every scene and case by unwarping, of one frame restored, and of two jointly."""
    results = []
    size = options.size + 2 * MARGIN
    for name in options.scenes:
        scene, sigma = seen_through(SCENES[name](size, size, SEED).double().numpy(), UNWARPED[0])
        for (exposure, noise), goals, before in zip(CASES, GOALS, UNWARPED, strict=True):
            frames, found = frames_of(scene, exposure, noise), []
            for count in (1, 2):
                images = rsv.restore(frames[:count], camera(exposure), vibration(), check=False, joint=count > 1)
                found.append(quality(Peer(images[0], 0.0, ""), still_of(scene)))
            case = {"scene": name, "sigma": sigma, "exposure_rows": exposure, "noise": noise}
            case |= {"unwarped_db": unwarped(frames, scene, exposure), "unwarped_there_db": before}
            results.append({**case, "one_db": found[0], "two_db": found[1], "goals_db": goals})
    return results


def lines(results: list[dict[str, Any]]) -> list[str]:
    """A table in Markdown."""
    text = [
        "| scene, optics | rows, noise | unwarped (where goals were set) | one frame (goal) | two jointly (goal) | |",
        "|---|---|---|---|---|---|",
    ]
    for row in results:
        one, two = row["goals_db"]
        met = "met" if row["one_db"] >= one and row["two_db"] >= two else "**missed**"
        text.append(
            f"| {row['scene']}, {row['sigma']:.2f} px | {row['exposure_rows']}, {row['noise']} "
            f"| {row['unwarped_db']:.1f} ({row['unwarped_there_db']}) | {row['one_db']:.1f} ({one}) "
            f"| {row['two_db']:.1f} ({two}) | {met} |"
        )
    return text


def main(arguments: list[str] | None = None, tell: Callable[[str], None] = print) -> None:
    """Run it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.optics", description=__doc__)
    parser.add_argument("--size", type=int, default=1024, help="frame side in px (default: 1024)")
    parser.add_argument("--scenes", choices=SCENES, nargs="*", default=list(SCENES), help="drawn scenes")
    parser.add_argument("--json", type=Path, help="write the figures there")
    options = parser.parse_args(arguments)
    results = rows(options)
    tell("\n".join(lines(results)))
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
