import gc
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.linalg import solveh_banded

from rsvib_torch.core.banded_solver import BandedMemory, factor_banded, skew_band, solve_banded, solve_skewed
from rsvib_torch.restoration.scene_model.segments import Segments


def random_system(count, width, *, dtype=torch.complex128, batch=(3,), columns=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    band = torch.randn(count, width + 1, *batch, dtype=dtype, generator=generator)
    band[:, 0] = band[:, 0].abs() + 2.5 * (width + 1)
    return band, torch.randn(count, columns, *batch, dtype=dtype, generator=generator)


@pytest.mark.parametrize("width", [0, 1, 4, 13])
@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128])
@pytest.mark.parametrize("count", [1, 3, 40])
def test_agrees_with_scipy(count, width, dtype):
    band, right_side = random_system(count, width, dtype=dtype)
    found = solve_banded(band, right_side)
    for index in range(3):
        matrix = band[:, : min(width + 1, count), index].numpy().T.copy()
        expected = solveh_banded(matrix, right_side[..., index].numpy(), lower=True)
        np.testing.assert_allclose(found[..., index].numpy(), expected, rtol=1e-10, atol=1e-12)


def test_pivots_give_the_determinant():
    band, _ = random_system(6, 2, batch=(1,))
    dense = torch.zeros(6, 6, dtype=torch.complex128)
    for d in range(3):
        for k in range(6 - d):
            dense[k + d, k], dense[k, k + d] = band[k, d, 0], band[k, d, 0].conj()
    assert factor_banded(band).pivots.log().sum().item() == pytest.approx(torch.logdet(dense).real.item(), rel=1e-12)


def test_single_precision_residual():
    band, right_side = random_system(500, 6, batch=(20,))
    exact = solve_banded(band, right_side)
    single = solve_banded(band.to(torch.complex64), right_side.to(torch.complex64))
    assert (single - exact).abs().max() < 1e-6 * exact.abs().max()


@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128])
def test_gradients(dtype):
    band, right_side = random_system(5, 2, dtype=dtype, batch=(2,), columns=1)
    mask = torch.ones(5, 3, 1)
    for d in (1, 2):
        mask[5 - d :, d] = 0  # entries below the last row are not part of the matrix
    imaginary = torch.zeros_like(band)
    imaginary[:, 0] = band[:, 0].imag if dtype.is_complex else 0

    def solve(entries, columns):
        hermitian = entries * mask
        if dtype.is_complex:
            hermitian = torch.cat([hermitian[:, :1].real + 0j, hermitian[:, 1:]], dim=1)
        return solve_banded(hermitian, columns)

    assert torch.autograd.gradcheck(solve, (band.requires_grad_(), right_side.requires_grad_()))


def solved_in(segments, band, right_side):
    width = band.shape[1] - 1
    windows = segments.split(skew_band(band)[: len(band)]).flatten(-2)
    full = torch.cat([windows, windows.new_zeros(width, *windows.shape[1:])])
    solved = solve_skewed(full, segments.split(right_side).flatten(-2))
    return segments.join(solved.unflatten(-1, (-1, band.shape[-1])))


@pytest.mark.parametrize("count", [2, 3, 7])
def test_overlapping_segments_agree_with_scipy(count):
    rows, width = 211, 3
    band, right_side = random_system(rows, width)
    segments = Segments(rows, count, overlap=24)
    assert not segments.whole
    found = solved_in(segments, band, right_side)
    for index in range(3):
        expected = solveh_banded(band[..., index].numpy().T.copy(), right_side[..., index].numpy(), lower=True)
        np.testing.assert_allclose(found[..., index].numpy(), expected, rtol=0, atol=1e-8)
    wrong = solved_in(Segments(rows, count, overlap=1), band, right_side)
    assert (wrong - found).abs().max() > 1e-6


def test_segments_that_overlap_everywhere_are_one():
    assert Segments(100, 1).whole
    assert Segments(100, 4, 96).whole
    values = torch.rand(100, 2, 3)
    assert torch.equal(Segments(100, 4, 96).join(Segments(100, 4, 96).split(values)), values)


@pytest.mark.parametrize(("rows", "count", "overlap"), [(211, 3, 24), (97, 2, 8), (1000, 7, 60), (101, 4, 0)])
def test_windows_of_one_size_cover_all_rows(rows, count, overlap):
    segments = Segments(rows, count, overlap)
    windows = segments.windows
    assert (windows[0].start, windows[-1].stop, len(windows)) == (0, rows, count)
    assert {window.stop - window.start for window in windows} == {segments.size}
    shared = [before.stop - after.start for before, after in pairwise(windows)]
    assert min(shared) >= 2 * overlap
    assert segments.size <= (rows + 2 * overlap * (count - 1)) / count + 1
    values = torch.arange(rows * 6.0).reshape(rows, 2, 3)
    assert torch.equal(segments.join(segments.split(values)), values)


@pytest.mark.parametrize("width", [0, 1, 5])
def test_memory_serves_smaller_systems_too(width):
    band, right_side = random_system(40, width)
    memory = BandedMemory(40, width, 2, 3, right_side)
    for rows in (40, 13, 40, 29):  # what a larger system left does not matter
        memory.full[: rows + width] = skew_band(band[:rows])
        memory.right_side[:rows] = right_side[:rows]
        torch.testing.assert_close(memory.solve(rows), solve_banded(band[:rows], right_side[:rows]))
    assert memory.holds(29, width, 2, 3)
    assert not memory.holds(41, width, 2, 3)
    assert not memory.holds(29, width, 1, 3)
    assert not memory.holds(29, width + 1, 2, 3)


def test_views_are_made_without_a_search_for_garbage():
    runs = []
    gc.callbacks.append(lambda phase, info: runs.append(phase) if phase == "start" else None)
    try:
        memory = BandedMemory(3000, 4, 1, 2, torch.zeros(1))
        assert len(runs) <= 2  # one that was due, before it
        assert gc.isenabled()
        gc.disable()
        assert memory.holds(3000, 4, 1, 2)
        BandedMemory(30, 4, 1, 2, torch.zeros(1))
        assert not gc.isenabled()  # stays as it was
    finally:
        gc.enable()
        gc.callbacks.pop()
