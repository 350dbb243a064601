"""The periodogram by transforms of unequal times, compared with a least-squares fit for each frequency."""

import math
import tracemalloc

import numpy as np
import pytest

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.periodogram import strongest_frequencies

EXPOSURE = 4e-4


def measurements_of(rows, frames, seed=0):
    """Random displacements and weights of rows that some frames do not contain, at unequal times."""
    random = np.random.default_rng(seed).random
    starts = 3e-4 * np.arange(rows)[:, None] + 0.04 * np.arange(frames) + 2e-5 * random((1, rows, frames))
    visible = (random((1, rows, frames)) > 0.1).astype(float)
    information = (0.1 + random((1, rows, 2, 1))) * np.eye(2)
    record = Measurements(starts, np.zeros((1, rows, frames, 2)), visible, information, EXPOSURE)
    values = record.relative(random((1, rows, frames, 2)) - 0.5)
    return Measurements(starts, values, visible, information, EXPOSURE)


def decrease(record, weight, frequency, axis):
    """Decrease of the weighted square by cosine, sine (with their prior) and drift, from the normal equations."""
    time = record.middles[0, ..., 0, 0]
    size = math.sin(math.pi * frequency * EXPOSURE) / (math.pi * frequency * EXPOSURE)
    angle = 2 * math.pi * frequency * time
    columns = np.stack([size * np.cos(angle), size * np.sin(angle), time], -1)
    columns = record.relative(columns[None])[0].reshape(-1, 3)
    weights = (weight[:, None] * record.visible[0]).ravel()
    prior = 0.5 * 0.1**2 * float((weight * record.num_differences[0]).sum())
    normal = columns.T @ (weights[:, None] * columns) + np.diag([prior, prior, 0.0])
    right = columns.T @ (weights * record.displacements[0, ..., axis].ravel())
    return float(right @ np.linalg.solve(normal, right))


@pytest.mark.parametrize(("rows", "frames"), [(40, 2), (60, 5)])
def test_strongest_frequencies_are_those_of_least_squares_fits(rows, frames):
    record = measurements_of(rows, frames)
    weights = np.stack([record.weights, record.weights[:, ::-1]], 1)
    found = strongest_frequencies(record, 6e-4, 1, 1, weights)
    step = 1 / (8 * (float(record.duration[0]) + 6e-4))
    frequencies = [step * place for place in range(4, int(0.5 / 6e-4 / step) + 1)]
    for weighting in range(2):
        for axis in range(2):
            power = [decrease(record, weights[0, weighting, :, axis], frequency, axis) for frequency in frequencies]
            assert float(found[0, weighting, axis, 0]) == pytest.approx(frequencies[power.index(max(power))])


def test_memory_does_not_grow_with_stacks_and_weightings():
    record = measurements_of(20, 3)
    many = record.repeated(4)
    weights = many.weights[:, None].repeat(3, 1)
    expected = strongest_frequencies(record, 2e-7, 1, 2, record.weights[:, None])
    tracemalloc.start()
    found = strongest_frequencies(many, 2e-7, 1, 2, weights)  # 109,000 frequencies
    _, largest = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_array_equal(found, np.broadcast_to(expected, found.shape))
    assert largest < 150e6  # bytes; all 12 at a time take 500 MB
