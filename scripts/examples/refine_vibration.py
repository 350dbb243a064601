#!/usr/bin/env python
"""Refine a vibration by gradient descent, through the restoration of two frames.

The frames are restored with a vibration that has errors of a few percent. These cause a difference between the restored
frames; its mean square is differentiable, so that L-BFGS minimises it over amplitude, frequency and phase. Printed: the
parameters before and after, and the truth. ``detect_vibration`` is faster and needs no initial values; the example
demonstrates how to minimise a different loss.
"""

import argparse
import time
from collections.abc import Sequence

import torch
from rich import box
from rich.console import Console
from rich.table import Table
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

TIMING = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=600)
TRUTH = rsv.Vibration(amplitude=[2.4, 3.1], frequency=[65.0, 50.0], phase=[0.7, -0.4])
MARGIN, RIM = 32, 24  # px of scene beyond the frame; px of the frame that are not evaluated
NOISE = 0.003  # of full scale
UNITS = torch.tensor([[1.0], [10.0], [1.0]])  # px, Hz and rad; scales of the parameters


def disagreement(restorer: rsv.VibrationRestorer, frames: Tensor, parameters: Tensor) -> Tensor:
    """Mean square of the difference of two frames restored with parameters (3, 2): amplitude, frequency, phase."""
    first, second = restorer(frames, rsv.Vibration(*parameters))
    return (second - first)[RIM:-RIM, RIM:-RIM].square().mean()


def refine(frames: Tensor, start: Tensor, steps: int) -> tuple[Tensor, list[float]]:
    """Parameters (3, 2) after ``steps`` steps of L-BFGS, and the loss of every step."""
    restorer = rsv.VibrationRestorer(TIMING, method="dewarp", check=False)
    units = UNITS.to(start)
    unknown = (start / units).requires_grad_()
    optimiser = torch.optim.LBFGS([unknown], max_iter=steps, line_search_fn="strong_wolfe", tolerance_change=1e-12)
    losses: list[float] = []

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = disagreement(restorer, frames, unknown * units) / NOISE**2
        loss.backward()
        losses.append(loss.item() * NOISE**2)
        return loss

    optimiser.step(closure)
    return (unknown * units).detach(), losses


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=30, help="steps of L-BFGS (default: 30)")
    parser.add_argument("--size", type=int, nargs=2, default=(512, 256), metavar=("H", "W"), help="size of the frames")
    parser.add_argument("--seed", type=int, default=1, help="seed of scene and noise")
    options = parser.parse_args(arguments)
    generator = torch.Generator().manual_seed(options.seed)
    scene = city_and_fields(*(size + 2 * MARGIN for size in options.size), options.seed).double()
    noise = rsv.SensorNoise(read_noise=NOISE)
    frames = rsv.simulate_frames(scene, TIMING, TRUTH, frame_size=tuple(options.size), noise=noise, generator=generator)
    truth = torch.stack([getattr(TRUTH, name)[:, 0] for name in ("amplitude", "frequency", "phase")])
    start = truth * torch.tensor([[0.85], [1.03], [1.0]]) + torch.tensor([[0.0], [0.0], [0.2]])
    begin = time.perf_counter()
    found, losses = refine(frames, start, options.steps)

    table = Table("", "start", "refined", "true", box=box.SIMPLE_HEAD)
    for kind, (name, unit) in enumerate((("amplitude", "px"), ("frequency", "Hz"), ("phase", "rad"))):
        for axis in range(2):
            values = (f"{numbers[kind, axis].item():.4f}" for numbers in (start, found, truth))
            table.add_row(f"{name} {'xy'[axis]} ({unit})", *values)
    console = Console(highlight=False, width=100)
    console.print(table)
    rms = [loss**0.5 for loss in (losses[0], min(losses))]
    console.print(f"rms difference of the restored frames: {rms[0]:.4f} before, {rms[1]:.4f} after, of full scale")
    console.print(f"{len(losses)} evaluations in {time.perf_counter() - begin:.1f} s")


if __name__ == "__main__":
    main()
