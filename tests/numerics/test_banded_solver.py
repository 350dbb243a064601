import numpy as np
import pytest
import torch
from scipy.linalg import solveh_banded

from rsvib_torch.numerics.banded_solver import factor_banded, from_both_ends, solve_halves


def random_system(count, width, *, dtype=torch.complex128, batch=(3,), columns=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    band = torch.randn(count, width + 1, *batch, dtype=dtype, generator=generator)
    band[:, 0] = band[:, 0].abs() + 2.5 * (width + 1)
    return band, torch.randn(count, columns, *batch, dtype=dtype, generator=generator)


def skewed_halves(band):
    """The system of a lower band (K, b + 1, S), ``band[k, d] = A[k + d, k]``, as ``solve_halves`` takes it."""
    count, diagonals, size = band.shape
    width = diagonals - 1
    skewed = band.new_zeros(count + width, 2 * width + 1, size)
    skewed[:count, width] = band[:, 0].real if band.is_complex() else band[:, 0]
    for d in range(1, min(diagonals, count)):
        skewed[d:count, width - d] = band[: count - d, d]
        skewed[: count - d, width + d] = band[: count - d, d].conj()
    return from_both_ends(skewed).flatten(2)


def solve_banded(band, right_side):
    return solve_halves(skewed_halves(band), right_side)


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


@pytest.mark.parametrize("width", [0, 2])
def test_stored_factors_give_the_same_solution(width):
    band, right_side = random_system(7, width)
    factor = factor_banded(skewed_halves(band), 7)
    expected = solve_banded(band, right_side)
    for _ in range(2):
        torch.testing.assert_close(solve_halves(factor, right_side), expected)
    assert torch.autograd.gradcheck(lambda columns: solve_halves(factor, columns), (right_side.requires_grad_(),))
