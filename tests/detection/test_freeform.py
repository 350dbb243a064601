"""Motion of any shape from frames of an independent simulator: observable and unobservable parts."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from motion_truth import offset_error, rms
from scipy.optimize import curve_fit
from truth import MARGIN, Curve, recorded

import rsvib_torch as rsv

HEIGHT, WIDTH, FRAMES = 256, 160, 9
TIMING = rsv.SensorTiming(row_time=6e-5, exposure_rows=20, frame_rows=270)
SPAN = FRAMES * TIMING.frame_period


@Curve
def jitter(times):
    """A settling step along x, a chirp with drift along y: not a sum of sinusoids."""
    place = times / SPAN
    x = 4 * np.exp(-3 * place) * np.sin(2 * np.pi * 6.1 * place**0.9 + 0.3) + 3 * np.tanh(8 * (place - 0.6))
    y = 12 * place - 9 * place**2 + 1.5 * np.sin(2 * np.pi * (2 * place + 2.2 * place**2))
    return np.stack([x, y], axis=-1)


def error_of(found, motion):
    """Errors (T, R, 2) of the displacement, up to a constant."""
    error = found.displacement.numpy() - motion.displacement(found.times.numpy())
    return error - error.mean((0, 1))


def without_frame_mean(values):
    """Displacements (T, R, 2) minus the mean of each row over the frames: approximately the observable part."""
    return values - values.mean(0)


@pytest.fixture(scope="module", name="frames")
def make_frames():
    return recorded((HEIGHT, WIDTH), TIMING, jitter, FRAMES, 0.005, seed=6)


@pytest.fixture(scope="module", name="found")
def make_found(frames):
    return rsv.detect_motion(frames, TIMING)


def test_observable_displacement_is_measured(found):
    error = error_of(found, jitter)
    assert (rms(without_frame_mean(jitter.displacement(found.times.numpy()))) > 1.0).all()
    assert (rms(without_frame_mean(error)) < 0.05).all()
    assert (rms(error) < 0.4).all()
    assert found.reliable.all()
    assert found.findings == ((), ())
    assert f"motion near multiples of {TIMING.frame_rate:.4g} Hz" in " ".join(found.summary().split())


def test_standard_deviations_agree_with_errors(found):
    error = error_of(found, jitter)
    assert (rms(without_frame_mean(error)) < 2.5 * found.std_seen.numpy()).all()
    assert (found.std_seen.numpy() < 0.1).all()
    assert (rms(error) < 2.5 * rms(found.std.numpy())).all()
    assert (found.unseen > found.std_seen).all()
    assert found.std.shape == (FRAMES, 32, 2)
    assert torch.allclose(found.displacement.mean((0, 1)), torch.zeros(2, dtype=torch.float64), atol=1e-9)


def test_standard_deviations_near_a_sudden_step():
    """The knots do not follow a step of 0.5 ms: errors near it were 7 standard deviations of a smooth motion."""
    step = Curve(lambda t: np.stack([2 * np.tanh((t - 0.036) / 2.5e-4), 1.4 * np.tanh((t - 0.06) / 2.5e-4)], axis=-1))
    found = rsv.detect_motion(recorded((HEIGHT, WIDTH), TIMING, step, 5, 0.005, seed=6), TIMING)
    error = error_of(found, step)
    assert (np.abs(error) < 4 * found.std.numpy()).all()
    assert (rms(without_frame_mean(error)) < 2.5 * found.std_seen.numpy()).all()


def test_image_motion_is_separated():
    scan = Curve(lambda t: np.stack([1.5 * np.sin(2 * np.pi * 5.3 * t / SPAN), -500.0 * (t - 0.5 * SPAN)], axis=-1))
    frames = recorded((HEIGHT, WIDTH), TIMING, scan, FRAMES, 0.005, seed=6, margin=MARGIN + 80)
    found = rsv.detect_motion(frames, TIMING)
    assert found.motion.tones.image_motion[1] == pytest.approx(-500.0, rel=5e-3)
    assert (rms(without_frame_mean(error_of(found, scan))) < 0.1).all()


def test_missing_pixels_do_not_change_the_result(frames):
    """Bright spots of dirt on the sensor do not move with the scene."""
    hole = np.zeros((HEIGHT, WIDTH), dtype=bool)
    for top, left in np.random.default_rng(1).integers(0, (HEIGHT - 12, WIDTH - 12), (40, 2)):
        hole[top : top + 12, left : left + 12] = True
    assert 0.08 < hole.mean() < 0.3
    dirty = torch.where(torch.from_numpy(hole), 0.9 + 0.1 * torch.rand(HEIGHT, WIDTH), frames[:3])

    def error(result):
        return rms(without_frame_mean(error_of(result, jitter))).max()

    masked = rsv.detect_motion(dirty, TIMING, ignore=hole)
    assert error(masked) < 0.05
    assert error(rsv.detect_motion(dirty, TIMING)) > 3 * error(masked)
    holes = rsv.detect_motion(dirty.masked_fill(torch.from_numpy(hole), torch.nan), TIMING)
    assert torch.equal(holes.displacement, masked.displacement)


def refuses_frames(frames):
    """Whether the row bands refuse both axes, or nothing determines the motion."""
    try:
        findings = rsv.detect_motion(frames, TIMING).findings
    except ValueError as error:
        return "the frames do not determine the motion" in str(error)
    codes = [{reason.code for reason in reasons} for reasons in findings]
    return all(of_axis & {"rows_not_registered", "bands_contradict"} for of_axis in codes)


@pytest.mark.parametrize("place", [0, 2, 4])
@pytest.mark.parametrize("what", ["noise", "other scene"])
def test_one_frame_without_the_scene_is_refused(frames, what, place):
    """The rows of such a frame are measured around the spline, which they confirm: errors were 5 to 40 px."""
    few, other = frames[:5].clone(), recorded((HEIGHT, WIDTH), TIMING, jitter, 1, 0.005, seed=7)[0]
    few[place] = torch.rand_like(few[0]) if what == "noise" else other
    assert rsv.detect_motion(frames[:5], TIMING).reliable.all()
    assert refuses_frames(few)


@pytest.mark.parametrize(("stated", "refused"), [(40.0, False), (80.0, True)])
def test_an_exposure_that_the_blur_contradicts_is_refused(stated, refused):
    """Rows that are means over half of the stated time show too small a motion."""
    swing = Curve(lambda t: np.stack([2.0 * np.sin(300 * t), 1.5 * np.sin(222 * t + 1.0)], -1))
    frames = recorded((HEIGHT, WIDTH), replace(TIMING, exposure_rows=40), swing, 4, 0.005, seed=6)
    found = rsv.detect_motion(frames, replace(TIMING, exposure_rows=stated))
    codes = [[reason.code for reason in reasons] for reasons in found.findings]
    assert ["blur_contradicts_exposure" in of_axis for of_axis in codes] == [refused] * 2


def test_motion_beyond_the_search_range_is_reported():
    far = Curve(lambda t: np.stack([30 * np.sin(2 * np.pi * t / TIMING.frame_period * 0.7), 0 * t], axis=-1))
    frames = recorded((HEIGHT, WIDTH), TIMING, far, 3, 0.005, seed=6)
    with pytest.raises(ValueError, match="search=4 px"):
        rsv.detect_motion(frames, TIMING, search=4)
    tones = rsv.detect_vibration(frames, TIMING, search=4)
    # the direct method measures on the images: it may converge from the few bands that were registered, by chance
    assert not tones.reliable[1]
    assert not tones.reliable[0] or abs(float(tones.vibration.amplitude[0, 0]) / 30 - 1) < 0.005
    bands = rsv.detect_vibration(frames, TIMING, search=4, method="bands")
    assert not bands.reliable.any()
    assert all(of_axis[0].code == "rows_not_registered" for of_axis in bands.findings)


@Curve
def ringing(times):
    """Two tones and a drift along the scan axis, as on a spacecraft; one tone has the frame rate."""
    turns = times / TIMING.frame_period
    x = 3.0 * np.sin(2 * np.pi * 0.61 * turns + 0.4) + 1.2 * np.sin(2 * np.pi * turns + 1.0) + 0.08 * turns**2
    y = 2.0 * np.sin(2 * np.pi * 0.83 * turns + 2.0) + 1.6 * np.cos(2 * np.pi * 0.26 * turns) + 3.0 * turns
    return np.stack([x, y], axis=-1)


def test_offsets_of_all_pairs_are_measured_despite_an_unobservable_tone():
    """A tone at the frame rate is equivalent to a warp of the scene: it is not observable and affects nothing else."""
    frames = recorded((HEIGHT, 112), TIMING, ringing, 8, 0.005, seed=12)
    found = rsv.detect_motion(frames, TIMING)
    times = (TIMING.row_starts(8, HEIGHT) + 0.5 * TIMING.exposure_time).numpy()
    truth, motion = ringing.displacement(times), found.motion.displacement(torch.from_numpy(times)).numpy()
    assert (offset_error(motion, truth) < 0.03).all()
    assert (offset_error(0.5 * truth, truth) > 1.0).all()
    error = motion - truth
    assert rms(error - error.mean((0, 1)))[0] > 0.5
    assert (found.std_seen.numpy() < 0.01).all()
    assert (found.unseen > 5 * found.std_seen).all()
    assert found.reliable.all()


@Curve
def humming(times):
    """Tones at 1.04 and 0.96 times the frame rate beside an image motion."""
    angle = 2 * np.pi * times / TIMING.frame_period
    x = 1.5 * np.sin(1.04 * angle + 0.4) + 0.2 * angle
    return np.stack([x, 1.5 * np.sin(0.96 * angle + 2.0)], axis=-1)


def test_nearly_blind_tones_take_the_place_of_a_spline():
    """Tones that explain the rows as well as a spline determine also the part that all frames have in common."""
    frames = recorded((HEIGHT, 112), TIMING, humming, 5, 0.005, seed=12)
    found = rsv.detect_motion(frames, TIMING)
    error = error_of(found, humming)
    assert (rms(error) < 0.03).all()  # a spline leaves 0.3 px and more
    assert (rms(error) < 2 * rms(found.std.numpy())).all()
    assert (rms(found.std.numpy()) < 0.1).all()


@Curve
def ringing_down(times):
    """A tone that decays and one that sweeps near the frame rate."""
    turns = times / TIMING.frame_period
    x = 2.0 * np.exp(-turns / 4) * np.sin(2 * np.pi * 1.01 * turns + 1.0)
    return np.stack([x, 1.5 * np.sin(2 * np.pi * (1.01 + 0.01 * turns) * turns + 0.4)], axis=-1)


def test_a_motion_near_the_frame_rate_of_which_all_frames_have_most_in_common_is_refused():
    """A fifth and a third of the motions was found, with a standard deviation of a third of the error."""
    found = rsv.detect_motion(recorded((HEIGHT, 112), TIMING, ringing_down, 4, 0.005, seed=12), TIMING)
    assert (rms(error_of(found, ringing_down)) > 0.5).all()
    assert [[one.code for one in of_axis] for of_axis in found.findings] == [["common_motion_uncertain"]] * 2


def test_tones_of_two_frames_widen_the_error_bars_only():
    frames = recorded((HEIGHT, 112), TIMING, humming, 2, 0.005, seed=12)
    found = rsv.detect_motion(frames, TIMING)
    error = error_of(found, humming)
    assert not found.motion.tones.moving_axes().any()
    assert (rms(error) < 2 * rms(found.std.numpy())).all()
    assert (rms(found.std.numpy()) < 4.0).all()  # four times the motion says nothing


def test_a_common_part_that_is_not_known_is_refused():
    """Of fast tones in two frames, more than the motion is not determined."""
    period = TIMING.frame_period
    fast = Curve(lambda t: np.stack([1.5 * np.sin(14.5 * t / period), np.sin(11.6 * t / period + 1.0)], -1))
    found = rsv.detect_motion(recorded((HEIGHT, 112), TIMING, fast, 2, 0.005, seed=12), TIMING)
    assert [of_axis[0].code for of_axis in found.findings] == ["common_motion_uncertain"] * 2


@pytest.mark.parametrize("count", [3, 5])
def test_a_tone_that_decays_and_sweeps_is_fitted_to_what_differs_between_frames(count):
    """As on the page on cameras: the part that all frames have in common, which is estimated, is left out."""

    def tone(t, a, b, frequency, decay, sweep):
        angle = 2 * np.pi * (frequency + 0.5 * sweep * t) * t
        return np.exp(-decay * t) * (a * np.sin(angle) + b * np.cos(angle))

    along = {0: (2.6, 1.8, 83.0, 25.0, 0.0), 1: (0.5, -1.0, 30.0, 0.0, 520.0)}
    swept = Curve(lambda t: np.stack([tone(t, *along[0]), tone(t, *along[1])], -1))
    found = rsv.detect_motion(recorded((HEIGHT, WIDTH), TIMING, swept, count, 0.005, seed=6), TIMING)
    times = found.times.numpy()

    def between_frames(_, speed, *values):
        moved = tone(times, *values) + speed * times
        return (moved - moved.mean(0)).ravel()

    for axis, true in along.items():
        moved = found.displacement[..., axis].numpy()
        start = [0, 1, 1, 1.03 * true[2], 0.9 * true[3], 0.9 * true[4]]
        values, _ = curve_fit(between_frames, None, (moved - moved.mean(0)).ravel(), start)
        error = tone(times, *values[1:]) + values[0] * times - tone(times, *true)
        assert (error - error.mean()).std() < 0.02
        assert values[3] == pytest.approx(true[2], abs=0.5)
