"""Residuals and degrees of freedom of sampled rows against dense matrices; choice of the strength of the prior."""

import numpy as np
import pytest
import torch
from truth import Motion, draw_scene, take_frames

from rsvib_torch import SensorTiming
from rsvib_torch.restoration.frame_motion import frame_motion
from rsvib_torch.restoration.scene_model.cross_validation import Explained, sample_rows, select_strengths
from rsvib_torch.restoration.scene_model.observation import row_kernels
from rsvib_torch.restoration.scene_model.scene_prior import fit_prior

NUM_ROWS, WIDTH, NOISE = 264, 240, 0.005


@pytest.fixture(scope="module", params=[20, 200])
def slab_data(request):
    """Two frames (2, 1, R, W), their kernels, the frequencies, and the precision of the prior at these frequencies."""
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=request.param, frame_rows=2048)
    clean = take_frames(draw_scene(NUM_ROWS + 80, WIDTH + 80, 3), timing, Motion(), 2)
    noise = NOISE * np.random.default_rng(2).standard_normal(clean.shape)
    frames = torch.from_numpy(clean + noise).float()[:, None]
    motion = frame_motion(Motion().vibration().expanded(1), timing, 2, NUM_ROWS)
    displacement, weights = motion.exposures
    kernels = row_kernels(displacement[0], weights, torch.ones(2), NUM_ROWS)
    prior = fit_prior(frames[None], motion, torch.full((1, 2), NOISE), WIDTH)
    chosen = np.arange(8, 120, 8)
    precision = prior.precision(torch.tensor([[NOISE**2]]), blur_reach=kernels.blur_reach)[..., chosen].numpy()
    assert frames.shape == (2, 1, NUM_ROWS, WIDTH)
    return frames, kernels, chosen, precision


def dense(frames, kernels, u, products, rows):
    """Residual power and degrees of freedom of one slab at one frequency, from dense matrices."""
    part = kernels.rows(rows.start, rows.stop - rows.start)
    taper = np.hanning(frames.shape[-1] + 2)[1:-1]
    waves = np.exp(-2j * np.pi * u * np.arange(frames.shape[-1]))
    lines = frames[:, 0, rows].double().numpy()
    data = ((lines - frames.double().mean((-2, -1), keepdim=True)[:, 0].numpy()) * taper) @ waves
    data = (data * np.exp(2j * np.pi * u * part.middle.numpy())).ravel()
    taps = part.at(torch.tensor([u], dtype=torch.float64))[..., 0].flatten(0, 1).numpy()
    first = part.first.flatten().numpy()
    count = first.max() - first.min() + taps.shape[1]
    matrix = np.zeros((len(data), count), dtype=complex)
    for row, (begin, kernel) in enumerate(zip(first - first.min(), taps, strict=True)):
        matrix[row, begin : begin + len(kernel)] = kernel
    # the precision of a stationary model: rows near the ends have fewer neighbours
    penalty = np.zeros((count, count))
    for row in range(count):
        for lag in range(min(3, count - row)):
            inner = min(row, count - 1 - row - lag, 2 - lag) + 1
            penalty[row, row + lag] = penalty[row + lag, row] = products[lag, :inner].sum()
    seen = matrix.conj().T @ matrix
    inverse = np.linalg.inv(seen + penalty)
    left = data - matrix @ (inverse @ (matrix.conj().T @ data))
    followed = np.linalg.solve(seen + 1.2**0.5 * penalty, seen)  # the middle of the step of the derivative
    return np.square(np.abs(left)).sum() / np.square(taper).sum(), np.trace(followed).real


@pytest.mark.parametrize("slab", [1000, 128, 80])
def test_slabs_are_fitted_independently(slab_data, slab):
    frames, kernels, chosen, precision = slab_data
    found = sample_rows(frames[None], kernels, chosen, slab).explain([precision, 0.25 * precision])
    number = max(1, NUM_ROWS // slab)
    height = NUM_ROWS // number
    assert found.count.tolist() == [2 * number * height]
    for place in (1, 6, 13):
        for index, factor in enumerate((1.0, 0.25)):
            products = factor * precision[..., 0, place]
            power, freedom = np.sum(
                [
                    dense(frames, kernels, float(chosen[place]) / WIDTH, products, slice(k * height, (k + 1) * height))
                    for k in range(number)
                ],
                axis=0,
            )
            assert found.power[index, 0, place] == pytest.approx(power, rel=0.01)
            assert found.freedom[index, 0, place] == pytest.approx(freedom, rel=0.01)


@pytest.mark.parametrize(
    ("errors", "expected", "calls"),
    [
        ([0.3, 0.0, 0.2, 0.5, 0.7, 0.9, 1.0], 1.0, [3]),
        ([0.9, 0.8, 0.6, 0.4, 0.1, 0.3, 0.5], 0.12, [3, 4]),
    ],
)
def test_weak_priors_are_tried_only_if_the_third_is_selected(errors, expected, calls):
    precisions = np.arange(7).reshape(7, 1, 1, 1, 1)
    tried = []

    def explain(some):
        tried.append(len(some))
        power = np.exp([errors[number.item()] for number in some])[:, None, None]
        return Explained(power, np.zeros_like(power), np.array([100]))

    assert select_strengths(precisions, np.array([True]), explain).tolist() == [expected]
    assert tried == calls
