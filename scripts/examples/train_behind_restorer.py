#!/usr/bin/env python
"""Train a small network behind the restorer, for a few steps on the CPU.

``RollingShutterVibration`` simulates clips of a drawn scene with random vibrations, and noise is added. A model
denoises the frames, restores them, and denoises the result: the gradients of the first layer pass through the
restoration. Printed: the loss, and the PSNR of clips that were not used for training.
"""

import argparse
import time
from collections.abc import Sequence

import torch
from kornia.augmentation import VideoSequential
from rich.console import Console
from torch import Tensor, nn

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

TIMING = rsv.SensorTiming(row_time=60e-6, exposure_rows=10, frame_rows=200)
PATCH, RIM = 64, 8  # px
NOISE = 0.05  # of full scale


class Denoiser(nn.Module):
    """Three convolutions, initialised to the identity."""

    def __init__(self, channels: int = 12) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(1, channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(channels, 1, 3, padding=1),
        )
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, images: Tensor) -> Tensor:
        """Denoise each of the images (B, T, 1, H, W)."""
        return images + self.layers(images.flatten(0, 1)).unflatten(0, images.shape[:2])


class RestoringModel(nn.Module):
    """Denoiser, restorer, denoiser."""

    def __init__(self) -> None:
        super().__init__()
        self.before, self.after = Denoiser(), Denoiser()
        self.restorer = rsv.VibrationRestorer(TIMING, method="dewarp", check=False)

    def forward(self, frames: Tensor, vibration: rsv.Vibration) -> Tensor:
        """Restored frames (B, T, 1, H, W)."""
        return self.after(self.restorer(self.before(frames), vibration))


def take_clips(ground: Tensor, count: int, camera: rsv.RollingShutterVibration) -> tuple[Tensor, Tensor, rsv.Vibration]:
    """Noisy clips (B, 2, 1, H, W), the scenes at rest, and the vibration of each clip."""
    corners = torch.randint(0, min(ground.shape) - PATCH, (count, 2)).tolist()
    still = torch.stack([ground[row : row + PATCH, column : column + PATCH] for row, column in corners])
    still = still[:, None, None].expand(-1, 2, -1, -1, -1)
    clips = VideoSequential(camera)(still)
    return clips + NOISE * torch.randn_like(clips), still, camera.drawn_vibration()


def decibel(images: Tensor, still: Tensor) -> float:
    """PSNR without the border."""
    return rsv.psnr(images, still, 1.0, rim=RIM).mean().item()


def train(steps: int, batch: int, seed: int) -> dict[str, list[float]]:
    """Losses of all steps, and PSNR of clips not used for training: input, restored, and after the model."""
    torch.manual_seed(seed)
    ground = city_and_fields(320, 320, seed)
    unseen = city_and_fields(320, 320, seed + 1)
    camera = rsv.RollingShutterVibration(TIMING, amplitude=(1.0, 3.0), frequency=(20.0, 120.0))
    model = RestoringModel()
    optimiser = torch.optim.Adam(model.parameters(), lr=4e-3)
    losses = []
    for _ in range(steps):
        clips, still, vibration = take_clips(ground, batch, camera)
        error = (model(clips, vibration) - still)[..., RIM:-RIM, RIM:-RIM]
        loss = error.square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    clips, still, vibration = take_clips(unseen, 16, camera)
    with torch.no_grad():
        stages = (clips, model.restorer(clips, vibration), model(clips, vibration))
    return {"losses": losses, "psnr": [decibel(images, still) for images in stages]}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=150, help="training steps (default: 150)")
    parser.add_argument("--batch", type=int, default=8, help="clips per step (default: 8)")
    parser.add_argument("--seed", type=int, default=1, help="seed of ground, vibrations, noise and weights")
    options = parser.parse_args(arguments)
    begin = time.perf_counter()
    result = train(options.steps, options.batch, options.seed)
    console = Console(highlight=False, width=100)
    first, last = (sum(part) / len(part) for part in (result["losses"][:5], result["losses"][-5:]))
    console.print(f"rms error of the first steps {first**0.5:.4f}, of the last {last**0.5:.4f} of full scale")
    for name, value in zip(("input", "restored", "after the model"), result["psnr"], strict=True):
        console.print(f"unseen clips {name}: {value:.2f} dB")
    console.print(f"{time.perf_counter() - begin:.1f} s")


if __name__ == "__main__":
    main()
