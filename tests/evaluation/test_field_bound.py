"""Cramér-Rao bound with roll and zoom, against the numerical Fisher matrix of an independent simulator."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

import rsvib_torch as rsv
from rsvib_torch.evaluation import cramer_rao_bound

TIMING = rsv.SensorTiming(row_time=400e-6, exposure_rows=3, frame_rows=70)
HEIGHT, WIDTH, EDGE, PITCH, FRAMES, NOISE = 56, 48, 24, 2, 3, 0.01
FIELDS = ("amplitude", "frequency", "phase", "image_motion")
# rows: amplitude, frequency, phase and image motion of x, y, roll and zoom; x and roll have the same frequency
TRUTH = np.array([[0.7, 43.0, 0.4, 3.0], [0.9, 58.0, 1.1, -4.0], [0.02, 43.0, 2.0, 0.0], [0.015, 51.0, 0.7, 0.0]])


def weights(values, axis_size, places):
    """(N, K) cubic B-splines at places in px, with knots every PITCH px from EDGE px before the frame on."""
    knots = np.arange(-EDGE - 3 * PITCH, axis_size + EDGE + 4 * PITCH, PITCH)
    del values
    return BSpline.design_matrix(places.ravel(), knots.astype(float), 3).toarray()


def pixel_weights(truth):
    """Quadrature weights with the spline weights (N, K) along y and x of all pixels of all frames."""
    nodes, shares = np.polynomial.legendre.leggauss(4)
    frame, row, column = np.mgrid[:FRAMES, :HEIGHT, :WIDTH].astype(float)
    for node, share in zip(nodes, shares, strict=True):
        times = TIMING.row_time * (frame * TIMING.frame_rows + row + 0.5 * (node + 1) * TIMING.exposure_rows)
        x, y, roll, zoom = (a * np.sin(2 * np.pi * f * times + p) + v * times for a, f, p, v in truth)
        right, down = column - 0.5 * (WIDTH - 1) - x, row - 0.5 * (HEIGHT - 1) - y
        scale = 1 + zoom
        seen_x = (scale * right + roll * down) / (scale**2 + roll**2) + 0.5 * (WIDTH - 1)
        seen_y = (scale * down - roll * right) / (scale**2 + roll**2) + 0.5 * (HEIGHT - 1)
        yield 0.5 * share, weights(truth, HEIGHT, seen_y), weights(truth, WIDTH, seen_x)


def frames_of(coefficients, truth):
    return sum(s * np.einsum("nk,kl,nl->n", down, coefficients, right) for s, down, right in pixel_weights(truth))


def numerical_bound(coefficients, truth):
    """Standard deviations in the layout of TRUTH, with unknown spline coefficients of the scene."""
    derivatives = []
    used = np.array([a > 0 or i == 3 for a in truth[:, 0] for i in range(4)])
    for number in np.flatnonzero(used):
        step = np.zeros(truth.size)
        step[number] = 1e-4 * max(abs(truth.flat[number]), 0.01)
        up, down = (frames_of(coefficients, truth + sign * step.reshape(truth.shape)) for sign in (1, -1))
        derivatives.append((up - down) / (2 * step[number]))
    D = np.stack(derivatives, 1)
    A = sum(s * (down[:, :, None] * right[:, None, :]).reshape(len(down), -1) for s, down, right in pixel_weights(truth))
    D = D - A @ np.linalg.lstsq(A, D, rcond=1e-8)[0]
    found = np.zeros(truth.size)
    scale = np.sqrt((D**2).sum(0))
    found[used] = NOISE * np.sqrt(np.diag(np.linalg.inv((D / scale).T @ (D / scale)))) / scale
    return found.reshape(truth.shape)


def drawn(seed=3):
    """Spline coefficients of a smooth scene."""
    shape = [len(np.arange(-EDGE - 3 * PITCH, n + EDGE + 4 * PITCH, PITCH)) - 4 for n in (HEIGHT, WIDTH)]
    generator = np.random.default_rng(seed)
    v, u = np.meshgrid(np.fft.fftfreq(shape[0]), np.fft.rfftfreq(shape[1]), indexing="ij")
    spectrum = np.fft.rfft2(generator.standard_normal(shape)) * np.exp(-((np.hypot(u, v) / 0.16) ** 2))
    values = np.fft.irfft2(spectrum, s=shape)
    return 0.5 + 0.15 * values / values.std()


def bound_of(coefficients, truth, method):
    places = (np.arange(-EDGE, n + EDGE).astype(float) for n in (HEIGHT, WIDTH))
    down, right = (weights(None, n, p) for n, p in zip((HEIGHT, WIDTH), places, strict=True))
    scene = torch.from_numpy(down @ coefficients @ right.T)
    motion = rsv.Vibration(*(truth[:, i].tolist() for i in range(4)))
    bound = cramer_rao_bound(scene, TIMING, motion, FRAMES, noise=NOISE, frame_size=(HEIGHT, WIDTH), method=method)
    return np.stack([getattr(bound, name).reshape(len(truth)).numpy() for name in FIELDS], 1)


if __name__ == "__main__":
    import time
    for truth in (TRUTH[:2], TRUTH[:3], TRUTH):
        b = time.time()
        full = np.zeros((4, 4)); full[:len(truth)] = truth
        c = drawn()
        num = numerical_bound(c, truth) if len(truth) == 4 else None
        print(time.time()-b)
        if num is None:
            continue
        for m in ("projection", "gradients"):
            print(m, bound_of(c, truth, m) / num)
