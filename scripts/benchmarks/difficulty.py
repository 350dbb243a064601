"""PSNR of restored frames of scenes that are changed until they are as difficult as a reference scene.

The PSNR of a restored frame depends on the contrast of the scene and on its power near the Nyquist frequency. The PSNR
that plain unwarping of a noiseless frame reaches (``cv2.remap``, Lanczos-4) measures this difficulty. Scenes are
therefore reduced in contrast, or blurred by Gaussian optics, until unwarping reaches the PSNR of the reference scene.
The PSNR of unwarping in the other cases indicates how similar the scenes have become. The true vibration is given, the
regularisation is estimated from the frames, and these come from a camera made without the package.
"""

import argparse
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import torch
from benchmarks.regularisation import two_frames
from benchmarks.restoration import MARGIN, SEED, camera, quality, scenes, vibration
from benchmarks.restoration_peers import Peer, remap_lanczos
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

import rsvib_torch as rsv

CASES = ((20, 0.0), (20, 0.005), (20, 0.02), (100, 0.005), (400, 0.005))  # exposure in rows, noise
GOALS = ((68.0, 72.0), (47.0, 49.2), (38.0, 40.0), (45.0, 47.0), (39.8, 42.8))  # dB of one frame, of two jointly
UNWARPED = (61.5, 46.5, 34.6, 44.3, 33.2)  # dB by plain unwarping on the reference scene, for which the goals were set
_STEPS = 9


def fainter(scene: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """The scene with its contrast reduced to 1 - ``share``."""
    return np.asarray(scene.mean() + (1.0 - share) * (scene - scene.mean()))


# changes of a scene: function, largest amount, description
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
    """The frame of a camera at rest, without noise."""
    return torch.from_numpy(scene[MARGIN:-MARGIN, MARGIN:-MARGIN]).float()


def unwarped(frames: Tensor, scene: NDArray[np.float64], exposure: int) -> float:
    """PSNR in dB of the first frame after plain unwarping."""
    return quality(remap_lanczos(frames[0].numpy(), camera(exposure), vibration()), still_of(scene))


def made_easier(scene: NDArray[np.float64], wanted: float, way: str) -> tuple[NDArray[np.float64], str]:
    """The scene with the smallest change for which plain unwarping reaches ``wanted`` dB, and the change in words."""
    change, high, described = WAYS[way]
    low = 0.0
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        changed = change(scene, middle)
        hard = unwarped(frames_of(changed, *CASES[0]), changed, CASES[0][0]) < wanted
        low, high = (middle, high) if hard else (low, middle)
    return change(scene, high), described(high)


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """PSNR of every scene and case: unwarped, restored from one frame, and restored jointly from two."""
    results = []
    enlarged = argparse.Namespace(**{**vars(options), "grid_size": options.difficulty_size})
    for (name, drawn), way in product(scenes(enlarged).items(), options.by):
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


def lines(results: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """A table in Markdown."""
    text = [
        "| scene | rows, noise | unwarped (reference scene) | one frame (goal) | two jointly (goal) | |",
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


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this section; scenes and images are those of restoration."""
    parser.add_argument("--difficulty-size", type=int, default=1024, help="side of the frames in px (default: 1024)")
    parser.add_argument("--by", choices=WAYS, nargs="*", default=list(WAYS), help="how scenes are made easier")
