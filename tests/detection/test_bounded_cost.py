"""What no vibration explains, or frames do not determine, is refused with a reason after few rounds of measuring."""

from contextlib import suppress
from dataclasses import replace

import pytest
import torch
from refusals import refuses

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.execution.progress import listening
from rsvib_torch.registration.methods import BAND_METHODS

SIZE = 192
TIMING = rsv.SensorTiming(row_time=1 / (24 * 1.15 * SIZE), exposure_rows=2, frame_rows=1.15 * SIZE)
VIBRATION = rsv.Vibration([1.5, 1.2], [53.0, 65.0], [0.4, 1.3])


def frames_of(vibration, seed=3):
    generator = torch.Generator().manual_seed(seed)
    noise = rsv.SensorNoise(read_noise=0.005)
    scene = city_and_fields(SIZE + 120, SIZE + 120, seed=seed)
    return rsv.simulate_frames(scene, TIMING, vibration, 4, frame_size=(SIZE, SIZE), noise=noise, generator=generator)


def detect(frames):
    """A detection, and the numbers of its rounds that measured whole rows and strips."""
    states = []
    with listening(lambda *state: states.append(state)):
        found = rsv.detect_vibration(frames, TIMING)
    begun = [unit for done, _, unit in states if done == 0]
    return found, begun.count("groups"), begun.count("groups of strips")


def test_plain_vibration_takes_few_rounds():
    found, rounds, rounds_of_strips = detect(frames_of(VIBRATION))
    assert found.reliable.all(), found.reasons
    assert 1 <= rounds <= 4
    assert rounds_of_strips == 0


def test_halves_that_move_apart_unlike_roll_are_refused_without_rounds_of_roll():
    left = frames_of(VIBRATION)
    right = frames_of(rsv.Vibration([1.5, 1.2], [53.0, 65.0], [0.4, 1.3], image_motion=[100.0, 70.0]))
    parallax = torch.cat([left[..., : SIZE // 2], right[..., SIZE // 2 :]], -1)
    found, _, rounds_of_strips = detect(parallax)
    assert not found.reliable.any()
    assert found.vibration.num_axes == 2
    assert "halves_apart" in {reason.code for of_axis in found.findings for reason in of_axis}
    assert rounds_of_strips == 0


def test_roll_takes_few_rounds():
    rolling = rsv.Vibration([1.5, 1.2, 0.005], [53.0, 65.0, 41.0], [0.4, 1.3, 0.2])
    found, _, rounds_of_strips = detect(frames_of(rolling))
    assert found.reliable.tolist() == [True, True, True], found.reasons
    assert 1 <= rounds_of_strips <= 4


def test_motion_that_no_tones_explain_is_refused_after_few_rounds():
    generator = torch.Generator().manual_seed(2)
    frequency, phase = (torch.rand(2, 40, generator=generator, dtype=torch.float64) for _ in range(2))
    walk = rsv.Vibration(1.5 / (4 + 80 * frequency), 2 + 40 * frequency, 6 * phase)
    found, rounds, rounds_of_strips = detect(frames_of(walk))
    assert not found.reliable.any()
    assert rounds <= 10  # of the stated timing, and of another one if one is tried
    assert rounds_of_strips <= 3


@pytest.mark.parametrize(
    ("factor", "remedy"), [(1e3, "may be ms"), (1e6, "may be us"), (1e9, "may be ns"), (3e4, "that follow each other$")]
)
def test_frames_far_apart_are_refused_with_the_unit_that_is_likely(factor, remedy):
    """Four frames that are 60 s apart took 2.4 GB, and more memory than any computer has beyond."""
    starts = tuple(factor * TIMING.frame_period * index for index in range(4))
    far = replace(TIMING, frame_start_times=starts)
    frames = frames_of(VIBRATION)
    refuses(lambda: rsv.detect_vibration(frames, far), rf"frames are .* s apart and .*{remedy}")
    refuses(lambda: rsv.detect_motion(frames, far), remedy)


SMALL = 128
SMALL_TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=140)
ROWS, COLUMNS = torch.arange(SMALL)[:, None], torch.arange(SMALL)


def moving(draw):
    """Four frames of a drawing of rows and columns that moves by (2, 1) px per frame."""
    return torch.stack([draw(ROWS - index, COLUMNS - 2 * index) for index in range(4)]).float()


FRAMES = {
    "pixel": moving(lambda rows, columns: (rows == 60) & (columns == 50)),
    "checkerboard": moving(lambda rows, columns: (rows // 8 + columns // 8) % 2),
    "tiny": 1e-30 * torch.rand(4, SMALL, SMALL, generator=torch.Generator().manual_seed(0)),
}


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("function", [rsv.detect_vibration, rsv.detect_motion])
def test_frames_that_do_not_determine_a_motion(function, name):
    reliable = torch.tensor(False)
    with suppress(ValueError):
        reliable = function(FRAMES[name], SMALL_TIMING).reliable
    assert not reliable.any()


@pytest.mark.parametrize(
    ("function", "options", "frame_rows", "draw", "shape", "seed"),
    [
        (rsv.detect_vibration, {}, 1600, torch.randn, (4, 256, 256), 0),  # slow tones of many pixels explain some rows
        (rsv.detect_motion, {}, 160, torch.rand, (4, 128, 128), 4),  # so does a spline, and leaves no residual
        (rsv.detect_motion, {}, 288, torch.rand, (4, 256, 256), 3),
        *(
            (rsv.detect_vibration, {"method": "bands", "registration": name}, 2048, torch.randn, (2, 1024, 256), 1)
            for name in BAND_METHODS
        ),
    ],
)
def test_independent_noise_has_no_motion(function, options, frame_rows, draw, shape, seed):
    """Some rows agree by chance."""
    noise = 0.5 + 0.1 * draw(shape, generator=torch.Generator().manual_seed(seed))
    found = function(noise, rsv.SensorTiming(50e-6, 10, frame_rows), **options)
    assert not found.reliable.any()
    assert all("rows_not_registered" in [reason.code for reason in against] for against in found.findings)


def test_an_acceleration_that_is_no_free_motion_names_the_remedy():
    """The frames are 160 px apart at the end."""
    vibration = rsv.Vibration(0.0, 0.0, image_acceleration=(4000.0, 1000.0))
    timing = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=200)
    frames = rsv.simulate_frames(city_and_fields(640, 630, seed=3), timing, vibration, 12, frame_size=(160, 150))
    message = r"constant acceleration detect_vibration\(..., image_acceleration=True\)"
    refuses(lambda: rsv.detect_motion(frames, timing), message)
