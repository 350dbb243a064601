"""Noise beneath the texture of one frame, told by how the spectrum flattens."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from truth import draw_scene

from rsvib_torch.restoration.noise.noise_floor import noise_floor
from rsvib_torch.restoration.noise.single_frame import estimate_noise


def fractal(steepness, optics, size=320, seed=5):
    """Texture whose amplitude falls like a power of the frequency, through Gaussian optics."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    frequency[0, 0] = np.inf
    noise = np.random.default_rng(seed).standard_normal((size, size))
    texture = np.fft.irfft2(np.fft.rfft2(noise) / frequency**steepness, (size, size))
    return 0.5 + 0.15 * ndimage.gaussian_filter(texture / texture.std(), optics, mode="wrap")


def with_noise(scene, level, seed=0):
    return torch.from_numpy(scene + level * np.random.default_rng(seed).standard_normal(scene.shape)).float()


def floor_of(image):
    return noise_floor(image).sqrt().item()


@pytest.mark.parametrize("level", [1e-4, 0.02])
@pytest.mark.parametrize("shape", [(64, 64), (200, 90), (700, 500)])
def test_white_noise(shape, level):
    noise = level * torch.randn(shape, generator=torch.Generator().manual_seed(2))
    assert floor_of(0.3 + noise) == pytest.approx(level, rel=0.1 if min(shape) > 64 else 0.3)


@pytest.mark.parametrize(
    ("steepness", "level", "texture_adds"), [(1.0, 0.02, 1.2), (1.5, 0.005, 1.09), (1.5, 0.002, 1.4)]
)
def test_texture_is_told_from_noise(steepness, level, texture_adds):
    image = with_noise(fractal(steepness, 0.5), level)
    assert estimate_noise(image).item() > texture_adds * level
    assert 0.6 * level < floor_of(image) < 0.5 * (level + estimate_noise(image).item())


@pytest.mark.parametrize("optics", [0.5, 0.7])
def test_texture_without_noise_has_hardly_any(optics):
    image = with_noise(fractal(1.0, optics), 0.0)
    assert floor_of(image) < 0.5 * estimate_noise(image).item()


def test_edges_and_flat_ground():
    assert floor_of(with_noise(draw_scene(320, 320, 3), 0.005)) == pytest.approx(0.005, rel=0.15)


def test_each_image_by_itself_and_in_proportion():
    one, two = with_noise(fractal(1.5, 0.5), 0.005), with_noise(fractal(2.0, 0.5, seed=6), 0.02)
    found = noise_floor(torch.stack([one, two])[None])
    assert found.shape == (1, 2)
    torch.testing.assert_close(found[0], torch.stack([noise_floor(one), noise_floor(two)]), rtol=1e-4, atol=0)
    torch.testing.assert_close(noise_floor(3 * one), 9 * noise_floor(one), rtol=1e-4, atol=0)


def test_pieces_with_ignored_pixels_do_not_count():
    image = with_noise(fractal(1.5, 0.5), 0.01)
    hidden = torch.zeros(image.shape, dtype=torch.bool)
    hidden[:, 200:] = True
    filled = image.masked_fill(hidden, 0.5)
    assert noise_floor(filled, hidden).sqrt().item() == pytest.approx(0.01, rel=0.1)
    assert noise_floor(filled).sqrt().item() < 0.85 * 0.01
    assert noise_floor(filled, torch.ones_like(hidden)).isnan()


def test_small_and_empty_images():
    assert noise_floor(torch.rand(2, 63, 200)).isnan().all()
    assert noise_floor(torch.zeros(64, 64)) == 0
