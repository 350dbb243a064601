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


def weights(axis_size, places):
    """(N, K) cubic B-splines at places in px, with knots every PITCH px from EDGE px before the frame on."""
    knots = np.arange(-EDGE - 3 * PITCH, axis_size + EDGE + 4 * PITCH, PITCH)
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
        yield 0.5 * share, weights(HEIGHT, seen_y), weights(WIDTH, seen_x)


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
    A = 0.0
    inner = slice(EDGE // PITCH - 4, 4 - EDGE // PITCH)  # 8 px beyond the frame
    for share, down, right in pixel_weights(truth):
        A = A + share * (down[:, inner, None] * right[:, None, inner]).reshape(len(down), -1)
    D = D - A @ (np.linalg.pinv(A.T @ A, rcond=1e-10, hermitian=True) @ (A.T @ D))
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


def recording_of(coefficients, truth):
    """The scene and the motion."""
    places = (np.arange(-EDGE, n + EDGE).astype(float) for n in (HEIGHT, WIDTH))
    down, right = (weights(n, p) for n, p in zip((HEIGHT, WIDTH), places, strict=True))
    scene = torch.from_numpy(down @ coefficients @ right.T)
    return scene, rsv.Vibration(*(truth[:, i].tolist() for i in range(4)))


def bound_of(coefficients, truth):
    scene, motion = recording_of(coefficients, truth)
    bound = cramer_rao_bound(scene, TIMING, motion, FRAMES, noise=NOISE, frame_size=(HEIGHT, WIDTH))
    return np.stack([getattr(bound, name).reshape(len(truth)).numpy() for name in FIELDS], 1)


@pytest.mark.slow
def test_bound_equals_the_numerical_fisher_matrix():
    """All parameters, with x and roll at the same frequency; the borders of 56 x 48 px are treated differently."""
    np.testing.assert_allclose(bound_of(drawn(), TRUTH) / numerical_bound(drawn(), TRUTH), 1.0, atol=0.07)


def test_bound_without_roll_is_smaller():
    """A tone of roll at the frequency of x is not distinguished from it by the displacement along x alone."""
    with_roll = bound_of(drawn(), TRUTH[:3])
    without = bound_of(drawn(), TRUTH[:2])
    assert (with_roll[:2] >= without * (1 - 1e-9)).all()
    assert with_roll[0, 0] > 1.02 * without[0, 0]


def test_roll_is_measured_by_the_displacement_along_columns():
    """Closed form for a wave along y: J = (2 pi v a)^2 / 4 noise^2 sum_x x^2 sum_rows d offset d offset'."""
    v, size, width, noise = 0.1, 0.2, 200, 0.01
    rows = np.arange(340.0)
    scene = torch.from_numpy(np.repeat(0.5 + size * np.sin(2 * np.pi * v * rows)[:, None], width + 40, 1))
    timing = rsv.SensorTiming(row_time=160e-6, exposure_rows=3, frame_rows=310)
    motion = rsv.Vibration([0.0, 0.0, 1e-3], [0.0, 0.0, 47.0], [0.0, 0.0, 0.7])
    bound = cramer_rao_bound(scene, timing, motion, noise=noise, frame_size=(300, width))

    def offset(values):
        a, f, p, drift = values
        middle = (rows[:300] + 1.5) * timing.row_time + np.array([[0.0], [timing.frame_period]])
        roll = a * np.sinc(f * timing.exposure_time) * np.sin(2 * np.pi * f * middle + p) + drift * middle
        return roll[1] - roll[0]

    truth, steps = np.array([1e-3, 47.0, 0.7, 0.0]), np.diag([1e-6, 1e-3, 1e-4, 1e-6])
    derivative = np.array([(offset(truth + e) - offset(truth - e)) / (2 * e.max()) for e in steps])
    squares = ((np.arange(width) - 0.5 * (width - 1)) ** 2).sum()
    information = (2 * np.pi * v * size / noise) ** 2 * squares / 4 * derivative @ derivative.T
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    found = [bound.amplitude[2, 0], bound.frequency[2, 0], bound.phase[2, 0], bound.image_motion[2]]
    np.testing.assert_allclose([float(value) for value in found], expected, rtol=0.02)
    assert torch.isinf(bound.image_motion[0])


def test_orientation():
    """The same camera, transposed and read in reverse."""
    scene, motion = recording_of(drawn(), TRUTH)
    turned = rsv.SensorTiming(TIMING.row_time, 3, 70, scan_axis="x", readout_direction="reverse")
    options = {"noise": NOISE}
    bound = cramer_rao_bound(scene, TIMING, motion, FRAMES, frame_size=(HEIGHT, WIDTH), **options)
    there, size = scene.flip(0).T.contiguous(), (WIDTH, HEIGHT)
    aside = cramer_rao_bound(there, turned, motion.from_row_order(turned), FRAMES, frame_size=size, **options)
    for name in FIELDS:
        torch.testing.assert_close(getattr(aside, name)[[1, 0, 2, 3]], getattr(bound, name), rtol=1e-6, atol=0)
