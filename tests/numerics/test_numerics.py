"""B-splines against SciPy, boundary extensions of rows, and banded systems."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from rsvib_torch.numerics.banded_solver import factor_banded, from_both_ends, solve_halves
from rsvib_torch.numerics.interpolation import (
    bspline_coefficients,
    bspline_weights,
    extend_rows,
    extended_length,
    mirrored,
)

DEGREES = (1, 3, 5, 9)


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("degree", DEGREES)
def test_weights_equal_those_of_scipy(degree):
    fraction = np.linspace(0, 1, 11)[:-1]
    basis = BSpline.basis_element(np.arange(degree + 2) - (degree + 1) / 2, extrapolate=False)
    taps = np.arange(degree + 1) - degree // 2
    expected = np.nan_to_num(basis(fraction[:, None] - taps))
    weights = bspline_weights(torch.from_numpy(fraction), degree).numpy()
    assert weights == pytest.approx(expected, abs=1e-14)
    assert weights.sum(-1) == pytest.approx(np.ones(10), abs=1e-14)


@pytest.mark.parametrize("degree", [3, 5])
@pytest.mark.parametrize("length", [2, 7, 40])
@pytest.mark.parametrize("dim", [-1, -2])
def test_coefficients_equal_those_of_scipy(degree, length, dim):
    samples = noise(length, 6) if dim == -2 else noise(6, length)
    expected = ndimage.spline_filter1d(samples.numpy(), order=degree, axis=dim, mode="mirror")
    found = bspline_coefficients(samples, degree, dim).numpy()
    assert found == pytest.approx(expected, abs=1e-7)
    assert np.abs(found - samples.numpy()).max() > 0.05


@pytest.mark.parametrize("length", [1, 2, 5])
def test_mirrored(length):
    expected = np.pad(np.arange(length), 7, mode="reflect") if length > 1 else np.zeros(15)
    assert mirrored(torch.arange(-7, length + 7), length).tolist() == expected.tolist()


@pytest.mark.parametrize("hold", [0.0, 0.25])
@pytest.mark.parametrize(("width", "length"), [(100, 160), (40, 200), (9, 64)])
def test_extended_rows_close_smoothly_into_a_period(width, length, hold):
    """The image is unchanged, and no step of the extension is steeper than the reflected image allows."""
    places = torch.arange(width, dtype=torch.float64)
    rows = torch.stack([0.05 * places, torch.sin(0.2 * places), 3.0 - 0.02 * places])
    period = extend_rows(rows, length, hold)
    assert period.shape == (3, length)
    assert torch.equal(period[:, :width], rows)
    steps = (period.roll(-1, -1) - period).abs()
    assert bool((steps[:, width - 1 :].amax(-1) < 0.25 + 0.2 * (rows[:, -1] - rows[:, 0]).abs()).all())
    slope = rows[:, -1] - rows[:, -2]
    torch.testing.assert_close(period[:, width] - rows[:, -1], slope, rtol=0, atol=0.02)


def test_held_share_of_the_gap_contains_one_end_only():
    """Content of the opposite end appears beyond a quarter of the gap only."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.rand(1, 64, generator=generator)
    other = rows.clone()
    other[:, :20] = 5.0
    length = extended_length(64, 8)
    quarter = (length - 64) // 4
    assert quarter >= 16
    held, changed = (extend_rows(images, length) for images in (rows, other))
    assert torch.equal(held[:, 64 : 64 + quarter], changed[:, 64 : 64 + quarter])
    assert not torch.equal(held[:, 64 + 2 * quarter :], changed[:, 64 + 2 * quarter :])
    assert extend_rows(rows, 64) is rows


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
def test_gradients_of_banded_systems(dtype):
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
