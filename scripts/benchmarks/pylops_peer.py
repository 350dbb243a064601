"""Restoration by CGLS on ``pylops.signalprocessing.NonStationaryConvolve2D``: a Lanczos-4 kernel for every 8 rows.

In that operator the source pixel selects the kernel. Here the output row does, so its adjoint, with flipped kernels,
forms the frame.
"""

import math
import time

import numba
import numpy as np
import torch
from benchmarks.restoration_peers import Peer, row_kernels
from pylops import LinearOperator
from pylops.optimization.cls_basic import CGLS
from pylops.signalprocessing import NonStationaryConvolve2D
from torch import Tensor

import rsvib_torch as rsv

ROWS_PER_KERNEL = 8
ITERATIONS, PATIENCE = 40, 4  # largest number, and number without a better result
DAMPINGS = (1e-3, 1e-2, 5e-2, 0.15, 0.4)


def frame_operator(
    shape: tuple[int, int], timing: rsv.SensorTiming, truth: rsv.Vibration, dtype: str = "float32"
) -> LinearOperator:
    """The operator that forms frame 0 of that shape from a scene of the same shape, zero outside."""
    numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
    height, width = shape
    rows = np.arange(ROWS_PER_KERNEL // 2, height, ROWS_PER_KERNEL)
    kernels = row_kernels(rows.astype(float), timing, truth, dtype)[:, ::-1, ::-1]
    bank = np.ascontiguousarray(np.stack([kernels, kernels], axis=1))
    operator = NonStationaryConvolve2D(
        dims=shape, hs=bank, ihx=tuple(rows.tolist()), ihz=(0, width - 1), dtype=dtype, engine="numba"
    )
    return operator.H


def cgls_restore(frame: np.ndarray, timing: rsv.SensorTiming, truth: rsv.Vibration, still: Tensor, rim: int) -> Peer:
    """Restore a frame with the damping and number of iterations of the highest PSNR; compilation is not timed."""
    operator = frame_operator(frame.shape, timing, truth)
    mean = float(frame.mean())
    data = (frame - mean).astype(np.float32).ravel()
    operator.H @ (operator @ data)
    truth_inside = still.numpy()[rim:-rim, rim:-rim]
    best, setting, error, seconds = frame, "", math.inf, 0.0
    for damping in DAMPINGS:
        solver, spent, since_best = CGLS(operator), 0.0, 0
        begin = time.perf_counter()
        x = solver.setup(data, damp=damping, tol=0.0)
        while solver.iiter < ITERATIONS and since_best < PATIENCE:
            x = solver.step(x)
            spent += time.perf_counter() - begin
            restored = x.reshape(frame.shape) + mean
            wrong = float(np.square(restored[rim:-rim, rim:-rim] - truth_inside).mean())
            since_best += 1
            if wrong < error:
                best, error, seconds, since_best = restored, wrong, spent, 0
                setting = f"damping {damping:g}, {solver.iiter} iterations"
            begin = time.perf_counter()
    return Peer(torch.from_numpy(best), seconds, setting)
