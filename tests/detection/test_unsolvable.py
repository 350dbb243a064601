"""Frames that do not determine a motion end in a result that is refused, or a ``ValueError`` in plain words."""

from contextlib import suppress

import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

SIZE = 128
TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=140)
ROWS, COLUMNS = torch.arange(SIZE)[:, None], torch.arange(SIZE)


def moving(draw):
    """Four frames of a drawing of rows and columns that moves by (2, 1) px per frame."""
    return torch.stack([draw(ROWS - index, COLUMNS - 2 * index) for index in range(4)]).float()


FRAMES = {
    "pixel": moving(lambda rows, columns: (rows == 60) & (columns == 50)),
    "checkerboard": moving(lambda rows, columns: (rows // 8 + columns // 8) % 2),
    "tiny": 1e-30 * torch.rand(4, SIZE, SIZE, generator=torch.Generator().manual_seed(0)),
}


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("function", [rsv.detect_vibration, rsv.detect_motion, rsv.detect_swept_tone])
def test_frames_that_do_not_determine_a_motion(function, name):
    reliable = torch.tensor(False)
    with suppress(ValueError):
        reliable = function(FRAMES[name], TIMING).reliable
    assert not reliable.any()


@pytest.mark.parametrize("function", [rsv.detect_motion, rsv.detect_swept_tone])
def test_one_frame_is_refused(function):
    with pytest.raises(ValueError, match="at least 2 frames"):
        function(torch.rand(1, SIZE, SIZE), TIMING)


def test_independent_noise_at_a_low_frame_rate_has_no_vibration():
    """Few rows agree by chance, and slow tones of many pixels explain them; without the verdict they are reliable."""
    noise = 0.5 + 0.1 * torch.randn(4, 256, 256, generator=torch.Generator().manual_seed(0))
    found = rsv.detect_vibration(noise, rsv.SensorTiming(50e-6, 10, 1600))
    assert not found.reliable.any()
    assert all("rows_not_registered" in [reason.code for reason in against] for against in found.findings)


def test_too_few_columns_name_the_remedy_that_helps():
    frames = torch.rand(2, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match=r"at least 64 x 96 are needed; reduce search, or use more columns$"):
        rsv.detect_vibration(frames, TIMING, columns=64)


def test_an_acceleration_that_is_no_free_motion_names_the_remedy():
    """The frames are 160 px apart at the end."""
    vibration = rsv.Vibration(0.0, 0.0, image_acceleration=(4000.0, 1000.0))
    timing = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=200)
    frames = rsv.simulate_frames(city_and_fields(640, 630, seed=3), timing, vibration, 12, frame_size=(160, 150))
    with pytest.raises(ValueError, match=r"constant acceleration detect_vibration\(..., image_acceleration=True\)"):
        rsv.detect_motion(frames, timing)
