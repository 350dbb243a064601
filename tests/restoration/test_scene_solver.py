"""Parts of the systems of a scene: windows of rows, chunks of frequencies, and the observation operator."""

from itertools import pairwise

import pytest
import torch

from rsvib_torch.restoration.exact.scene_solver import Partition, SceneSolver, join_windows, row_windows
from rsvib_torch.restoration.scene_model.observation import Observation, RowKernels
from rsvib_torch.restoration.scene_model.scene_prior import RowPrior


@pytest.mark.parametrize(("rows", "count", "overlap"), [(211, 3, 24), (97, 2, 8), (1000, 7, 60), (101, 4, 0)])
def test_windows_of_one_size_cover_all_rows(rows, count, overlap):
    windows = row_windows(rows, count, overlap)
    assert (windows[0].start, windows[-1].stop, len(windows)) == (0, rows, count)
    sizes = {window.stop - window.start for window in windows}
    assert len(sizes) == 1
    shared = [before.stop - after.start for before, after in pairwise(windows)]
    assert min(shared) >= 2 * overlap
    assert sizes.pop() <= (rows + 2 * overlap * (count - 1)) / count + 1
    values = torch.arange(rows * 6.0).reshape(rows, 2, 3)
    parts = torch.stack([values[window] for window in windows], dim=-2)
    parts[:overlap, :, 1:], parts[len(parts) - overlap :, :, :-1] = torch.nan, torch.nan  # too near to a border
    assert torch.equal(join_windows(parts, windows), values)


def smooth_prior(u):
    """Correlation 0.9 of neighbouring rows at all frequencies (1, U), and innovations of variance 1."""
    reflections = torch.stack([torch.full_like(u, 0.9), torch.zeros_like(u)])
    return RowPrior(1 / (1 - reflections[0].square()), reflections, torch.zeros_like(u)[None])


@pytest.mark.parametrize("first", [torch.arange(90) // 2 * 2, torch.arange(90).clamp(min=85) * 4 - 340])
def test_observation_operator_is_a_sum_over_taps_and_has_this_adjoint(first):
    generator = torch.Generator().manual_seed(3)
    taps = torch.randn(1, 90, 6, 2, dtype=torch.float64, generator=generator)
    along, middle = 0.3 * torch.randn(2, 1, 90, 2, dtype=torch.float64, generator=generator)
    weight = torch.rand(1, 90, dtype=torch.float64, generator=generator)
    weight[0, ::7] = 0
    kernels = RowKernels(first[None], taps, middle[..., 0], along, weight)
    part, length = slice(2, 13), 40
    observation = Observation(kernels, 90, length, torch.float64)
    u = torch.arange(part.start, part.stop, dtype=torch.float64) / length
    data = torch.randn(1, 1, 2, 90, 11, dtype=torch.complex128, generator=generator)
    coefficients = torch.randn(observation.count, 2, 1, 11, dtype=torch.complex128, generator=generator)
    observed = observation.forward(coefficients, part)
    turned = kernels.at(u)[0] * torch.exp(-2j * torch.pi * u * middle[0, :, :1])[:, None]
    for row in (0, 8, 44, 89):
        place = int(first[row]) - observation.top
        expected = (turned[row, :, None] * coefficients[place : place + 6, :, 0]).sum(0)
        torch.testing.assert_close(observed[0, 0, :, row], expected, rtol=1e-9, atol=1e-9)
    back = observation.adjoint(data, part)
    left = (weight[:, None, :, None] * observed.conj() * data).sum()
    torch.testing.assert_close(left, (coefficients.conj() * back).sum(), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("reach", [0.0, 0.4, 1.4])
def test_fast_path_agrees_with_the_plain_path(reach):
    """The plain path is used where the precision requires its gradient."""
    generator = torch.Generator().manual_seed(4)
    rows, length = 60, 1200
    taps = torch.rand(1, rows, 6, 2, dtype=torch.float64, generator=generator) / 6
    along = torch.linspace(-reach, reach, 2, dtype=torch.float64).expand(1, rows, 2)
    first = torch.arange(rows)[None] - 2
    kernels = RowKernels(first, taps, torch.zeros(1, rows, dtype=torch.float64), along, torch.ones_like(first).double())
    observation = Observation(kernels, rows, length, torch.float64)
    u = torch.fft.rfftfreq(length, dtype=torch.float64)[None]
    precision = smooth_prior(u).precision(0.01 * (1 + (10 * u).square()))
    data = torch.randn(1, 1, 1, rows, length, dtype=torch.float64, generator=generator)
    fast = SceneSolver(observation, precision, Partition(chunk=100)).fit(data)
    plain = SceneSolver(observation, precision.clone().requires_grad_(), Partition(chunk=100)).fit(data)
    assert plain.requires_grad
    difference = (fast - plain.detach()).abs().square().mean().sqrt() / plain.detach().abs().square().mean().sqrt()
    assert 1e-12 < difference < 1e-2  # interpolated, not factored: white noise is the least favourable data
    repeated = SceneSolver(observation, precision, Partition(chunk=100), keep=True)
    for _ in range(2):
        torch.testing.assert_close(repeated.fit(data), plain.detach())
