"""Recorded motion from CSV files, and the errors of wrong files and options."""

import math

import numpy as np
import pytest
import torch
from refusals import refuses

from rsvib_torch import read_motion

CLOCK = np.arange(0.0, 1.0, 0.005)


def write(path, columns, names="time,x,y"):
    rows = [",".join(f"{value:.12g}" for value in row) for row in np.stack(columns, -1)]
    path.write_text("\n".join([names, *rows]) + "\n")
    return path


@pytest.mark.parametrize(("unit", "size"), [("rad", 1.0), ("mrad", 1e-3), ("urad", 1e-6), ("deg", math.pi / 180)])
def test_angles_are_converted_to_pixels(tmp_path, unit, size):
    x, y = 0.01 * np.sin(9 * CLOCK), 0.02 * np.cos(5 * CLOCK)
    path = write(tmp_path / "a.csv", (CLOCK, x / size, y / size))
    motion = read_motion(path, unit=unit, focal_length=1000.0)
    expected = 1000 * np.tan(np.stack([x - x.mean(), y - y.mean()], -1))
    expected = expected - expected.mean(0)
    assert np.allclose(motion.displacement(torch.from_numpy(CLOCK)).numpy(), expected, atol=1e-3)


def test_rates_are_integrated(tmp_path):
    x, y = 0.01 * np.sin(9 * CLOCK), 0.02 * np.cos(5 * CLOCK)
    rates = np.degrees(0.09 * np.cos(9 * CLOCK)), np.degrees(-0.1 * np.sin(5 * CLOCK))
    path = write(tmp_path / "a.csv", (CLOCK, CLOCK, *rates), " Time (s), other, X(deg/s), y")
    motion = read_motion(path, unit="deg/s", focal_length=1000.0)
    found = motion.displacement(torch.from_numpy(CLOCK)).numpy()
    assert np.allclose(found[:, 0] - found[:, 0].mean(), 1000 * (x - x.mean()), atol=0.02)
    assert np.allclose(found[:, 1] - found[:, 1].mean(), 1000 * (y - y.mean()), atol=0.02)


def changed(place, time):
    clock = CLOCK.copy()
    clock[place] = time
    return clock


@pytest.mark.parametrize(
    ("clock", "values", "options", "message"),
    [
        (changed(7, 0.001), CLOCK, {}, "times must increase, but sample 8"),
        (np.concatenate([CLOCK[:50], CLOCK[60:]]), CLOCK[10:], {}, r"gap of 0\.055 s after 0\.245 s"),
        (CLOCK, changed(4, np.nan), {}, "line 6: x must be a number"),
        (1e3 * CLOCK, CLOCK, {}, "times must be in s"),
        (CLOCK, 20 * CLOCK, {"unit": "rad", "focal_length": 1000}, "check unit='rad'"),
        (CLOCK, CLOCK, {"unit": "rad"}, "needs a focal_length"),
        (CLOCK[:3], CLOCK[:3], {}, "3 samples"),
    ],
)
def test_errors_name_the_problem(tmp_path, clock, values, options, message):
    path = write(tmp_path / "a.csv", (clock, values, values))
    refuses(lambda: read_motion(path, **{"unit": "px", **options}), message)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_motion(tmp_path / "none.csv", unit="px")
    with pytest.raises(ValueError, match="column 'y' is missing; the first line has time, x"):
        read_motion(write(tmp_path / "a.csv", (CLOCK, CLOCK), "time,x"), unit="px")
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00 picture")
    refuses(lambda: read_motion(tmp_path / "b.csv", unit="px"), r"b\.csv")
    (tmp_path / "c.csv").write_text("")
    refuses(lambda: read_motion(tmp_path / "c.csv", unit="px"), "first line has nothing")
