"""Standard deviations that allow for a further tone and for the row time, and sensitivities to the timing."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rsvib_torch import (
    FreeMotion,
    Vibration,
    VibrationTracker,
    detect_motion,
    detect_vibration,
    simulate_frames,
)
from rsvib_torch.datasets import city_and_fields, example_frames
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.sensitivity import assumptions, timing_sensitivity
from rsvib_torch.detection.tones.fit import amplitude_std, displacement_std, fit_tones, vibration_of_fit
from rsvib_torch.detection.tones.uncertainty import with_further_tones, without_aliasing
from rsvib_torch.motion.timing import RowTiming, SensorTiming

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # exact displacements along y: 0 / 0 is no error

TIMING = RowTiming(row_time=1 / 24 / 110, exposure_rows=20, frame_rows=110)
ROWS, NOISE = 100, 0.003  # px


def starts_of(timing, num_frames):
    return np.arange(num_frames) * timing.frame_rows * timing.row_time + np.arange(ROWS)[:, None] * timing.row_time


def mean_sine(amplitude, frequency, phase, starts, exposure):
    """Mean of A sin(2 pi f t + phi) over [start, start + exposure], from its integral."""
    w = 2 * np.pi * np.asarray(frequency)[..., None, None]
    phase, amplitude = (np.asarray(values)[..., None, None] for values in (phase, amplitude))
    return amplitude * (np.cos(w * starts + phase) - np.cos(w * (starts + exposure) + phase)) / (w * exposure)


def measured(displacement, timing, generator=None, noise=NOISE):
    """Measurements of displacements (B, N, G) along x, none along y."""
    batch, rows, frames = displacement.shape
    values = displacement + (0.0 if generator is None else noise * generator.standard_normal(displacement.shape))
    both = np.stack([values, np.zeros_like(values)], -1)
    result = Measurements(
        np.repeat(starts_of(timing, frames)[None], batch, 0),
        both,
        np.ones((batch, rows, frames)),
        np.broadcast_to(np.eye(2), (batch, rows, 2, 2)) / noise**2,
        timing.exposure_time,
    )
    return replace(result, displacements=result.relative(both))


def fitted(measurements, frequency):
    active = np.zeros((len(measurements.exposure_starts), 2, 1), dtype=bool)
    active[:, 0] = True
    return fit_tones(measurements, np.repeat(np.asarray(frequency)[:, None, None], 2, 1), active)


def rms(values):
    return float(values.square().mean().sqrt())


def row_starts(num_frames):
    return starts_of(TIMING, num_frames).T.ravel()


@pytest.mark.parametrize("num_frames", [2, 3])
def test_intervals_contain_the_truth_where_a_second_tone_is_not_resolved(num_frames):
    """Half of 300 records have a second tone of random size whose frequency differs by less than 1 / duration."""
    generator, batch = np.random.default_rng(num_frames), 300
    duration = num_frames / 24
    first = generator.uniform(30.0, 44.0, batch)
    truth = mean_sine(1.0, first, generator.uniform(-3, 3, batch), starts_of(TIMING, num_frames), TIMING.exposure_time)
    size = 0.3 * np.abs(generator.standard_normal(batch)) * (generator.random(batch) < 0.5)
    beside = first + generator.uniform(-1, 1, batch) / duration
    phase = generator.uniform(-3, 3, batch)
    truth = truth + mean_sine(size, beside, phase, starts_of(TIMING, num_frames), TIMING.exposure_time)
    measurements = measured(truth, TIMING, generator)
    fit = fitted(measurements, first)

    def share_within(found):
        vibration, std = vibration_of_fit(found)
        error = (vibration.amplitude[:, 0, 0] - 1.0).abs() / std.amplitude[:, 0, 0]
        return float((error < 1.96).double().mean())

    stated, allowing = with_further_tones(measurements, fit, row_starts(num_frames))
    assert share_within(fit) < 0.75
    assert share_within(stated.fit) < 0.75
    assert share_within(allowing.fit) > 0.88
    displacement = allowing.displacement_std
    own = displacement_std(fit, row_starts(num_frames), TIMING.exposure_time)
    assert bool((displacement[:, 0] >= own[:, 0]).all())
    assert float(np.exp(np.log((displacement / own)[:, 0]).mean())) > 1.5
    np.testing.assert_allclose(allowing.fit.coefficients, fit.coefficients)


@pytest.mark.parametrize("cycles", [0.2, 0.25, 1.3])
def test_intervals_of_slow_tones_contain_the_truth(cycles):
    """Of tones of less than half a period, linear deviations of the amplitude are several times too small."""
    batch, generator, frequency = 300, np.random.default_rng(5), cycles * 24 / 5
    phase, starts = generator.uniform(-3, 3, batch), starts_of(TIMING, 5)
    truth = mean_sine(1.0, np.full(batch, frequency), phase, starts, TIMING.exposure_time)
    fit = fitted(measured(truth, TIMING, generator, noise=0.02), np.full(batch, max(frequency, 2.0)))
    (vibration, std), linear = vibration_of_fit(fit), torch.from_numpy(amplitude_std(fit))

    def share_within(error, deviation):
        return float((error.abs() < 1.96 * deviation)[:, 0].double().mean())

    errors = vibration.amplitude - 1.0, vibration.frequency - frequency, vibration.image_motion
    for error, deviation in zip(errors, (std.amplitude, std.frequency, std.image_motion), strict=True):
        assert share_within(error, deviation) > 0.88
    assert (share_within(errors[0], linear) < 0.75) == (cycles < 0.5)


@pytest.mark.parametrize("num_frames", [2, 4])
def test_bias_by_aliasing_is_removed_and_allowed_for(num_frames):
    """Bias b sin(2 pi (d_p - d_q)), mean over the frames q, and c cos(2 pi d_p): known if it moves by a pixel."""
    generator, size, batch = np.random.default_rng(num_frames), 5e-3, 100
    amplitude, starts = np.repeat([0.1, 2.0], batch), starts_of(TIMING, num_frames)
    phase = generator.uniform(-3, 3, 2 * batch)
    true = mean_sine(amplitude, np.full(2 * batch, 37.0), phase, starts, TIMING.exposure_time)
    biased = true - size * np.sin(2 * np.pi * (true[..., :, None] - true[..., None, :])).mean(-1)
    biased = biased + 0.3 * size * np.cos(2 * np.pi * true)
    measurements = measured(biased, TIMING, generator, noise=0.5 * NOISE)
    raw = fitted(measurements, np.full(2 * batch, 37.0))
    corrected = without_aliasing(measurements, raw, np.full(2 * batch, 3e-3))

    def errors(fit):
        vibration, std = vibration_of_fit(fit)
        error = vibration.amplitude[:, 0, 0] - torch.from_numpy(amplitude)
        return error.unflatten(0, (2, batch)), (error / std.amplitude[:, 0, 0]).unflatten(0, (2, batch))

    (before, _), (after, in_std) = errors(raw), errors(corrected)
    assert rms(after[1]) < 0.7 * rms(before[1])
    assert 0.4 < rms(in_std[1]) < 1.3  # the bias increases the variance of the residuals
    # a displacement of 0.1 px shows its part of the bias as an amplitude; the prior allows for 3e-3 px
    assert 0.5 < rms(in_std[0]) < 2.5


def test_exact_displacements_have_finite_standard_deviations():
    truth = mean_sine([2.0], [37.0], [0.4], starts_of(TIMING, 2), TIMING.exposure_time)
    measurements = measured(truth, TIMING)
    for stated in with_further_tones(measurements, fitted(measurements, [37.0]), row_starts(2)):
        assert np.isfinite(stated.fit.covariance).all()
    assert 0 < float(stated.displacement_std[0, 0]) < 0.01


@pytest.mark.parametrize("name", ["row_time", "frame_rows", "exposure_rows"])
@pytest.mark.parametrize("times", [None, (0.0, 1 / 24, 3 / 24, 4 / 24)])
def test_sensitivity_agrees_with_fits_of_other_timings(name, times):
    """The same displacements are fitted with a timing that is 0.05 % larger or smaller."""
    timing = replace(TIMING, frame_start_times=times)
    starts = timing.row_starts(4, ROWS).numpy().T
    truth = mean_sine([2.0], [37.0], [0.4], starts, timing.exposure_time)
    logs = []
    for factor in (0.9995, 1.0005):
        other = replace(timing, **{name: factor * getattr(timing, name)})
        measurements = measured(truth, other)
        own_starts = other.row_starts(4, ROWS).numpy().T[None]
        fit = fitted(replace(measurements, exposure_starts=own_starts), [37.0])
        vibration = vibration_of_fit(fit)[0]
        tone = (float(values[0, 0, 0]) for values in (vibration.amplitude, vibration.frequency, vibration.phase))
        amplitude, frequency, phase = tone
        logs.append([math.log(amplitude), math.log(frequency), phase])
    change = (np.array(logs[1]) - np.array(logs[0])) / 0.001
    exact = measured(truth, timing)
    fit = fitted(replace(exact, exposure_starts=starts[None]), [37.0])
    found = timing_sensitivity(fit, timing, 4, ROWS)
    for of, expected in zip(("amplitude", "frequency", "phase"), change, strict=True):
        assert float(getattr(found, f"{of}_by_{name}")[0, 0, 0]) == pytest.approx(expected, rel=0.03, abs=2e-3)


def test_assumptions_state_what_the_frames_cannot_contradict():
    truth = mean_sine([2.0], [55.0], [0.4], starts_of(TIMING, 2), TIMING.exposure_time)
    fit = fitted(measured(truth, TIMING), [55.0])
    vibration = vibration_of_fit(fit)[0]
    sensitivity = timing_sensitivity(fit, TIMING, 2, ROWS)
    (two,) = assumptions(vibration, sensitivity, TIMING, 2, ROWS)
    effect = next(text for text in two if text.startswith("frame_rows=110:"))
    assert effect.endswith("x 55 Hz: amplitude -5.5 %")  # frequencies follow from the rows of a frame
    assert any("two frames" in text for text in two)
    for periods, states_times in (((0, 1, 2, 5), False), ((0, 3, 6, 9), False), ((0, 1, 2, 3.04), True)):
        starts = tuple(period * TIMING.frame_period for period in periods)
        (four,) = assumptions(vibration, sensitivity, replace(TIMING, frame_start_times=starts), 4, ROWS)
        assert not any("two frames" in text for text in four)
        of_times = [text for text in four if "row_time" in text]
        stated = "frame_start_times 0.04167 to 0.04333 s apart, although the frame period is 0.04167 s"
        assert [text.startswith(stated) for text in of_times] == [True] * states_times
    lines = replace(TIMING, frame_rows=ROWS, frame_start_times=(0.0, 0.003))  # of line sensors: delays
    assert not any("apart" in text for text in assumptions(vibration, sensitivity, lines, 2, ROWS)[0])
    assert assumptions(replace(vibration, amplitude=0 * vibration.amplitude), sensitivity, TIMING, 2, ROWS) == ((),)
    still = replace(vibration, frequency=0 * vibration.frequency)  # of a fit without meaning
    (of_still,) = assumptions(still, sensitivity, TIMING, 2, ROWS, np.array([[1.0, 0.5, 0.0]]))
    assert any("two frames" in text for text in of_still)


@pytest.mark.parametrize(("lamp", "tones"), [(100, ["115 Hz (100 + 15 Hz)", "85 Hz (100 - 15 Hz)"]), (91, [])])
def test_tones_beside_the_frequency_of_a_lamp_are_an_assumption(lamp, tones):
    """A lamp on 50 Hz mains weights the times within an exposure 100 times per second."""
    frequency = [[15.0, lamp + 15.0, lamp - 15.0], [40.0, 0.0, 0.0]]
    motion = Vibration([[3.0, 0.1, 0.08], [2.0, 0.0, 0.0]], frequency, 0.4)
    timing = SensorTiming(row_time=1 / 25 / 280, exposure_rows=30, frame_rows=280)
    frames = simulate_frames(city_and_fields(300, 300, seed=3), timing, motion, num_frames=8)
    found = detect_vibration(frames, timing)
    assert found.reliable.all()
    texts = [text for text in found.assumptions if text.startswith("steady light")]
    assert [tone in texts[0] for tone in tones] == [True] * len(tones) if tones else not texts


CAMERA = SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
PLACES = torch.arange(-0.02, 0.3, 2e-4, dtype=torch.float64)


def wrong(timing: SensorTiming, error: float, std: float) -> SensorTiming:
    """A timing with a row time that is wrong by a relative error, with the same exposure and frame rate in s."""
    row_time = (1 + error) * timing.row_time
    seconds = {"exposure_time": timing.exposure_time, "frame_rate": timing.frame_rate}
    return SensorTiming.from_seconds(row_time=row_time, row_time_std=std * row_time, **seconds)


def frames_of(path: torch.Tensor, count: int) -> torch.Tensor:
    """Frames of a motion with some noise."""
    motion = FreeMotion.through(PLACES, path)
    frames = simulate_frames(city_and_fields(280, 220, seed=3), CAMERA, motion, num_frames=count)
    return frames + 0.002 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(1))


def decaying(frequency: float, decay: float) -> torch.Tensor:
    """(N, 2) px along x and y."""
    tone = torch.exp(-decay * PLACES) * torch.sin(2 * math.pi * frequency * PLACES)
    return torch.stack([3.0 * tone, 1.5 * tone], -1)


def test_displacements_of_free_motions_are_within_two_standard_deviations():
    bent = PLACES.square()  # of sweeps: tones would take the place of the spline
    path = torch.stack([1.5 * torch.sin(700 * PLACES + 900 * bent), 1.1 * torch.sin(330 * PLACES + 900 * bent)], -1)
    frames, motion = frames_of(path, 6), FreeMotion.through(PLACES, path)
    right, certain, found = (
        detect_motion(frames, wrong(CAMERA, *of)) for of in ((0.0, 0.0), (0.01, 0.0), (0.01, 0.01))
    )
    true = motion.displacement(found.times)
    error = (found.displacement - true + true.mean((0, 1))).abs()
    assert float((error < 2 * found.std).double().mean()) > 0.95
    by_row_time = (found.std.square() - certain.std.square()).clamp(min=0).mean((0, 1)).sqrt()
    at_right = right.motion.displacement(found.times) - found.motion.displacement(found.times)
    changed = (at_right - at_right.mean((0, 1))).square().mean((0, 1)).sqrt()
    assert torch.allclose(by_row_time, changed, rtol=0.3)


def test_the_tones_of_a_tracker_are_within_two_standard_deviations():
    frames, timing = frames_of(decaying(61.0, 1 / 0.3), 16), wrong(CAMERA, 0.01, 0.01)
    tracker, starts = VibrationTracker(timing), timing.frame_starts(16).tolist()
    for frame, start in zip(frames, starts, strict=True):
        tracked = tracker.update(frame, start)
    envelope = math.exp(-(starts[-1] + timing.time_to_middle(frames.shape[-2])) / 0.3)
    error = tracked.detection.vibration.amplitude[:, 0] / envelope - torch.tensor([3.0, 1.5])
    assert bool((error.abs() < 2 * tracked.detection.std.amplitude[:, 0] / envelope).all())


def test_standard_deviations_contain_that_of_the_row_time():
    """In two frames the rows of a frame determine the frequency, which is wrong in proportion to the row time."""
    frames, timing, _ = example_frames()
    right, other = (detect_vibration(frames, wrong(timing, error, 0.01)) for error in (0.0, 0.01))
    for name in ("amplitude", "frequency", "phase"):
        error = (getattr(other.vibration, name) - getattr(right.vibration, name)).abs()
        assert torch.allclose(getattr(right.std, name), error, rtol=0.15)  # second order
    assert torch.allclose(right.std.period, right.std.frequency / right.vibration.frequency**2)
    assert "± 4e-07 s" in right.assumptions[0]
