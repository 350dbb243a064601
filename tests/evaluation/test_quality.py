"""Image quality compared with scikit-image, offset errors compared with explicit values."""

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rsvib_torch.evaluation import psnr, ssim


def smooth_pair(shape, seed, noise=0.05):
    """An image with structure at several scales and a degraded copy of it."""
    generator = torch.Generator().manual_seed(seed)
    white = torch.randn(shape, generator=generator, dtype=torch.float64)
    frequency = torch.fft.fftfreq(shape[-2])[:, None].square() + torch.fft.rfftfreq(shape[-1]).square()
    image = torch.fft.irfft2(torch.fft.rfft2(white) / (0.02 + frequency.sqrt()), s=shape[-2:])
    image = 0.5 + 0.15 * image / image.std()
    degraded = image.roll(1, -1) + noise * torch.randn(shape, generator=generator, dtype=torch.float64)
    return image, degraded


def reference_ssim(image, reference, data_range):
    return structural_similarity(
        image.numpy(),
        reference.numpy(),
        data_range=data_range,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )


@pytest.mark.parametrize("data_range", [1.0, 4095.0])
def test_each_image_of_a_stack_agrees_with_scikit_image(data_range):
    scene, degraded = (data_range * t for t in smooth_pair((3, 61, 84), seed=4))
    degraded[1] = (
        0.3 * degraded[1] + 0.7 * scene[1]
    )  # an average over the stack would give the same value for all three images
    wanted_psnr = [
        peak_signal_noise_ratio(s.numpy(), d.numpy(), data_range=data_range)
        for s, d in zip(scene, degraded, strict=True)
    ]
    wanted_ssim = [reference_ssim(d, s, data_range) for s, d in zip(scene, degraded, strict=True)]
    np.testing.assert_allclose(psnr(degraded, scene, data_range).numpy(), wanted_psnr, rtol=1e-12)
    np.testing.assert_allclose(ssim(degraded, scene, data_range).numpy(), wanted_ssim, rtol=0, atol=1e-12)
    assert np.ptp(wanted_psnr) > 5
    assert np.ptp(wanted_ssim) > 0.1


def test_excluding_the_rim_equals_cropping():
    scene, degraded = smooth_pair((60, 70), seed=5)
    degraded[:4] = 0.0
    degraded[:, -5:] = 1.0
    inner = (slice(5, -5), slice(5, -5))
    expected = reference_ssim(degraded[inner], scene[inner], 1.0)
    assert ssim(degraded, scene, 1.0, rim=5).item() == pytest.approx(expected, abs=1e-12)
    assert ssim(degraded, scene, 1.0).item() < expected - 0.02
    expected = peak_signal_noise_ratio(scene[inner].numpy(), degraded[inner].numpy(), data_range=1.0)
    assert psnr(degraded, scene, 1.0, rim=5).item() == pytest.approx(expected, rel=1e-12)


def test_channels_belong_to_their_image():
    scene, degraded = smooth_pair((2, 2, 3, 40, 30), seed=6)
    degraded[1, 0] = scene[1, 0] + 0.1
    assert psnr(degraded, scene, 1.0).shape == ssim(degraded, scene, 1.0).shape == (2, 2)
    assert psnr(degraded, scene, 1.0)[1, 0].item() == pytest.approx(20.0)
    expected = np.mean([reference_ssim(degraded[0, 1, c], scene[0, 1, c], 1.0) for c in range(3)])
    assert ssim(degraded, scene, 1.0)[0, 1].item() == pytest.approx(expected, abs=1e-12)
    assert ssim(degraded[0], scene[0], 1.0)[1].item() == pytest.approx(expected, abs=1e-12)


def test_identical_images():
    scene, _ = smooth_pair((2, 40, 30), seed=8)
    frames = torch.stack([scene[0], scene[1] + 0.1])
    assert psnr(frames, scene, 1.0).isinf().tolist() == [True, False]
    assert ssim(frames, scene, 1.0)[0].item() == pytest.approx(1.0, abs=1e-14)
    assert ssim(torch.zeros(20, 20), torch.zeros(20, 20), 1.0).item() == 1.0


@pytest.mark.parametrize(("level", "contrast"), [(0.0, 1.0), (0.9, 0.02)])
def test_float32_is_accurate_and_integers_are_exact(level, contrast):
    scene, degraded = (level + contrast * t for t in smooth_pair((64, 64), seed=9))
    pair = degraded.float(), scene.float()
    assert ssim(*pair, 1.0).item() == pytest.approx(reference_ssim(degraded, scene, 1.0), abs=1e-5)
    assert ssim(*pair, 1.0).dtype == psnr(*pair, 1.0).dtype == torch.float64
    counts = [(4095 * t.clamp(0, 1)).round().to(torch.int32) for t in pair]
    expected = peak_signal_noise_ratio(*(t.numpy() for t in counts), data_range=4095)
    assert psnr(*counts, 4095).item() == pytest.approx(expected, rel=1e-9)
    expected = reference_ssim(*(t.double() for t in counts), 4095)
    assert ssim(*counts, 4095).item() == pytest.approx(expected, abs=1e-12)
