"""Frames that hardly determine a motion end in a result or in a one-line error.

No axis of independent noise may be reliable. Of ``detect_vibration``, a reliable axis must also have the right motion,
unless the frames are without noise, as none of a sensor are.
"""

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from attacks.trial import Trial
from attacks.warm import in_warm_child
from small_stack import TIMING
from torch import Tensor

import rsvib_torch as rsv

_FUNCTIONS = (rsv.detect_vibration, rsv.detect_motion)
_SIZE = 128  # px
# images of rows y, columns x and a random number n, which move by a few px per frame
_IMAGES: dict[str, Callable[[Tensor, Tensor, int], Tensor]] = {
    "constant": lambda y, x, n: 0 * (y + x) + n % 10 / 10,
    "pixel": lambda y, x, n: (y == n % 128) & (x == n // 7 % 128),
    "line of pixels": lambda y, x, n: (y == 20 + n % 88) & (x >= 0),
    "checkerboard": lambda y, x, n: (y // (2 + n % 9) + x // (2 + n % 9)) % 2,
    "stripes": lambda y, x, n: ((n % 7 - 3) * y + (1 + n % 5) * x) // 5 % 2,
    "ramp": lambda y, x, n: (y + n % 5 * x) / 1000,
    "step": lambda y, x, n: (x > 64) + 0 * y,
    "circle": lambda y, x, n: (y - 64) ** 2 + (x - 64) ** 2 < (5 + n % 40) ** 2,
    "waves": lambda y, x, n: 0.5 + 0.4 * torch.sin(0.1 * (1 + n % 25) * y) * torch.sin(0.2 * x),
    "noise": lambda y, x, n: torch.rand(2 * _SIZE, 2 * _SIZE),
    "rows of noise": lambda y, x, n: torch.rand(_SIZE, 1).expand(_SIZE, _SIZE),
    "columns of noise": lambda y, x, n: torch.rand(_SIZE).expand(_SIZE, _SIZE),
}
_NOISELESS = ", without noise"
_OF_CHANCE = ("noise", "columns of noise")  # other ones in every frame
_NOT_JUDGED = "rows of noise"  # bands of 32 equal rows correlate by chance, and the verdicts do not know it
_CHANGES: dict[str, Callable[[Tensor], Tensor]] = {
    "": lambda frames: frames + 1e-4 * torch.randn(frames.shape),
    _NOISELESS: lambda frames: frames,
    ", x 1e-30": lambda frames: (frames + 1e-4 * torch.randn(frames.shape)) * 1e-30,
    ", x 1e12": lambda frames: (frames + 1e-4 * torch.randn(frames.shape)) * 1e12,
    ", alternating brightness": lambda frames: (
        frames * torch.tensor([1.0, 0.01, 1.0, 0.01])[:, None, None] + 1e-4 * torch.randn(frames.shape)
    ),
    ", dark": lambda frames: frames * 0.0,
}


def _drawn(item: int) -> tuple[random.Random, str, str, Callable[..., Any]]:
    """Random numbers of a trial, its image and change, and the function that is called."""
    choice = random.Random(item)
    return choice, list(_IMAGES)[item % len(_IMAGES)], choice.choice(list(_CHANGES)), choice.choice(_FUNCTIONS)


def attempt(folder: Path, item: int) -> str:
    """Four frames and one function."""
    choice, kind, change, function = _drawn(item)
    torch.manual_seed(item)
    number, dy, dx = choice.randrange(1000), choice.randint(-3, 3), choice.randint(-3, 3)
    rows, columns = torch.arange(_SIZE)[:, None], torch.arange(_SIZE)
    frames = torch.stack([_IMAGES[kind](rows - i * dy, columns - i * dx, number).float() for i in range(4)])
    # slow tones of many pixels explain noise at a low frame rate
    frame_rows = choice.choice((300, 1600)) if kind == "noise" else 140
    timing = rsv.SensorTiming(TIMING.row_time, TIMING.exposure_rows, frame_rows)
    found = function(_CHANGES[change](frames), timing)
    if not found.reliable.any():
        return ""
    if kind in _OF_CHANCE:
        return f"noise is reliable: {found.reliable.tolist()}"
    if function is not rsv.detect_vibration or change == _NOISELESS or kind == _NOT_JUDGED:
        return ""
    times = timing.frame_starts(4)[:, None] + timing.row_time * torch.arange(_SIZE)
    error = found.vibration.displacement(times) - torch.tensor([dx, dy]) * times[..., None] / timing.frame_period
    error = (error - error.mean((0, 1))).square().mean((0, 1)).sqrt()
    allowed = 0.3 + 0.3 * torch.tensor([dx, dy]).abs()  # px; whole frames move, and not rows
    is_wrong = (error > allowed)[found.reliable].any()
    return f"reliable {found.reliable.tolist()}, error {error.tolist()} px" if is_wrong else ""


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """The images in turn; motion, change and function are random."""
    items = []
    for item in range(seed * 10**6, seed * 10**6 + count):
        _, kind, change, function = _drawn(item)
        items.append((f"{function.__name__}, {kind}{change}, seed {item}", item))
    yield from in_warm_child(attempt, items, folder)
