"""Accuracy of the slanted-edge MTF on drawn edges whose MTF is known."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import Rows, one_thread, table_of

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from edge_truth import OPTICS, draw_edge, draw_edge_of, gaussian, mtf50_of, through_pixels

import rsvib_torch as rsv

OPTIONS = {"seeds": (100, "slanted_edge: noise seeds for Gaussian optics; a fifth for others")}
QUICK = {"seeds": 2}
NOISE = 0.008  # 1 % of the contrast, 0.8
SIGMAS = (0.5, 0.8)
Transfer = Callable[[np.ndarray], np.ndarray]


def measure(image: np.ndarray) -> rsv.MtfCurve:
    return rsv.slanted_edge_mtf(torch.from_numpy(np.ascontiguousarray(image)))


def errors(image: np.ndarray, truth: Transfer, lowest: float) -> tuple[float, float]:
    """Largest error of the MTF up to 0.5 cycles/px, and of MTF50 in %."""
    curve, frequency = measure(image), np.linspace(lowest, 0.5, 81)
    error = np.abs(curve.at(torch.from_numpy(frequency)).numpy() - truth(frequency)).max()
    return float(error), 100 * (float(curve.mtf50) / mtf50_of(truth) - 1)


def bound(sigma: float) -> float:
    """Cramér-Rao bound of MTF50 in % for Gaussian optics with unknown angle, position, blur and levels."""
    start, step = np.array([5.0, 0.0, sigma, 0.1, 0.9]), 1e-5

    def draw(p: np.ndarray) -> np.ndarray:
        return draw_edge(p[0], p[2], levels=(p[3], p[4]), offset=(p[1], 0.0)).ravel()

    by = np.stack([(draw(start + d) - draw(start - d)) / (2 * step) for d in step * np.eye(5)], axis=1)
    std = NOISE * np.sqrt(np.linalg.inv(by.T @ by)[2, 2])
    ends = [mtf50_of(through_pixels(gaussian(sigma + d), 5.0)) for d in (-step, 0.0, step)]
    return float(100 * std * abs(ends[2] - ends[0]) / (2 * step) / ends[1])


def gaussian_row(sigma: float, seeds: int) -> dict[str, Any]:
    """Errors with Gaussian optics, without noise over angles and levels, and with noise."""
    worst = np.zeros(2)
    for angle in (-7.0, -6.0, -5.71, -5.0, -4.0, 4.0, 4.5, 5.0, 6.0, 7.0):
        truth = through_pixels(gaussian(sigma), angle)
        for levels in ((0.1, 0.9), (0.9, 0.1)):
            image = draw_edge(angle, sigma, levels=levels).astype(np.float32)
            for roi in (image, image.T):
                worst = np.maximum(worst, np.abs(errors(roi, truth, 0.1)))
    noisy = []
    for seed in range(seeds):
        generator = np.random.default_rng(500_000 + seed)
        angle = generator.uniform(4, 7) * generator.choice([-1, 1])
        levels = (0.1, 0.9) if seed % 4 < 2 else (0.9, 0.1)
        image = draw_edge(angle, sigma, levels=levels, offset=generator.uniform(-0.5, 0.5, 2))
        image = image + NOISE * generator.standard_normal(image.shape)
        noisy.append(errors(image.T if seed % 2 else image, through_pixels(gaussian(sigma), angle), 0.1)[1])
    return {
        "part": "gaussian",
        "optics": f"Gaussian, sigma = {sigma} px",
        "mtf_error": float(worst[0]),
        "mtf50_percent": float(worst[1]),
        "noisy_percent": float(np.sqrt(np.mean(np.square(noisy)))),
        "bound_percent": bound(sigma),
    }


def other_row(name: str, seeds: int) -> dict[str, Any]:
    """Errors with other optics, without and with noise."""
    truth, image = through_pixels(OPTICS[name], 5.2), draw_edge_of(OPTICS[name], 5.2)
    error, clean = errors(image, truth, 0.02)
    noisy = [
        errors(image + NOISE * np.random.default_rng(seed).standard_normal(image.shape), truth, 0.02)[1]
        for seed in range(seeds)
    ]
    rms = float(np.sqrt(np.mean(np.square(noisy))))
    return {"part": "other", "optics": name, "mtf_error": error, "mtf50_percent": clean, "noisy_percent": rms}


def rows(options: argparse.Namespace) -> Rows:
    fewer = max(options.seeds // 5, 1)
    with one_thread():
        return [*(gaussian_row(sigma, options.seeds) for sigma in SIGMAS), *(other_row(name, fewer) for name in OPTICS)]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    of_part = {part: [row for row in results if row["part"] == part] for part in ("gaussian", "other")}
    noisy = ("MTF50 rms, noise 1 %", "{noisy_percent:.2f} %")
    return [
        *table_of(
            of_part["gaussian"],
            ("optics", "{optics}"),
            ("largest MTF error at 0.1 ... 0.5 cycles/px", "{mtf_error:.0e}"),
            ("MTF50, no noise", "{mtf50_percent:.0e} %"),
            noisy,
            ("bound", "{bound_percent:.2f} %"),
        ),
        *table_of(
            of_part["other"],
            ("optics", "{optics}"),
            ("largest MTF error at 0.02 ... 0.5 cycles/px", "{mtf_error:.0e}"),
            ("MTF50, no noise", "{mtf50_percent:+.4f} %"),
            noisy,
        ),
    ]
