import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rsvib_torch import RowVaryingBlur, SensorTiming, Vibration, row_psf
from rsvib_torch.imaging import RowPSF, blur_rows, blur_rows_adjoint

PAPER = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
LONG = SensorTiming(row_time=20e-6, exposure_rows=400, frame_rows=2048)
MOTION = Vibration([3.1, 5.2], [50.0, 30.0], [0.4, 1.3], [120.0, -40.0])


def literal_kernel(start, timing, size, centre):
    """Eqs. (25) to (39) as loops over samples and taps."""
    amplitude, frequency, phase, speed = (3.1, 5.2), (50.0, 30.0), (0.4, 1.3), (120.0, -40.0)
    count = int(timing.exposure_rows)
    kernel = np.zeros(size)
    for i in range(1, count + 1):
        t = start + (i - 0.5) * timing.row_time
        x, y = (
            a * math.sin(2 * math.pi * f * t + p) + v * t
            for a, f, p, v in zip(amplitude, frequency, phase, speed, strict=True)
        )
        x_min, y_min = math.floor(x), math.floor(y)
        taps = {
            (x_min, y_min): (x_min + 1 - x) * (y_min + 1 - y),
            (x_min, y_min + 1): (x_min + 1 - x) * (y - y_min),
            (x_min + 1, y_min): (x - x_min) * (y_min + 1 - y),
            (x_min + 1, y_min + 1): (x - x_min) * (y - y_min),
        }
        for (column, row), weight in taps.items():
            kernel[row + centre, column + centre] += weight / count
    return kernel


@pytest.mark.parametrize("timing", [PAPER, LONG])
@pytest.mark.parametrize("row", [0, 17, 900, 2047])
def test_kernel_is_equations_26_to_39(timing, row):
    starts = timing.row_starts(2, 2048)
    psf = row_psf(MOTION, starts, timing)
    expected = literal_kernel(starts[1, row].item(), timing, (41, 41), 20)
    kernel = np.zeros((41, 41))
    x, y = (20 + psf.first_tap[1, row]).tolist()
    height, width = psf.weights.shape[-2:]
    kernel[y : y + height, x : x + width] = psf.weights[1, row].numpy()
    assert np.abs(kernel - expected).max() < 1e-12


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("quadrature", ["midpoint", "gauss"])
@pytest.mark.parametrize("timing", [PAPER, LONG, replace(PAPER, exposure_rows=0.5), replace(PAPER, exposure_rows=2.5)])
def test_centroid_is_the_mean_displacement(interpolation, quadrature, timing):
    """The kernel displaces the image by Eq. (2) and conserves its flux."""
    starts = timing.row_starts(2, 2048)
    psf = row_psf(MOTION, starts, timing, interpolation=interpolation, quadrature=quadrature)
    expected = MOTION.mean_displacement(starts, timing.exposure_time)
    # the midpoint rule has an error of (2 pi f T_row)^2 A / 24; Gauss nodes are exact
    limit = 1e-5 if quadrature == "midpoint" else 1e-8
    assert (psf.centroid() - expected).abs().max() < limit
    assert (psf.weights.sum((-2, -1)) - 1).abs().max() < 1e-12
    assert bool((psf.weights >= -1e-15).all())


SMALL = SensorTiming(row_time=20e-6, exposure_rows=6, frame_rows=64)


def small_psf(interpolation, rows=14, batch=None):
    """Of a motion with large differences between the rows of a small frame."""
    starts, amplitude = SMALL.row_starts(1, rows)[0], torch.tensor([[3.3], [2.4]], dtype=torch.float64)
    if batch is not None:
        starts = starts.expand(batch, -1)
        amplitude = amplitude * torch.linspace(0.4, 1.3, batch, dtype=torch.float64)[:, None, None]
    motion = Vibration(amplitude, [[2000.0], [1300.0]], [[0.4], [1.1]], [900.0, -700.0])
    return row_psf(motion, starts, SMALL, interpolation=interpolation)


def noise(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_output_row_selects_its_kernel(interpolation):
    """Inside its boundaries the frame is the double sum over taps in each row."""
    psf = small_psf(interpolation)
    scene = noise(46, 50)
    frame = blur_rows(scene, psf)
    samples = scene
    if interpolation == "cubic":
        from scipy import ndimage

        samples = torch.from_numpy(ndimage.spline_filter(scene.numpy(), order=3, mode="mirror"))
    for r in range(14):
        x, y = psf.first_tap[r].tolist()
        for c in (16, 23, 33):
            total = sum(
                psf.weights[r, j, k] * samples[16 + r - y - j, c - x - k]
                for j in range(psf.weights.shape[-2])
                for k in range(psf.weights.shape[-1])
            )
            assert frame[r, c].item() == pytest.approx(total.item(), abs=1e-7)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("scene_lead", [(), (3,), (2, 1), (2, 3)])
def test_adjoint_of_batches(interpolation, scene_lead):
    """<A x, y> = <x, A^T y>."""
    psf = small_psf(interpolation, batch=3)
    scene = noise(*scene_lead, 24, 28, seed=1)
    frame = blur_rows(scene, psf)
    lead = torch.broadcast_shapes(scene_lead, (3,))
    assert frame.shape == (*lead, 14, 28)
    other = noise(*frame.shape, seed=2)
    back = blur_rows_adjoint(other, psf, tuple(scene.shape))
    assert back.shape == scene.shape
    assert (frame * other).sum().item() == pytest.approx((scene * back).sum().item(), rel=1e-11)
    for index in range(3):
        one = RowPSF(psf.first_tap[index], psf.weights[index], psf.degree)
        expected = blur_rows(scene.expand(*lead, 24, 28)[..., index, :, :], one)
        torch.testing.assert_close(frame[..., index, :, :], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_gradients(interpolation):
    psf = small_psf(interpolation, rows=5)
    scene = noise(9, 8).requires_grad_()
    frame = noise(5, 8).requires_grad_()
    assert torch.autograd.gradcheck(lambda s: blur_rows(s, psf), scene)
    assert torch.autograd.gradcheck(lambda g: blur_rows_adjoint(g, psf, (9, 8)), frame)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_gradients_to_the_vibration(interpolation):
    timing = SensorTiming(row_time=1e-3, exposure_rows=3, frame_rows=12)
    scene = torch.rand(9, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    values = [[0.83, 0.61], [21.0, 33.0], [0.3, 1.0], [11.0, -7.0]]
    parameters = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in values]

    def frame(amplitude, frequency, phase, image_motion):
        vibration = Vibration(amplitude, frequency, phase, image_motion)
        psf = row_psf(vibration, timing.row_starts(1, 7)[0], timing, interpolation=interpolation)
        return RowVaryingBlur(psf)(scene)

    assert torch.autograd.gradcheck(frame, parameters)
    gradients = torch.autograd.grad(frame(*parameters).sin().sum(), parameters)
    assert all(gradient.abs().min() > 1e-6 for gradient in gradients)
