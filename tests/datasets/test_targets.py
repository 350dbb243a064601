"""Generated scenes: shapes compared with supersampling, and the requirements of registration."""

import math

import numpy as np
import pytest
import torch
from benchmarks.resolution_chart import bars, resolution_chart
from scipy.ndimage import gaussian_filter

from rsvib_torch.datasets import city_and_fields
from rsvib_torch.datasets.drawing import rectangle, rotated

SCENES = {"chart": resolution_chart, "city": lambda height, width: city_and_fields(height, width, seed=11)}


def blurred_shape(inside, size, sigma, fine=9):
    """A binary shape, sampled ``fine`` times per px, blurred, and evaluated at the pixel centres."""
    position = (np.arange(size * fine) - (fine - 1) / 2) / fine - size // 2
    hard = inside(position[None], position[:, None]).astype(np.float64)
    blurred = gaussian_filter(hard, sigma * fine, truncate=7)
    return blurred[fine // 2 :: fine, fine // 2 :: fine]


def pixel_grid(size):
    position = torch.arange(size, dtype=torch.float64) - size // 2
    return position[None], position[:, None]


def test_rotated_rectangle_is_exact_at_its_corners():
    angle, sigma = 0.3, 0.6
    drawn = rectangle(*rotated(*pixel_grid(41), angle), 9.3, 5.2, sigma).numpy()

    def inside(x, y):
        u, v = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
        return (abs(u) <= 9.3) & (abs(v) <= 5.2)

    np.testing.assert_allclose(drawn, blurred_shape(inside, 41, sigma), atol=0.004)


@pytest.mark.parametrize("frequency", [0.05, 0.21, 0.45])
def test_bars_keep_their_contrast_up_to_nyquist(frequency):
    x, _ = pixel_grid(61)
    drawn = bars(x[0] * frequency + 2.25, frequency, 5, 0.6).numpy()

    fine = 201
    cycles = ((np.arange(61 * fine) - fine // 2) / fine - 30) * frequency + 2.25
    hard = (cycles % 1.0 < 0.5) & (cycles >= 0) & (cycles < 4.5)
    expected = gaussian_filter(hard.astype(np.float64), 0.6 * fine, truncate=7)[fine // 2 :: fine]
    np.testing.assert_allclose(drawn, expected, atol=0.003)


@pytest.mark.parametrize("name", SCENES)
def test_scenes_are_band_limited(name):
    scene = SCENES[name](512, 512)

    def aliased(image):
        """Share of the variance beyond 0.45 cycles/px along either axis, with tapered borders."""
        taper = torch.hann_window(512)
        power = torch.fft.rfft2((image - image.mean()) * taper * taper[:, None]).abs().square()
        power[:, 1:-1] *= 2
        beyond = (torch.fft.fftfreq(512).abs()[:, None] > 0.45) | (torch.fft.rfftfreq(512) > 0.45)
        return float(power[beyond].sum() / power.sum())

    assert aliased(scene) < 0.003
    assert aliased((scene > scene.median()).float()) > 5 * aliased(scene)


def test_equal_seeds_give_equal_scenes():
    first = city_and_fields(200, 300, seed=1)
    assert torch.equal(first, city_and_fields(200, 300, seed=1))
    other = city_and_fields(200, 300, seed=2)
    assert np.corrcoef(first.flatten(), other.flatten())[0, 1] < 0.5
    assert torch.equal(resolution_chart(200, 300), resolution_chart(200, 300))
    random_state = torch.random.get_rng_state()
    city_and_fields(64, 64, seed=1)
    resolution_chart(64, 64)
    assert torch.equal(random_state, torch.random.get_rng_state())
