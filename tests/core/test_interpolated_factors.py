"""Interpolated factors against SciPy at every frequency."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.linalg import solveh_banded

from rsvib_torch.core.banded_solver import InterpolatedFactors, from_both_ends, node_frequencies, skew_band


def systems(count, width, frequencies, change):
    """Bands (K, b + 1, n, U) of two batches, whose logarithms of scale change by ``change`` over all frequencies."""
    generator = torch.Generator().manual_seed(1)
    band = torch.randn(count, width + 1, 2, 1, dtype=torch.complex128, generator=generator)
    band[:, 0] = band[:, 0].abs() + 2.5 * (width + 1)
    turn = torch.linspace(0, 1, frequencies, dtype=torch.float64)
    distance = torch.arange(width + 1, dtype=torch.float64)[None, :, None, None]
    scale = torch.exp(change * turn) * torch.exp(-0.3 * turn * distance)
    return band * scale * torch.exp(1j * turn * distance)


@pytest.mark.parametrize("width", [1, 5])
@pytest.mark.parametrize(("change", "tolerance"), [(0.0, 2e-3), (1.0, 5e-3)])
def test_agrees_with_scipy_between_the_nodes(width, change, tolerance):
    count, frequencies = 60, 101
    band = systems(count, width, frequencies, change)
    nodes = node_frequencies(frequencies, 8, torch.device("cpu"))
    assert len(nodes) < frequencies / 3
    factors = InterpolatedFactors.of(from_both_ends(skew_band(band[..., nodes].flatten(-2))).flatten(2), nodes, count)
    right = torch.randn(count, 3, 2, frequencies, dtype=torch.complex128)
    memory = None
    for part in (slice(0, 40), slice(40, 80), slice(80, 101)):
        memory = factors.at(part, memory)
        found = memory.solve(right[..., part].flatten(-2)).unflatten(-1, (2, -1))
        for batch in range(2):
            for k in range(part.start, part.stop):
                matrix = band[:, :, batch, k].numpy().T.copy()
                expected = solveh_banded(matrix, right[:, :, batch, k].numpy(), lower=True)
                error = np.abs(found[:, :, batch, k - part.start].numpy() - expected).max() / np.abs(expected).max()
                assert error < (1e-10 if k in nodes else tolerance)


def test_first_and_last_frequency_are_nodes():
    for count, step in ((2, 1.0), (50, 0.2), (1000, 34.0)):
        nodes = node_frequencies(count, step, torch.device("cpu")).tolist()
        assert (nodes[0], nodes[-1]) == (0, count - 1)
        assert all(0 < after - before <= max(1, step) for before, after in pairwise(nodes))


def test_memory_of_another_size_is_not_used():
    band = systems(12, 2, 9, 0.5)
    nodes = torch.arange(9)
    factors = InterpolatedFactors.of(from_both_ends(skew_band(band.flatten(-2))).flatten(2), nodes, 12)
    first = factors.at(slice(0, 4))
    assert factors.at(slice(4, 8), first) is first
    assert factors.at(slice(8, 9), first) is not first
