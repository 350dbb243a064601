"""Groups of similar patches, on edges and waves that are drawn without the package."""

import numpy as np
import pytest
import torch
from truth import decibel

from rsvib_torch.frames.mosaic import colours_of, interpolated_colours, measures
from rsvib_torch.restoration.exact.similar_patches import similar_patches

SIZE = 64


def drawn():
    """A coloured disc, a slanted wave of 0.3 cycles per px and a ramp, (1, 3, H, W)."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] - SIZE / 2
    disc = np.clip(18 - np.hypot(x, y), 0, 1)
    wave = 0.1 * np.cos(2 * np.pi * (0.28 * x + 0.1 * y))
    return np.stack([0.3 + 0.4 * disc + wave, 0.4 + 0.2 * disc + wave, 0.5 - 0.2 * disc + wave + 0.002 * x])[None]


def noisy_mosaic(noise):
    colours = colours_of("GBRG", SIZE, SIZE)[None, None]
    measured = measures(colours)
    clean = (torch.from_numpy(drawn()) * measured).sum(1, keepdim=True)
    return (clean + noise * torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))).float(), colours


@pytest.mark.parametrize(("noise", "gain"), [(0.002, 6.0), (0.02, 3.0)])
def test_colours_of_a_mosaic(noise, gain):
    mosaic, colours = noisy_mosaic(noise)
    linear = interpolated_colours(mosaic, colours)
    found = similar_patches(linear, mosaic.expand_as(linear), measures(colours)[0], noise, rounds=8, steps=6)
    assert decibel(found, drawn(), 8) > decibel(linear, drawn(), 8) + gain


def test_noise_and_units():
    noise = 0.01
    images = torch.from_numpy(drawn()).float()
    images = images + noise * torch.randn(images.shape, generator=torch.Generator().manual_seed(1))
    found = similar_patches(images, images, None, noise, rounds=2, steps=2)
    assert decibel(found, drawn(), 8) > decibel(images, drawn(), 8) + 4
    scaled = similar_patches(4000 * images, 4000 * images, None, 4000 * noise, rounds=2, steps=2)
    assert torch.allclose(scaled / 4000, found, atol=1e-3)


@pytest.mark.parametrize("shape", [(1, 3, 8, 8), (2, 3, 32, 12)])
def test_constant_and_small_images(shape):
    constant = torch.full(shape, 0.25)
    found = similar_patches(constant, constant, None, 0.01, rounds=1, steps=2)
    assert torch.allclose(found, constant)
    random = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    found = similar_patches(random, random, None, 1e-6, rounds=1, steps=2)
    assert torch.allclose(found, random, atol=0.01)
