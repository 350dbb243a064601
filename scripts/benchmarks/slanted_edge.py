"""Accuracy of the slanted-edge MTF on drawn edges whose MTF is known."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import Rows, table_of

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from edge_truth import OPTICS, draw_edge, draw_edge_of, gaussian, mtf50_of, through_pixels

import rsvib_torch as rsv

OPTIONS = {"seeds": (100, "slanted_edge: noise seeds for Gaussian optics; a fifth for others")}
QUICK = {"seeds": 2}
NOISE = 0.008  # 1 % of the contrast, 0.8
SIGMAS = (0.5, 0.8)
Transfer = Callable[[np.ndarray], np.ndarray]
Edges = list[tuple[float, np.ndarray]]  # angles in degrees, and images


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


def row(optics: str, truth: Callable[[float], Transfer], lowest: float, clean: Edges, noisy: Edges) -> dict[str, Any]:
    """Errors of edges with and without noise, given with their angles, for optics whose MTF depends on the angle."""
    largest = np.abs([errors(image, truth(angle), lowest) for angle, image in clean]).max(axis=0)
    percent = [errors(image, truth(angle), lowest)[1] for angle, image in noisy]
    rms = float(np.sqrt(np.mean(np.square(percent))))
    found = {"mtf_error": float(largest[0]), "mtf50_percent": float(largest[1]), "noisy_percent": rms}
    return {"optics": optics, "lowest": lowest, **found}


def gaussian_row(sigma: float, seeds: int) -> dict[str, Any]:
    """Gaussian optics: all angles, levels and directions without noise, random ones with noise."""
    clean, noisy = [], []
    for angle in (-7.0, -6.0, -5.71, -5.0, -4.0, 4.0, 4.5, 5.0, 6.0, 7.0):
        for levels in ((0.1, 0.9), (0.9, 0.1)):
            image = draw_edge(angle, sigma, levels=levels).astype(np.float32)
            clean += [(angle, image), (angle, image.T)]
    for seed in range(seeds):
        generator = np.random.default_rng(500_000 + seed)
        angle = generator.uniform(4, 7) * generator.choice([-1, 1])
        levels = (0.1, 0.9) if seed % 4 < 2 else (0.9, 0.1)
        image = draw_edge(angle, sigma, levels=levels, offset=generator.uniform(-0.5, 0.5, 2))
        image = image + NOISE * generator.standard_normal(image.shape)
        noisy.append((angle, image.T if seed % 2 else image))
    optics = f"Gaussian, sigma = {sigma} px"
    found = row(optics, lambda angle: through_pixels(gaussian(sigma), angle), 0.1, clean, noisy)
    return {**found, "bound_percent": bound(sigma)}


def other_row(name: str, seeds: int) -> dict[str, Any]:
    """Other optics at one angle."""
    angle, image = 5.2, draw_edge_of(OPTICS[name], 5.2)
    noise = [NOISE * np.random.default_rng(seed).standard_normal(image.shape) for seed in range(seeds)]
    truth = through_pixels(OPTICS[name], angle)
    return row(name, lambda _: truth, 0.02, [(angle, image)], [(angle, image + one) for one in noise])


def rows(options: argparse.Namespace) -> Rows:
    fewer = max(options.seeds // 5, 1)
    return [*(gaussian_row(sigma, options.seeds) for sigma in SIGMAS), *(other_row(name, fewer) for name in OPTICS)]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    return table_of(
        results,
        ("optics", "{optics}"),
        ("largest MTF error up to 0.5 cycles/px", "{mtf_error:.0e}, from {lowest} cycles/px"),
        ("MTF50, no noise", "{mtf50_percent:.0e} %"),
        ("MTF50 rms, noise 1 %", "{noisy_percent:.2f} %"),
        ("bound", lambda row: f"{row['bound_percent']:.2f} %" if "bound_percent" in row else ""),
    )
