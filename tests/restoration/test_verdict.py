"""Verdict on restorations of frames of an independent camera, with correct, wrong and spurious vibrations."""

import functools
import math
import warnings

import pytest
import torch
from benchmarks.resolution_chart import resolution_chart
from detections import detection_of
from field_truth import FieldMotion, take_field_frames
from refusals import without_warning
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration, simulate_frames
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.restoration import RestorationWarning, judge_restoration, restore
from rsvib_torch.restoration.judge import pairs_to_judge
from rsvib_torch.restoration.restoration_verdict import outcome_of_pair
from rsvib_torch.results.reason import Reason

HEIGHT, WIDTH, MARGIN = 512, 192, 40
FREQUENCY = (71.0, 113.0)
BLIND = (2 / (HEIGHT * 4e-5), 1 / (HEIGHT * 4e-5))  # one or two complete periods between frames
SCENES = {
    "buildings": lambda: draw_scene(HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN, seed=3),
    "soft": lambda: draw_scene(HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN, seed=4, blur=2.5),
    "chart": lambda: resolution_chart(HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN, seed=1).double().numpy(),
    "city": lambda: city_and_fields(HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN, 1).double().numpy(),
}
WRONG = {
    "half amplitude": lambda m: m.scaled(0.5),
    "late by 0.5 rad": lambda m: Motion(m.amplitude, m.frequency, (m.phase[0] + 0.5, m.phase[1] + 0.5)),
    "turned": lambda m: Motion(m.amplitude, m.frequency, (m.phase[0] + 3, m.phase[1] + 3)),
    "other frequency": lambda m: Motion(m.amplitude, (90.0, 60.0), m.phase),
}


def camera(exposure_rows=20):
    return SensorTiming(row_time=4e-5, exposure_rows=exposure_rows, frame_rows=HEIGHT)


def scaled_motion(scale=1.0, frequency=FREQUENCY):
    return Motion((3.1 * scale, 5.2 * scale), frequency, (0.4, 1.3))


@pytest.fixture(scope="module", name="scene")
def make_scene():
    return functools.cache(lambda name: SCENES[name]())


TAKEN = {}


def frames_of(scene, timing, motion, noise, count=2):
    """Frames of a scene, simulated once for each case; noise is added afterwards."""
    key = (id(scene), timing, motion, count)
    if key not in TAKEN:
        TAKEN[key] = scene, torch.from_numpy(take_frames(scene, timing, motion, count)).float()
    still = TAKEN[key][1]
    return still + noise * torch.randn(still.shape, generator=torch.Generator().manual_seed(0))


def judged(frames, timing, vibration, **options):
    restored = restore(frames, timing, vibration, check=False, **options)
    joint = options.get("joint", False)
    return judge_restoration(frames, restored, timing, vibration, joint=joint), restored


@pytest.mark.parametrize(
    ("name", "noise", "scale"),
    [
        *((name, 0.005, 1.0) for name in SCENES),
        *(("buildings", *case) for case in ((0.0, 1.0), (0.02, 0.05), (0.005, 0.02))),
    ],
)
def test_correct_vibration_helps(scene, name, noise, scale):
    timing, motion = camera(), scaled_motion(scale)
    frames = frames_of(scene(name), timing, motion, noise)
    verdict, restored = judged(frames, timing, motion.vibration())
    assert verdict.overall == "helps", verdict.sentence
    assert (verdict.misfit_after < (0.2 * verdict.misfit_before).clamp(min=0.05)).all()
    # the displacement between the frames, from its own formula
    times = timing.row_starts(2, HEIGHT).numpy() + timing.exposure_time / 2
    offset = motion.displacement(times[1]) - motion.displacement(times[0])
    shrunk = [math.sin(x) / x for x in (math.pi * f * timing.exposure_time for f in FREQUENCY)]
    expected = torch.from_numpy((offset**2).mean(0) ** 0.5) * torch.tensor(shrunk)
    torch.testing.assert_close(verdict.misfit_before[0], expected, rtol=0.35, atol=0.02)
    if noise == 0:
        return
    gain = decibel(restored[1], crop(scene(name))) - decibel(frames[1], crop(scene(name)))
    assert float(verdict.predicted_gain) == pytest.approx(gain, abs=4.0)


@pytest.mark.parametrize("name", ["buildings", "chart"])
def test_no_false_alarm_with_motion_blur(scene, name):
    timing, motion = camera(150), scaled_motion()
    frames = frames_of(scene(name), timing, motion, 0.005)
    restored = without_warning(restore, frames, timing, motion.vibration())
    assert decibel(restored, crop(scene(name))) > decibel(frames, crop(scene(name))) + 3


@pytest.mark.parametrize(
    ("name", "noise", "scale", "wrong"),
    [*(("buildings", 0.005, 1.0, wrong) for wrong in WRONG), ("chart", 0.02, 0.05, "late by 0.5 rad")],
)
def test_wrong_vibration_is_rejected(scene, name, noise, scale, wrong):
    timing, motion = camera(), scaled_motion(scale)
    frames = frames_of(scene(name), timing, motion, noise)
    verdict, _ = judged(frames, timing, WRONG[wrong](motion).vibration())
    assert verdict.overall in ("partly", "worse"), verdict.sentence
    if wrong == "half amplitude":
        ratio = verdict.misfit_after / verdict.misfit_before
        assert (ratio > 0.4).all()
        assert (ratio < 0.6).all()
    elif scale == 1.0 and wrong != "late by 0.5 rad":
        assert verdict.overall == "worse"


@pytest.mark.parametrize(("name", "noise", "scale"), [("soft", 0.0, 1.0), ("city", 0.02, 0.05)])
def test_vibration_that_does_not_exist_is_rejected(scene, name, noise, scale):
    frames = frames_of(scene(name), camera(), scaled_motion(0.0), noise)
    verdict, _ = judged(frames, camera(), scaled_motion(scale).vibration())
    assert verdict.overall == "worse"
    assert "frames lie" in verdict.sentence
    joint, _ = judged(frames, camera(), scaled_motion(scale).vibration(), joint=True)
    assert joint.overall == "worse"


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_blind_vibration_is_unknown(scene, noise):
    motion = scaled_motion(frequency=BLIND)
    frames = frames_of(scene("city"), camera(), motion, noise)
    for vibration in (motion.vibration(), motion.scaled(0.5).vibration()):
        verdict, _ = judged(frames, camera(), vibration)
        assert verdict.overall == "unknown"
        assert "all are displaced alike" in verdict.sentence


def test_disagreement_of_the_restored_frames_reduces_the_gain(scene):
    """Only the later restored frame is changed: the prediction from the earlier one stays correct."""
    timing, vibration = camera(), scaled_motion().vibration()
    frames = frames_of(scene("city"), timing, scaled_motion(), 0.005)
    restored = restore(frames, timing, vibration, check=False)
    gain = judge_restoration(frames, restored, timing, vibration).predicted_gain
    changed = restored.clone()
    changed[1] += 0.05 * torch.randn(restored.shape[1:], generator=torch.Generator().manual_seed(1))
    assert judge_restoration(frames, changed, timing, vibration).predicted_gain < gain - 5


@pytest.mark.parametrize(
    ("name", "exposure", "scale", "noise", "options", "loss"),
    [
        ("soft", 100, 1.0, 0.02, {"regularisation": 1e-5}, 3),
        ("soft", 100, 1.0, 0.02, {"method": "banded", "noise_to_signal": 0.0}, 3),
        ("chart", 20, 0.05, 0.005, {"regularisation": 1e6}, 10),  # smooths
    ],
)
def test_noise_or_smoothing_larger_than_the_correction_is_rejected(scene, name, exposure, scale, noise, options, loss):
    timing, motion, still = camera(exposure), scaled_motion(scale), crop(scene(name))
    frames = frames_of(scene(name), timing, motion, noise)
    verdict, restored = judged(frames, timing, motion.vibration(), **options)
    assert decibel(restored, still) < decibel(frames, still) - loss
    assert verdict.overall == "worse"
    with pytest.warns(RestorationWarning, match="restored is no better than raw"):
        restore(frames, timing, motion.vibration(), **options)


def test_axis_that_is_not_restored_is_not_judged(scene):
    timing, motion = camera(), scaled_motion()
    frames = frames_of(scene("city"), timing, motion, 0.005)
    only_y = Vibration([0.0, 5.2], FREQUENCY, (0.4, 1.3))
    verdict, _ = judged(frames, timing, only_y)
    assert verdict.overall == "helps"
    assert verdict.misfit_after[0, 0] > 3
    assert verdict.misfit_after[0, 1] < 1.5


@pytest.mark.parametrize("image_motion", [(0.0, 0.0), (700.0, -300.0)])
def test_push_scan_frames_are_compared_where_they_overlap(image_motion):
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
    motion = Motion(image_motion=image_motion)
    frames = frames_of(draw_scene(448, 400, seed=41), timing, motion, 0.005, count=3)
    verdict, _ = judged(frames, timing, motion.vibration())
    assert verdict.outcome == ("helps", "helps")
    wrong = Motion(motion.amplitude, motion.frequency, (motion.phase[0] + 3, motion.phase[1] + 3), image_motion)
    assert judged(frames, timing, wrong.vibration())[0].overall == "worse"


def test_colour_integers_and_missing_pixels_are_judged(scene):
    timing, motion = camera(), scaled_motion()
    grey = frames_of(scene("city"), timing, motion, 0.005)
    colour = torch.stack([grey, 0.5 * grey, 0.8 * grey], dim=1)
    assert judged(colour, timing, motion.vibration())[0].overall == "helps"
    counts = (grey.clamp(0, 1) * 4095).round().to(torch.int32)
    restored, given = restore(counts, timing, motion.vibration(), full_scale=4095), detection_of(motion.vibration())
    assert judge_restoration(counts, restored.double(), timing, given, full_scale=4095).overall == "helps"
    with_missing = grey.clone()
    with_missing[0, 100:103, 50:53] = math.nan
    assert judged(with_missing, timing, motion.vibration())[0].overall == "helps"


def test_noise_of_restored_frames_is_that_of_the_filter():
    # a still camera: the Wiener filter with gradient prior, summed over its frequencies
    v, u = torch.fft.fftfreq(33, dtype=torch.float64)[:, None], torch.fft.fftfreq(256, dtype=torch.float64)
    prior = 4 * ((math.pi * v).sin().square() + (math.pi * u).sin().square())
    expected = (1 / (1 + 0.5 * prior)).square().mean().sqrt()
    noise = torch.randn(1, 128, 256, generator=torch.Generator().manual_seed(0))
    options = {"method": "banded", "noise_to_signal": 0.5, "check": False}
    restored = restore(noise, camera(), Vibration.still(), **options)
    assert float(restored[:, 16:-16, 16:-16].std()) == pytest.approx(float(expected), rel=0.03)


@pytest.mark.parametrize(
    ("joint", "gain", "offset"), [(True, 1.0, 0.0), (2, 1.0, 0.0), (True, 1.1, 0.0), (False, 0.8, 0.1)]
)
def test_joint_restorations_are_judged_and_frames_may_differ_in_brightness(scene, joint, gain, offset):
    timing, motion = camera(), scaled_motion()
    frames = frames_of(scene("city"), timing, motion, 0.01, count=3)
    frames[1] = gain * frames[1] + offset
    verdict, _ = judged(frames, timing, motion.vibration(), joint=joint)
    assert verdict.overall == "helps", verdict.sentence
    assert len(verdict.outcome) == 2
    assert judged(frames, timing, motion.scaled(0.5).vibration(), joint=joint)[0].overall in ("partly", "worse")


@pytest.mark.parametrize("axis", [0, 1])
def test_small_wrong_motion_beside_a_large_correct_motion_is_accepted(scene, axis):
    timing = camera()
    large = [3.1, 5.2]
    large[axis] = 0.0
    frames = frames_of(scene("city"), timing, Motion(tuple(large), FREQUENCY, (0.4, 1.3)), 0.005)
    slightly = list(large)
    slightly[axis] = 0.06
    verdict, restored = judged(frames, timing, Vibration(slightly, FREQUENCY, (0.4, 1.3)))
    assert decibel(restored[1], crop(scene("city"))) > decibel(frames[1], crop(scene("city"))) + 10
    assert verdict.overall in ("helps", "unknown"), verdict.sentence
    much = list(large)
    much[axis] = 2.0
    assert judged(frames, timing, Vibration(much, FREQUENCY, (0.4, 1.3)))[0].overall == "worse"


@pytest.mark.parametrize(
    "wrong_motion",
    [{"image_motion": [1500.0, -1000.0]}, {"image_acceleration": [0.0, -4e4]}],
    ids=["motion", "acceleration"],
)
def test_image_motion_that_does_not_exist_causes_a_warning(scene, wrong_motion):
    frames = frames_of(scene("city"), camera(), scaled_motion(0.0), 0.005)
    moving = Vibration([0.0, 0.0], [0.0, 0.0], **wrong_motion)
    with pytest.warns(RestorationWarning, match="restored is no better than raw"):
        restore(frames, camera(), moving, method="dewarp")


def outcome(before, after, gain=5.0, *, resolution=(0.01, 0.01), moves=(True, True), offset=(1.0, 1.0), **options):
    return outcome_of_pair([*before], [*after], [*resolution], [*moves], [*offset], gain, **options)


@pytest.mark.parametrize(
    ("before", "after", "options", "expected"),
    [
        ((2.0, 2.0), (0.1, 0.69), {}, "helps"),
        ((2.0, 2.0), (0.1, 0.71), {}, "partly"),
        ((2.0, 2.0), (0.71, 0.1), {}, "partly"),
        ((2.0, 2.0), (1.59, 0.1), {}, "partly"),
        ((2.0, 2.0), (1.61, 0.1), {"gain": 1.9}, "worse"),
        ((2.0, 2.0), (1.61, 0.1), {"gain": 2.1}, "partly"),
        ((2.0, 2.0), (1.61, 0.1), {"gain": 2.1, "one_image": True}, "worse"),
        ((0.005, 2.0), (0.2, 0.1), {}, "worse"),  # a motion along x that does not exist
        ((0.005, 2.0), (0.2, 0.1), {"gain": 30.0}, "worse"),
        ((0.005, 2.0), (0.09, 0.1), {"gain": 30.0}, "helps"),  # within the crosstalk of y
        ((0.005, 0.1), (0.02, 0.02), {}, "helps"),  # finer than any image needs
        ((0.02, 0.02), (0.02, 0.02), {"offset": (0.02, 0.02)}, "unknown"),
        ((0.02, 0.02), (0.02, 0.02), {"offset": (0.02, 0.04)}, "unknown"),
        ((0.02, 0.02), (0.02, 0.02), {"offset": (0.04, 0.04)}, "helps"),
        ((0.4, 0.4), (0.4, 0.4), {"resolution": (0.5, 0.5), "offset": (0.1, 0.1)}, "unknown"),
        ((0.0, 0.0), (0.0, 0.0), {"resolution": (math.inf, 0.01), "offset": (1.0, 1.0)}, "unknown"),
        ((2.0, 2.0), (2.0, 0.1), {"moves": (False, True)}, "helps"),
        ((2.0, 2.0), (2.0, 0.1), {"moves": (False, True), "gain": -9.0}, "helps"),  # the gain includes x
        ((0.01, 2.0), (0.01, 0.1), {"moves": (False, True), "gain": -2.1}, "worse"),
        ((2.0, 2.0), (0.1, 0.1), {"gain": -1.9}, "unknown"),  # the error of the gain is 2 dB
        ((2.0, 2.0), (0.1, 0.1), {"gain": -2.1}, "worse"),
        ((2.0, 2.0), (1.0, 0.1), {"gain": -9.0}, "partly"),
        ((2.0, 2.0), (2.0, 2.0), {"moves": (False, False)}, "unknown"),
    ],
)
def test_outcome_of_a_pair(before, after, options, expected):
    found, reasons = outcome(before, after, **options)
    assert found == expected
    assert (reasons == ()) == (found == "helps")


@pytest.mark.parametrize(("noise", "factor"), [(0.005, 0.4), (0.005, 2.2), (0.08, 1.0), (0.08, 3.0)])
def test_the_gain_never_contradicts_the_outcome(scene, noise, factor):
    timing, motion = camera(), scaled_motion(0.3)
    frames = frames_of(scene("city"), timing, motion, noise)
    verdict, _ = judged(frames, timing, motion.scaled(factor).vibration())
    gain = float(verdict.predicted_gain)
    sign = {"helps": 1, "partly": 1, "worse": -1, "unknown": 0}[verdict.overall]
    assert math.isnan(gain) or sign * gain >= 0, verdict.sentence
    assert sign != 1 if factor in (2.2, 3.0) else sign != -1 or noise == 0.08


def test_reasons_name_the_axes_of_the_outcome():
    found, reasons = outcome((2.0, 2.0), (1.0, 3.0), 0.0)
    assert (found, reasons) == ("worse", (Reason("motion_remains", "y", 3.0, 1.6, {"before": 2.0}),))
    found, reasons = outcome((2.0, 2.0), (1.0, 1.1), 0.0)
    assert found == "partly"
    assert [(one.code, one.axis, one.value, one.limit) for one in reasons] == [
        ("motion_remains", "x", 1.0, 0.7),
        ("motion_remains", "y", 1.1, 0.7),
    ]
    assert {one.code for one in outcome((0.0, 0.0), (0.0, 0.0), offset=(0.0, 0.0))[1]} == {"displaced_alike"}
    assert {one.code for one in outcome((0.0, 0.0), (0.0, 0.0), resolution=(math.inf, math.inf))[1]} == {"no_contrast"}


def test_pairs_to_judge():
    assert pairs_to_judge(4, True) == [(2, 0), (2, 1), (2, 3)]
    assert pairs_to_judge(9, False, 3) == [(0, 1), (4, 5), (7, 8)]


@pytest.mark.parametrize(
    ("options", "direction"),
    [({"scale": 2}, "forward"), pytest.param({"mosaic": "GRBG", "scale": 2}, "reverse", marks=pytest.mark.slow)],
    ids=str,
)
def test_finer_grids_and_mosaics_are_judged_at_the_pixels(options, direction):
    timing = SensorTiming(row_time=4e-5, exposure_rows=20, frame_rows=200, readout_direction=direction)
    motion = scaled_motion()
    size = (160, 152) if "mosaic" in options else (184, 176)
    frames = torch.from_numpy(take_frames(draw_scene(*size, seed=3), timing, motion, 2)).float()
    frames = frames if direction == "forward" else frames.flip(-2)  # grey, so that it is a mosaic as well
    frames = frames + 0.003 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(0))
    right = motion.vibration()
    right = right if direction == "forward" else right.with_axes((0, 1), (1.0, -1.0))
    mosaic = options.get("mosaic")
    for vibration, outcome in ((right.with_axes((0, 1), (-1.0, -1.0)), "worse"), (right, "helps")):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", RestorationWarning)
            restored = restore(frames, timing, vibration, joint=True, **options)
        assert any("no better than raw" in str(one.message) for one in caught) == (outcome == "worse")
    assert judge_restoration(frames, restored, timing, right, joint=True, mosaic=mosaic).overall == "helps"
    if not mosaic:
        colour = torch.stack([frames, frames], -1)
        restored = restore(colour, timing, right, check=False, joint=True, channels="last", **options)
        assert judge_restoration(colour, restored, timing, right, joint=True, channels="last").overall == "helps"
    with pytest.raises(ValueError, match="with scale=2, got"):
        judge_restoration(frames, restored[..., 1:], timing, right, joint=True, mosaic=mosaic)


def test_pairs_of_frames_with_roll_are_judged_at_their_times():
    """The strip of columns that is judged has the times of the frames that are compared, not of the first ones."""
    timing = SensorTiming(row_time=5e-5, exposure_rows=10, frame_rows=150)
    motion = FieldMotion((2.0, 3.0, 2e-3, 0.0))
    frames = take_field_frames(draw_scene(150, 280, 3, blur=0.6), timing, motion, (112, 240), 4)
    vibration = Vibration(motion.amplitude[:3], motion.frequency[:3], motion.phase[:3])
    restored = restore(frames, timing, vibration, joint=True, check=False)
    verdict = judge_restoration(frames, restored, timing, vibration, joint=True, most_pairs=2)
    assert verdict.outcome == ("helps", "helps")


@pytest.mark.parametrize("frame", [1, 3])
def test_missing_pixels_do_not_make_a_right_motion_wrong(frame):
    """What is restored in the place of missing pixels of one frame is no prediction of the next one."""
    timing = SensorTiming(row_time=50e-6, exposure_rows=20, frame_rows=300)
    right = Vibration([[2.1], [1.6]], [[110.0], [90.0]], [[0.5], [1.0]])
    frames = simulate_frames(city_and_fields(300, 300, seed=0), timing, right, num_frames=4, frame_size=(240, 230))
    frames = frames + 0.004 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(0))
    frames[frame, 80:140, 60:160] = torch.nan
    wrong = Vibration(0.5 * right.amplitude, right.frequency, right.phase)
    for motion, outcome in ((right, "helps"), (wrong, "partly")):
        restored = restore(frames, timing, motion, check=False)
        assert set(judge_restoration(frames, restored, timing, motion).outcome) == {outcome}
