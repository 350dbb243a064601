"""Regularisation estimated from the data, compared with the best factor, over scenes, noise and exposures.

Every scene is restored with the regularisation estimated from the frames, and with that multiplied by several factors,
the best of which is chosen by comparison with the true scene. Frames come from a camera made without the package.
"""

import argparse
from typing import Any

import torch
from benchmarks.independent_camera import Shake, closed, take_frames
from benchmarks.measure import one_thread
from benchmarks.restoration import FADE, MARGIN, RIM, SEED, camera, scenes, vibration
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
    """PSNR with the regularisation from the data, and the gain of the best factor, for all cases of a scene."""
    found = []
    still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
    for exposure in options.exposures:
        clean = two_frames(scene, exposure, options.grid_size)
        for noise in options.regularisation_noises:
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


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this section; scenes, exposures and the size of the frames are those of restoration."""
    parser.add_argument(
        "--regularisation-noises", type=float, nargs="+", default=NOISES, help="noise levels, fractions of full scale"
    )


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """PSNR with the regularisation from the data and with the best factor, for all scenes and cases."""
    with one_thread():
        return [row for name, scene in scenes(options).items() for row in losses(name, scene, options)]


def lines(results: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """A table of the losses."""
    text = [
        f"PSNR lost by the regularisation that is estimated from the data, compared with the best of the factors "
        f"{', '.join(f'{factor:g}' for factor in FACTORS)} on it; frames of {options.grid_size} x {options.grid_size} "
        "px, true vibration given.",
        "",
        "| scene | frames | cases | mean loss (dB) | largest loss (dB) | cases above 0.3 dB |",
        "|---|---|---|---|---|---|",
    ]
    for name, kind in dict.fromkeys((row["scene"], row["frames"]) for row in results):
        group = [row for row in results if (row["scene"], row["frames"]) == (name, kind)]
        worst = max(group, key=lambda row: row["loss_db"])
        mean = sum(row["loss_db"] for row in group) / len(group)
        above = sum(row["loss_db"] > 0.3 for row in group)
        case = f"{worst['exposure_rows']} rows, noise {worst['noise']}"
        text.append(f"| {name} | {kind} | {len(group)} | {mean:.2f} | {worst['loss_db']:.2f} ({case}) | {above} |")
    return text
