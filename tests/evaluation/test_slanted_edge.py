"""Slanted-edge MTF against the analytic MTF of optics and square pixels."""

import math

import numpy as np
import pytest
import torch
from edge_truth import OPTICS, draw_edge, draw_edge_of, gaussian, mtf50_of, through_pixels
from refusals import refuses
from scipy.integrate import dblquad
from scipy.special import ndtr

import rsvib_torch as rsv

FREQUENCIES = torch.linspace(0.1, 0.5, 41, dtype=torch.float64)


def measure(image):
    return rsv.slanted_edge_mtf(torch.from_numpy(np.ascontiguousarray(image)))


def worst_error(curve, mtf):
    return np.abs(curve.at(FREQUENCIES).numpy() - mtf(FREQUENCIES.numpy())).max()


def test_reference_edge_is_the_integral_over_the_pixel():
    image, angle = draw_edge(5.3, 0.5, (9, 9), (0.0, 1.0), (0.2, 0.1)), np.deg2rad(5.3)
    for row, column in ((4, 4), (2, 5), (7, 3)):
        x, y = column - 4.2, row - 4.1
        exact = dblquad(
            lambda v, u: ndtr((u * np.cos(angle) + v * np.sin(angle)) / 0.5), x - 0.5, x + 0.5, y - 0.5, y + 0.5
        )[0]
        assert image[row, column] == pytest.approx(exact, abs=1e-8)


@pytest.mark.parametrize(
    ("angle", "turned", "levels", "sigma"),
    [
        (4.0, False, (0.1, 0.9), 0.5),
        (-5.0, False, (0.9, 0.1), 0.8),
        (5.71, True, (0.1, 0.9), 0.5),
        (-7.0, True, (0.9, 0.1), 0.8),
        (20.0, False, (0.2, 0.6), 0.8),
    ],
)
def test_gaussian_optics_without_noise(sigma, angle, turned, levels):
    image = draw_edge(angle, sigma, levels=levels)
    curve = measure((image.T if turned else image).astype(np.float32))
    truth = through_pixels(gaussian(sigma), angle)
    assert worst_error(curve, truth) < 2e-6
    assert float(curve.mtf50) == pytest.approx(mtf50_of(truth), rel=2e-6)
    assert float(curve.at(float(curve.mtf50))) == pytest.approx(0.5, abs=1e-9)
    assert abs(curve.angle) == pytest.approx(abs(angle), abs=1e-4)
    assert curve.near_vertical is not turned
    assert curve.levels.tolist() == pytest.approx(sorted(levels), abs=1e-6)
    torch.testing.assert_close(curve.at(curve.frequency), curve.mtf, rtol=0, atol=1e-12)


def test_noise_of_one_percent():
    errors, predicted, pulls = [], [], []
    for seed, sigma in enumerate((0.5, 0.8) * 3):
        generator = np.random.default_rng(seed)
        angle = generator.uniform(4, 7) * generator.choice([-1, 1])
        truth = through_pixels(gaussian(sigma), angle)
        image = draw_edge(angle, sigma, offset=generator.uniform(-0.5, 0.5, 2))
        curve = measure(image + 0.008 * generator.standard_normal(image.shape))
        errors.append(float(curve.mtf50) / mtf50_of(truth) - 1)
        predicted.append(float(curve.mtf50_std / curve.mtf50))
        pulls.append((curve.at(0.25) - truth(0.25)) / np.interp(0.25, curve.frequency, curve.std))
        assert float(curve.noise) == pytest.approx(0.008, rel=0.04)
    assert np.sqrt(np.mean(np.square(errors))) < 0.0045
    # a fit of the true model, with blur, edge and levels unknown, cannot do better than 0.32 and 0.27 %
    assert 0.0024 < np.sqrt(np.mean(np.square(predicted))) < 0.0040
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.7


@pytest.mark.parametrize("name", OPTICS)
def test_optics_of_any_shape(name):
    truth = through_pixels(OPTICS[name], 5.2)
    image = draw_edge_of(OPTICS[name], 5.2)
    curve = measure(image)
    assert worst_error(curve, truth) < 3e-4
    assert float(curve.mtf50) == pytest.approx(mtf50_of(truth), rel=3e-4)
    if "diffraction" in name:  # its scattered light decreases the MTF near frequency 0, where the window ends
        np.testing.assert_allclose(curve.at(torch.tensor([0.002, 0.005])), truth(np.array([0.002, 0.005])), atol=2e-4)
    noisy = measure(image + 0.008 * np.random.default_rng(1).standard_normal(image.shape))
    assert worst_error(noisy, truth) < 0.015
    assert float(noisy.mtf50) == pytest.approx(mtf50_of(truth), rel=0.03)


def test_standard_deviations_contain_light_beyond_the_roi():
    optics = OPTICS["diffraction, cut-off 0.6 cycles/px"]
    truth, image = through_pixels(optics, 5.2), draw_edge_of(optics, 5.2)
    errors, pulls = [], []
    for seed in range(3):
        curve = measure(image + 0.008 * np.random.default_rng(seed).standard_normal(image.shape))
        shown = slice(2, 51)  # 0.02 ... 0.5 cycles/px
        errors.append((curve.mtf.numpy() - truth(curve.frequency.numpy()))[shown])
        pulls.append(errors[-1] / curve.std.numpy()[shown])
    assert np.sqrt(np.mean(np.square(errors))) < 0.008
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 2.0


def test_rotation_mirroring_and_inversion_do_not_change_the_result():
    image = draw_edge(5.2, 0.6) + 0.008 * np.random.default_rng(5).standard_normal((120, 80))
    curve = measure(image)
    turned = {"quarter turn": np.rot90(image), "mirrored": image[:, ::-1], "inverted and scaled": 43.0 - 40.0 * image}
    for name, other in turned.items():
        found = measure(other)
        torch.testing.assert_close(found.mtf, curve.mtf, rtol=0, atol=1e-9, msg=name)
        torch.testing.assert_close(found.mtf50, curve.mtf50, rtol=0, atol=1e-9, msg=name)
        torch.testing.assert_close(found.std, curve.std, rtol=1e-5, atol=1e-9, msg=name)


def test_the_angle_is_positive_clockwise():
    upright = draw_edge(-5.0, 0.6)
    # an edge that leans to the right (its column is larger at the top) has a positive angle
    top, bottom = (np.abs(upright[row] - 0.5).argmin() for row in (5, -5))
    curve = measure(upright)
    assert math.copysign(1, curve.angle) == math.copysign(1, top - bottom)
    assert measure(np.rot90(upright, -1)).angle == pytest.approx(curve.angle, abs=1e-6)
    assert measure(upright[:, ::-1]).angle == pytest.approx(-curve.angle, abs=1e-6)


def shaded(noise):
    y, x = np.mgrid[-1:1:120j, -1:1:80j]
    image = draw_edge(5.0, 0.8) * (1 + 0.15 * x + 0.1 * y)
    return image + noise * np.random.default_rng(2).standard_normal(image.shape)


def with_shot_noise():
    """Black has no noise."""
    image = torch.from_numpy(draw_edge(5.0, 0.8, levels=(0.0, 0.8)))
    return rsv.SensorNoise(full_well=20000).apply(image, torch.Generator().manual_seed(1)).numpy()


@pytest.mark.parametrize(("image", "error"), [(shaded(0.0), 1e-5), (shaded(0.005), 5e-3), (with_shot_noise(), 0.01)])
def test_shading_and_shot_noise_do_not_affect_the_mtf(image, error):
    assert float(measure(image).mtf50) == pytest.approx(mtf50_of(through_pixels(gaussian(0.8), 5.0)), rel=error)


def test_curved_edge():
    y, x = np.mgrid[:120, :80].astype(float)
    radius = 900.0  # curvature of 2 px over the ROI
    distance = radius - np.hypot(x - 40 - radius * np.cos(0.09), y - 60 - radius * np.sin(0.09))
    curve = measure(ndtr(distance / 0.8))
    truth = gaussian(0.8)
    assert worst_error(curve, truth) < 1e-3
    assert float(curve.mtf50) == pytest.approx(mtf50_of(truth), rel=1e-3)


def test_integer_images():
    counts = 200 * (draw_edge(5.0, 0.8) + 0.008 * np.random.default_rng(3).standard_normal((120, 80)))
    curve = measure(counts.round().astype(np.uint8))
    torch.testing.assert_close(curve.mtf, measure(counts).mtf, rtol=0, atol=2e-3)
    assert curve.levels.tolist() == pytest.approx([20.0, 180.0], abs=0.2)


def test_mtf_above_one_half_has_no_mtf50():
    y, x = np.mgrid[:120, :80]
    sharp = 0.1 + 0.8 * ndtr(
        (x - 40 + 0.1 * (y - 60)) / math.hypot(1, 0.1) / 0.15
    )  # point samples without integration over pixels
    curve = measure(sharp)
    assert float(curve.at(0.5)) == pytest.approx(gaussian(0.15)(0.5), abs=0.02)
    assert math.isnan(float(curve.mtf50))
    assert math.isnan(float(curve.mtf50_std))


NOISE = 0.008 * np.random.default_rng(0).standard_normal((120, 80))


def torn_by_a_vibration():
    generator = torch.Generator().manual_seed(99)
    y, x = torch.meshgrid(torch.arange(24) - 12.0, torch.arange(20) - 10.0, indexing="ij")
    size, rate, phase = torch.rand(3, generator=generator).tolist()
    shift = (2 + 4 * size) * torch.sin(y * (0.1 + 0.4 * rate) + 6 * phase)
    return (torch.sigmoid((x + 0.15 * y + shift) / 0.5) + 0.01 * torch.randn(24, 20, generator=generator)).numpy()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (NOISE, r"no edge: a straight edge explains 0 % of the variance, expected at least 50 %"),
        (draw_edge(1.5, 0.5), r"not slanted enough: 1\.50 degrees .* expected 2 \.\.\. 40"),
        (draw_edge(43.0, 0.5, (90, 90)), r"too close to 45 degrees: 43\.00"),
        (draw_edge(5.0, 0.5, (15, 80)), "at least 16 x 16 px, got 15 x 80"),
        (draw_edge(2.5, 0.5, (18, 80)), r"crosses 0\.79 px over 18 px of length"),
        (draw_edge(5.0, 0.5, offset=(33.0, 0.0)), r"within 1\.\d px of the border of the roi, expected at least 4\.0"),
        (
            np.where((np.arange(120)[:, None] > 100) & (np.arange(80) > 60), 0.4, draw_edge(5.0, 0.5)),
            r"more than one edge: [3-6]\d % of its contrast near 1\d\d px along and [67]\d px across",
        ),
        (np.clip(draw_edge(5.0, 0.5, levels=(0.0, 0.9)) + NOISE, 0, 1), "dark side of the edge is clipped: 5. %"),
        (np.clip(draw_edge(5.0, 0.5, levels=(0.1, 1.0)) + NOISE, 0, 1), "bright side .* clipped: 5. %"),
        ((255 * (draw_edge(5.0, 0.5, levels=(0.1, 1.2)) + NOISE)).clip(0, 255).astype("u1"), "bright .* exactly 255"),
        (np.where(np.arange(80) == 3, np.nan, draw_edge(5.0, 0.5)), "must be finite, got 120 pixels"),
        (draw_edge(5.0, 0.5)[None], r"one grey image \(h, w\), got shape \(1, 120, 80\)"),
        (np.broadcast_to(np.abs(np.linspace(-20, 20, 41)), (60, 41)), "no edge: both sides"),  # a bar
        (draw_edge(5.0, 0.5) + draw_edge(5.0, 0.5)[:, ::-1], "edge"),
        (torn_by_a_vibration(), "do not follow one edge"),
    ],
)
def test_bad_input(image, message):
    refuses(lambda: measure(image), message)


def test_tensors_and_arrays_of_numbers():
    counts = (1000 * draw_edge(5.0, 0.5)).astype(">u2")[:, ::-1]
    mirrored = rsv.slanted_edge_mtf(counts)
    numbers = rsv.slanted_edge_mtf(torch.from_numpy(counts.astype(np.int32)))
    torch.testing.assert_close(mirrored.mtf50, numbers.mtf50, rtol=1e-9, atol=0)
    refuses(lambda: rsv.slanted_edge_mtf("edge.png"), "roi must be a tensor or array of numbers, got str", TypeError)
    refuses(lambda: measure(draw_edge(5.0, 0.5) > 0.5), r"real numbers, got torch\.bool", TypeError)
    curve = measure(draw_edge(5.0, 0.5))
    refuses(lambda: curve.at(1.2), "frequency must be at most 1")
    refuses(lambda: curve.at(torch.tensor([0.2, -0.1])), r"within 0 \.\.\. 1 cycles/px")
