"""Restoration by deepinv: ``TiledSpaceVaryingBlur`` and its ``least_squares``, a Lanczos-4 kernel for every 8 rows.

Tiles are as wide as the frame and overlap; the scene is larger than the frame by the size of the kernels.
"""

import math
import time

import einops  # noqa: F401 - TiledSpaceVaryingBlur imports it only when it is used
import torch
from benchmarks.restoration_peers import Peer, row_kernels
from deepinv.optim.linear import least_squares
from deepinv.physics import TiledSpaceVaryingBlur
from torch import Tensor

import rsvib_torch as rsv

TILE_ROWS, TILE_STEP = 16, 8
ITERATIONS = (3, 10, 30, 60)
DAMPINGS = (1e-3, 1e-2, 2e-2, 0.1, 0.3)


def frame_physics(shape: tuple[int, int], timing: rsv.SensorTiming, truth: rsv.Vibration) -> TiledSpaceVaryingBlur:
    """The operator that forms frame 0 of that shape from the scene that its kernels cover."""
    height, width = shape
    reach = row_kernels(torch.zeros(1).numpy(), timing, truth, "float32").shape[-2:]
    scene = height + reach[0] - 1, width + reach[1] - 1
    tile, step = (TILE_ROWS, scene[1]), (TILE_STEP, scene[1])
    count, _ = TiledSpaceVaryingBlur.num_filters(scene, tile, step)
    middles = torch.arange(count, dtype=torch.float64) * TILE_STEP + 0.5 * (TILE_ROWS - 1) - 0.5 * (reach[0] - 1)
    kernels = row_kernels(middles.numpy(), timing, truth, "float32")
    return TiledSpaceVaryingBlur(torch.from_numpy(kernels)[None, None], patch_size=tile, stride=step)


def tiled_restore(frame: Tensor, timing: rsv.SensorTiming, truth: rsv.Vibration, still: Tensor, rim: int) -> Peer:
    """Restore a frame by conjugate gradients, with the damping and number of iterations of the highest PSNR."""
    height, width = frame.shape
    physics = frame_physics((height, width), timing, truth)
    top, left = ((size - 1) // 2 for size in physics.filters.shape[-2:])
    mean = frame.mean()
    data = (frame - mean)[None, None]
    inner = (slice(rim, -rim), slice(rim, -rim))
    best, error = None, math.inf
    for damping in DAMPINGS:
        for iterations in ITERATIONS:
            begin = time.perf_counter()
            found = least_squares(
                physics.A, physics.A_adjoint, data, gamma=damping**-2, solver="CG", max_iter=iterations, tol=1e-8
            )
            restored = found[0, 0, top : top + height, left : left + width] + mean
            seconds = time.perf_counter() - begin
            wrong = float((restored - still)[inner].square().mean())
            if wrong < error:
                best, error = Peer(restored, seconds, f"damping {damping:g}, {iterations} iterations"), wrong
    if best is None:
        raise ValueError("deepinv: no setting gives finite values")
    return best
