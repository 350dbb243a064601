"""Evidence beside the displacements of rows: the blur contradicts an exposure, halves that vibrate alike confirm."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from truth import Curve, Motion, recorded

from rsvib_torch import SensorTiming, detect_vibration

HEIGHT, WIDTH = 192, 160
TIMING = SensorTiming(row_time=1e-4, exposure_rows=30, frame_rows=300)
MOTION = Motion((4.0, 3.0), (47.0, 61.0), (0.4, 1.3))
ALL = {"blur_contradicts_exposure"}


def codes(found):
    return [{reason.code for reason in of_axis} for of_axis in found.findings]


@pytest.fixture(scope="module")
def frames():
    return recorded((HEIGHT, WIDTH), TIMING, MOTION, 8, 0.004, seed=3)


@pytest.mark.parametrize(("stated", "expected"), [(30.0, set()), (27.0, set()), (15.0, ALL), (0.1, ALL), (50.0, ALL)])
def test_an_exposure_is_refused_that_the_blur_contradicts(frames, stated, expected):
    """Stated far too short, the amplitude of 61 Hz is 5 % too small, with a standard deviation of 0.1 %."""
    found = detect_vibration(frames, replace(TIMING, exposure_rows=stated))
    assert codes(found) == [expected, expected]


def test_the_exposures_that_the_blur_agrees_with_are_stated(frames):
    found = detect_vibration(frames, TIMING)
    (text,) = (text for text in found.assumptions if "the blur agrees with" in text)
    low, high = map(float, re.search(r"agrees with ([\d.]+) to ([\d.]+):", text).groups())
    assert 15 < low < 30 < high < 45
    x = np.sinc(47.0 * 30e-4) / np.sinc(47.0 * np.array([low, high]) * 1e-4) - 1
    shown = re.search(r"x 47 Hz: amplitude (\S+) to (\S+) %", text).groups()
    np.testing.assert_allclose([float(value) / 100 for value in shown], x, rtol=0.1)


def beside(motions, num_frames):
    """Frames whose halves show scenes that move by motions of their own."""
    size = (HEIGHT, WIDTH)
    return torch.cat([recorded(size, TIMING, one, num_frames, 0.004, seed=n) for n, one in enumerate(motions)], -1)


def test_parallax_does_not_refuse_halves_that_vibrate_alike():
    """The right half travels by 0.15 px per frame."""
    moving = replace(MOTION, image_motion=(4.0, -3.0))
    found = detect_vibration(beside([MOTION, moving], 4), TIMING)
    assert codes(found) == [set(), set()]
    error = found.vibration.amplitude[:, 0].numpy() - MOTION.amplitude
    assert (np.abs(error) < 4 * found.std.amplitude[:, 0].numpy()).all()
    # two frames cannot tell parallax from a uniform roll
    assert "halves_apart" in set.union(*codes(detect_vibration(beside([MOTION, moving], 2), TIMING)))


@pytest.mark.parametrize("axis", [0, 1])
def test_halves_that_vibrate_differently_are_refused(axis):
    """By 0.1 px, as zoom (along x) and roll (along y) do."""
    size = np.eye(2)[axis] * 0.05

    def half(sign):
        return Curve(lambda times: MOTION.displacement(times) + sign * size * np.sin(2 * np.pi * 55.0 * times)[:, None])

    found = detect_vibration(beside([half(-1), half(1)], 4), TIMING, roll=False, zoom=False)
    assert "halves_apart" in set.union(*codes(found))
