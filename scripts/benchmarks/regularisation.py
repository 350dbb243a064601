"""Regularisation from the data against the best weight by hand, over scenes, noise and exposures.

``python -m benchmarks.regularisation`` in ``scripts``. Every scene is restored with what the frames ask for, and with
that times several factors, of which the truth says the best. Frames come from a camera made without the package.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from benchmarks.independent_camera import Shake, closed, take_frames
from benchmarks.restoration import FADE, MARGIN, RIM, SCENES, SEED, camera, scenes, vibration
from torch import Tensor

import rsvib_torch as rsv

FACTORS = (0.1, 0.3, 1.0, 3.0)
NOISES = (0.001, 0.005, 0.02, 0.05)
EXPOSURES = (20, 100, 400)


def two_frames(scene: Tensor, exposure: int, size: int) -> Tensor:
    """Two frames of a scene, without noise."""
    timing, truth = camera(exposure), vibration()
    shake = Shake(*(values.numpy() for values in (truth.amplitude, truth.frequency, truth.phase, truth.image_motion)))
    taken = take_frames(
        closed(scene.double().numpy(), FADE),
        shake,
        row_time=timing.row_time,
        exposure_rows=exposure,
        frame_rows=timing.frame_rows,
        num_frames=2,
        size=(size, size),
    )
    return torch.from_numpy(taken).float()


def losses(name: str, scene: Tensor, options: argparse.Namespace) -> list[dict[str, Any]]:
    """PSNR with the weight from the data, and what the best by hand has more, for all cases of a scene."""
    found = []
    still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
    for exposure in options.exposures:
        clean = two_frames(scene, exposure, options.grid_size)
        for noise in options.noises:
            frames = rsv.SensorNoise(read_noise=noise).apply(clean, torch.Generator().manual_seed(SEED))
            for kind, given, joint in (("1 of 1", 1, False), ("1 of 2", 2, False), ("2 jointly", 2, True)):
                figures = {}
                for factor in FACTORS:
                    restored = rsv.restore(
                        frames[:given],
                        camera(exposure),
                        vibration(),
                        check=False,
                        joint=joint,
                        regularisation=factor,
                    )
                    inner = (slice(RIM, -RIM), slice(RIM, -RIM))
                    figures[factor] = float(rsv.psnr(restored[0][inner], still[inner], 1.0))
                best = max(figures, key=lambda factor: figures[factor])
                found.append(
                    {
                        "scene": name,
                        "exposure_rows": exposure,
                        "noise": noise,
                        "frames": kind,
                        "psnr_db": figures[1.0],
                        "loss_db": figures[best] - figures[1.0],
                        "best_factor": best,
                    }
                )
    return found


def main() -> None:
    """Print a table of losses, and write all figures as JSON on demand."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--grid-size", type=int, default=512, help="frame side (default: 512)")
    parser.add_argument("--exposures", type=int, nargs="+", default=EXPOSURES, help="exposures in row times")
    parser.add_argument("--noises", type=float, nargs="+", default=NOISES, help="noise levels of full scale")
    parser.add_argument("--scenes", choices=SCENES, nargs="*", default=list(SCENES), help="drawn scenes")
    parser.add_argument("--images", type=Path, nargs="*", default=[], help="images to restore as well")
    parser.add_argument("--json", type=Path, help="where to write all figures")
    options = parser.parse_args()
    torch.set_num_threads(1)
    found = []
    print("| scene | frames | cases | mean loss (dB) | largest | over 0.3 dB |")
    print("|---|---|---|---|---|---|", flush=True)
    for name, scene in scenes(options).items():
        rows = losses(name, scene, options)
        found += rows
        for kind in ("1 of 1", "1 of 2", "2 jointly"):
            here = [row for row in rows if row["frames"] == kind]
            worst = max(here, key=lambda row: row["loss_db"])
            mean = sum(row["loss_db"] for row in here) / len(here)
            over = sum(row["loss_db"] > 0.3 for row in here)
            where = f"{worst['exposure_rows']} rows, noise {worst['noise']}"
            print(
                f"| {name} | {kind} | {len(here)} | {mean:.2f} | {worst['loss_db']:.2f} ({where}) | {over} |",
                flush=True,
            )
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
