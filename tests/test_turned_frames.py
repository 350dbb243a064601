"""Results do not depend on the orientation of the sensor in the frames, nor on other stacks of a batch."""

import math
from dataclasses import replace
from functools import cache, partial

import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=160)
MOTIONS = [rsv.Vibration([a, 1.2], [87.0, 131.0], [0.4, 1.3], [30.0, -20.0]) for a in (1.6, 1.3)]
TIMES = torch.linspace(0, 0.04, 60, dtype=torch.float64)


def moved(motion):
    return motion.displacement(TIMES.expand(*motion.batch_shape, -1))


def detected(frames, timing, method):
    found = rsv.detect_vibration(frames, timing, method=method, tones=1)
    return {"vector": moved(found.vibration), "size": found.std.amplitude[..., :1].mT}


def free(frames, timing, _):
    found = rsv.detect_motion(frames, timing)
    return {"vector": found.displacement, "size": found.std}


def tracked(frames, timing, _):
    tracker = rsv.VibrationTracker(timing, columns=None)
    *_, last = [tracker.update(frame) for frame in frames]
    return {"vector": moved(last.detection.vibration), "image": last.restored}


def judged(frames, timing, motion):
    """Of a motion whose larger amplitude is wrong."""
    wrong = motion.scaled(1 - 0.5 * (motion.amplitude[:, 0] > 1.4))
    verdict = rsv.judge_restoration(frames, rsv.restore(frames, timing, wrong, check=False), timing, wrong)
    return {"size": verdict.misfit_after}


def augmented(frames, timing, motion):
    ranges = {"amplitude": motion.amplitude, "frequency": motion.frequency, "phase": motion.phase}
    ranges = {name: tuple((v, v) for v in values[:, 0].tolist()) for name, values in ranges.items()}
    return {"image": rsv.RollingShutterVibration(timing, **ranges)(frames[:, None])}


def restored(frames, timing, motion, **options):
    return {"image": rsv.restore(frames, timing, motion, check=False, **options)}


# Functions of frames, timing and the true motion, their tolerance, and whether they accept batches.
FUNCTIONS = {
    "detect_vibration": (lambda f, t, _: detected(f, t, "direct"), 3e-3, True),
    "detect_vibration, bands": (lambda f, t, _: detected(f, t, "bands"), 1e-3, True),
    "detect_motion": (free, 1e-3, True),
    "tracker": (tracked, 1e-4, False),
    "judge_restoration": (judged, 1e-3, False),
    "RollingShutterVibration": (augmented, 1e-4, False),
    "restore, exact": (restored, 1e-4, True),
    "restore, banded": (partial(restored, method="banded"), 1e-4, True),
    "restore, dewarp": (partial(restored, method="dewarp"), 1e-4, True),
    "restore, richardson-lucy": (partial(restored, method="richardson-lucy", iterations=3), 1e-4, True),
} | {
    f"register_bands, {name}": (
        lambda f, t, _, m=name: {"vector": rsv.register_bands(f, t, method=m).offsets},
        2e-4,
        True,
    )
    for name in ("projection", "ncc", "phase")
}


@pytest.fixture(scope="module", name="stacks")
def take_stacks():
    """Two stacks of five frames."""
    scenes = [city_and_fields(220, 220, seed=seed) for seed in (3, 4)]
    taken = [rsv.simulate_frames(scenes[i], TIMING, MOTIONS[i], 5, frame_size=(128, 144)) for i in (0, 1)]
    return torch.stack(taken) + 0.003 * torch.randn(2, 5, 128, 144, generator=torch.Generator().manual_seed(1))


@pytest.fixture(scope="module", name="alone")
def make_alone(stacks):
    """Results of single stacks, computed once."""
    return cache(lambda name, index: FUNCTIONS[name][0](stacks[index], TIMING, MOTIONS[index]))


def assert_close(kind, found, expected, tolerance):
    torch.testing.assert_close(
        found, expected, rtol=tolerance, atol=tolerance, equal_nan=True, msg=f"{kind}: {{}}".format
    )


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("scan_axis", [-2, -1])
def test_turned_frames_have_turned_results(stacks, alone, name, scan_axis):
    """Frames are flipped along the scan axis, and transposed for a sensor that reads columns."""
    function, tolerance, _ = FUNCTIONS[name]
    motion, sign, order = MOTIONS[0], torch.tensor([1.0, -1.0]), [0, 1] if scan_axis == -2 else [1, 0]
    phase = motion.phase + torch.tensor([[0.0], [math.pi]])
    speed = motion.image_motion * sign
    turned_motion = rsv.Vibration(*(values[order] for values in (motion.amplitude, motion.frequency, phase, speed)))
    timing = replace(TIMING, scan_axis=scan_axis, readout_direction="reverse")

    def turned(images):
        return images.flip(-2) if scan_axis == -2 else images.flip(-2).mT

    change = {"image": turned, "size": lambda v: v[..., order], "vector": lambda v: (v * sign)[..., order]}
    found = function(turned(stacks[0]).contiguous(), timing, turned_motion)
    for kind, values in alone(name, 0).items():
        assert_close(kind, found[kind], change[kind](values), tolerance)


@pytest.mark.parametrize("name", [name for name, (*_, batches) in FUNCTIONS.items() if batches])
def test_a_batch_equals_single_stacks(stacks, alone, name):
    function, tolerance, _ = FUNCTIONS[name]
    together = function(stacks[:, :, None], TIMING, rsv.Vibration.stacked(MOTIONS))
    for index in (0, 1):
        for kind, values in alone(name, index).items():
            one = together[kind][index]
            assert_close(kind, one[:, 0] if kind == "image" else one, values, tolerance)
