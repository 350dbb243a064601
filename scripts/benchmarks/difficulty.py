"""PSNR of restored frames of scenes made as hard as another one: ``python -m benchmarks.difficulty``.

How well a frame can be restored depends on the scene: its contrast, and how much of it lies near the Nyquist frequency,
which is lost first. Plain unwarping of a noiseless frame (``cv2.remap``, Lanczos-4) measures that. So scenes are made
fainter, or blurred by Gaussian optics, until it reaches a given PSNR, and everything else is compared there; how
unwarping does in the other cases says how alike the scenes have become. The true vibration is given, the strength of
the prior comes from the frames, and these from a camera made without the package.
"""

import argparse
import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks.regularisation import two_frames
from benchmarks.restoration import MARGIN, SCENES, SEED, camera, quality, scenes, vibration
from benchmarks.restoration_peers import Peer, remap_lanczos
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

import rsvib_torch as rsv

CASES = ((20, 0.0), (20, 0.005), (20, 0.02), (100, 0.005), (400, 0.005))  # exposure in rows, noise
GOALS = ((68.0, 72.0), (47.0, 49.2), (38.0, 40.0), (45.0, 47.0), (39.8, 42.8))  # dB of one frame, of two jointly
UNWARPED = (61.5, 46.5, 34.6, 44.3, 33.2)  # dB by plain unwarping on the scene that the goals were set on
_STEPS = 9


def fainter(scene: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """A scene of 1 - ``share`` of the contrast."""
    return np.asarray(scene.mean() + (1.0 - share) * (scene - scene.mean()))


# what can be done to a scene, the largest amount of it, and its name
WAYS: dict[str, tuple[Callable[[NDArray[np.float64], float], NDArray[np.float64]], float, Callable[[float], str]]] = {
    "contrast": (fainter, 0.99, lambda share: f"contrast {1.0 - share:.2f}"),
    "optics": (gaussian_filter, 1.5, lambda sigma: f"optics {sigma:.2f} px"),
}


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


def made_easier(scene: NDArray[np.float64], wanted: float, way: str) -> tuple[NDArray[np.float64], str]:
    """A scene changed no more than it takes for plain unwarping to reach ``wanted`` dB, and what was done to it."""
    change, high, described = WAYS[way]
    low = 0.0
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        changed = change(scene, middle)
        hard = unwarped(frames_of(changed, *CASES[0]), changed, CASES[0][0]) < wanted
        low, high = (middle, high) if hard else (low, middle)
    return change(scene, high), described(high)


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """PSNR of every scene and case by unwarping, of one frame restored, and of two jointly."""
    results = []
    for (name, drawn), way in product(scenes(options).items(), options.by):
        scene, described = made_easier(drawn.double().numpy(), UNWARPED[0], way)
        for (exposure, noise), goals, before in zip(CASES, GOALS, UNWARPED, strict=True):
            frames, found = frames_of(scene, exposure, noise), []
            for count in (1, 2):
                images = rsv.restore(frames[:count], camera(exposure), vibration(), check=False, joint=count > 1)
                found.append(quality(Peer(images[0], 0.0, ""), still_of(scene)))
            case = {"scene": name, "by": way, "made": described, "exposure_rows": exposure, "noise": noise}
            case |= {"unwarped_db": unwarped(frames, scene, exposure), "unwarped_there_db": before}
            results.append({**case, "one_db": found[0], "two_db": found[1], "goals_db": goals})
    return results


def lines(results: list[dict[str, Any]]) -> list[str]:
    """A table in Markdown."""
    text = [
        "| scene | rows, noise | unwarped (where goals were set) | one frame (goal) | two jointly (goal) | |",
        "|---|---|---|---|---|---|",
    ]
    for row in results:
        one, two = row["goals_db"]
        met = "met" if row["one_db"] >= one and row["two_db"] >= two else "**missed**"
        text.append(
            f"| {row['scene']}, {row['made']} | {row['exposure_rows']}, {row['noise']} "
            f"| {row['unwarped_db']:.1f} ({row['unwarped_there_db']}) | {row['one_db']:.1f} ({one}) "
            f"| {row['two_db']:.1f} ({two}) | {met} |"
        )
    return text


def main(arguments: list[str] | None = None, tell: Callable[[str], None] = print) -> None:
    """Run it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.difficulty", description=__doc__)
    parser.add_argument("--grid-size", type=int, default=1024, help="frame side in px (default: 1024)")
    parser.add_argument("--scenes", choices=SCENES, nargs="*", default=list(SCENES), help="drawn scenes")
    parser.add_argument("--images", type=Path, nargs="*", default=[], help="images to restore as well")
    parser.add_argument("--by", choices=WAYS, nargs="*", default=list(WAYS), help="how scenes are made easier")
    parser.add_argument("--json", type=Path, help="write the figures there")
    options = parser.parse_args(arguments)
    results = rows(options)
    tell("\n".join(lines(results)))
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
