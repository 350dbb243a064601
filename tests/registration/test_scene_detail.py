"""Detail of the scene and noise from the mean of warped frames."""

import pytest
import torch

from rsvib_torch.registration.gradients import FrameComparison, scene_detail


def spectra_of(images):
    return torch.fft.rfft(images - images.mean((-2, -1), keepdim=True))


def smooth_scene(rows, columns):
    """Waves of up to 0.2 cycles/px along both axes, periodic along the rows, and their derivative across the rows."""
    across, along, phase = torch.rand(3, 40, 1, 1, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    y, x = torch.arange(rows)[:, None], torch.arange(columns)
    slope = 2 * torch.pi * (0.1 + 0.1 * across)
    angle = slope * y + 2 * torch.pi * ((0.2 * columns * along).round() / columns * x + phase)
    return angle.sin().sum(0), (slope * angle.cos()).sum(0)


@pytest.mark.parametrize("rows", [128, 256, 300])
def test_detail_and_its_gradient_equal_those_of_the_scene(rows):
    scene, slope = smooth_scene(rows, 192)
    noise = 0.02 * torch.randn(2, rows, 192, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    warped = spectra_of(scene + noise)[None]
    visible = torch.ones(1, 2, rows, dtype=torch.float64)
    halves = (slice(0, rows // 2), slice(rows // 2, rows))
    compared = FrameComparison.of(((part, warped[:, :, part]) for part in halves), visible)
    found = scene_detail(compared, torch.fft.rfftfreq(192, dtype=torch.float64))
    inner = slice(40, rows - 40)
    assert float(found[2]) < 1e-4  # px; the scene has no detail beyond half a cycle per px
    for images, truth in zip(found[:2], (scene, slope), strict=True):
        image = torch.fft.irfft(images[0], n=192)[inner]
        assert float((image - truth[inner]).std()) < 0.02 * float(truth[inner].std())


@pytest.mark.parametrize("num_frames", [2, 3])
def test_noise_of_the_mean_is_that_of_the_difference_of_two_frames(num_frames):
    """Rows that one frame or none contains have no difference."""
    warped = torch.randn(1, num_frames, 24, 33, generator=torch.Generator().manual_seed(2), dtype=torch.complex128)
    visible = torch.ones(1, num_frames, 24, dtype=torch.float64)
    visible[0, 0, :8] = visible[0, 1:, 4:12] = 0
    noise = FrameComparison.of([(slice(0, 24), warped)], visible).noise[0, :24]
    # the mean of n frames has 1 / n of the variance of the noise of a frame
    expected = (warped[0, -1] - warped[0, 0]) / (2 * num_frames) ** 0.5
    torch.testing.assert_close(noise[12:].abs(), expected[12:, ::4].abs())
    assert not noise[4:12].any()
