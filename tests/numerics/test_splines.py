import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.interpolate import BSpline

from rsvib_torch.numerics.splines import (
    bspline_coefficients,
    bspline_weights,
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
