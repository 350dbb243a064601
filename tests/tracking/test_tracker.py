"""VibrationTracker: against truth from an independent camera, and against the batch on the same frames."""

import copy
import pickle
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch
from truth import crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch.registration.corners import CornerFollower
from rsvib_torch.tracking.live_path import LivePath

SIZE, RATE = 160, 30.0
TIMING = rsv.SensorTiming(row_time=150e-6, exposure_rows=4, frame_rows=1 / RATE / 150e-6)
SCENE = draw_scene(SIZE + 80, SIZE + 80, seed=3)
MIDDLE = 0.5 * (SIZE - 1 + 4) * 150e-6  # s from the start of a frame to its middle
A, F = np.array([2.1, 1.6]), np.array([52.0, 71.0])


@dataclass(frozen=True)
class Sines:
    """Tones whose amplitudes and angles are any functions of time."""

    amplitude: object = lambda t: (2.1 + 0 * t, 1.6 + 0 * t)
    angle: object = lambda t: (2 * np.pi * 52.0 * t + 0.5, 2 * np.pi * 71.0 * t + 1.0)
    path: object = lambda t: (0 * t, 0 * t)

    def displacement(self, times):
        parts = zip(self.amplitude(times), self.angle(times), self.path(times), strict=True)
        return np.stack([a * np.sin(angle) + p for a, angle, p in parts], -1)


STEADY = Sines()
STILL = [np.rint(255 * SCENE).astype(np.uint8)] * 2


def taken(motion, count, noise=0.005):
    return torch.as_tensor(take_frames(SCENE, TIMING, motion, count, noise, seed=1), dtype=torch.float32)


def track(frames, times=None, **options):
    tracker = rsv.VibrationTracker(TIMING, columns=None, **options)
    times = [None] * len(frames) if times is None else times
    return [tracker.update(frame, time) for frame, time in zip(frames, times, strict=True)]


def errors(found, amplitude=A, frequency=F):
    """Errors of amplitude and frequency (2, 2) of the strongest tones."""
    return np.stack(
        [found.vibration.amplitude[:, 0].numpy() - amplitude, found.vibration.frequency[:, 0].numpy() - frequency]
    )


def phase_errors(found, index):
    """Of a steady vibration, (2,) rad."""
    truth = 2 * np.pi * F * (index / RATE) + np.array([0.5, 1.0])
    return np.angle(np.exp(1j * (found.vibration.phase[:, 0].numpy() - truth)))


@pytest.fixture(scope="module", name="steady")
def make_steady():
    frames = taken(STEADY, 24)
    return frames, track(frames)


def test_frames_after_the_end_of_a_vibration_do_not_become_worse():
    """The tones of the frames before fit the first frame at rest badly; they would lower its PSNR by 10 dB."""
    end = 12 / RATE
    stopping = Sines(amplitude=lambda t: (2.1 * (t < end - 1e-9), 1.6 * (t < end - 1e-9)))
    frames = taken(stopping, 15)
    for frame, tracked in list(zip(frames, track(frames), strict=True))[12:]:
        assert decibel(tracked.restored.numpy(), crop(SCENE)) > decibel(frame.numpy(), crop(SCENE)) - 1
    assert not tracked.detection.reliable.any()


def test_result_agrees_with_the_batch_within_the_standard_deviations(steady):
    frames, tracked = steady
    ours = tracked[-1].detection
    batch = rsv.detect_vibration(frames[-8:], TIMING, roll=False)
    for name in ("amplitude", "frequency"):
        difference = getattr(ours.vibration, name) - getattr(batch.vibration, name)
        std = (getattr(ours.std, name).square() + getattr(batch.std, name).square()).sqrt()
        assert (difference.abs() < 4 * std)[:, 0].all()
        assert (getattr(ours.std, name)[:, 0] > 0).all()
    assert ours.reliable.tolist() == [True, True]
    assert ours.timing == TIMING


def test_phase_counts_from_the_first_row_of_the_frame(steady):
    _, tracked = steady
    assert np.abs(phase_errors(tracked[-1].detection, 23)).max() < 0.01


def test_frames_are_restored_without_delay(steady):
    frames, tracked = steady
    still = crop(SCENE)
    for index in (8, 15, 23):
        assert decibel(tracked[index].restored, still) > decibel(frames[index], still) + 8
    assert torch.equal(tracked[0].restored, frames[0])
    assert [one.state for one in tracked] == ["searching"] * 3 + ["tracking"] * 21
    assert sum(one.detected for one in tracked) == 1


def test_changes_of_frequency_and_amplitude_are_followed():
    """From 0.2 s on, 2 Hz/s along x; the amplitude along y doubles within a second."""

    def later(t):
        return np.maximum(t - 0.2, 0)

    changing = Sines(
        amplitude=lambda t: (2.1 + 0 * t, 1.6 * 2 ** later(t)),
        angle=lambda t: (2 * np.pi * (52.0 * t + later(t) ** 2) + 0.5, 2 * np.pi * 71.0 * t + 1.0),
    )
    tracked = track(taken(changing, 26))
    moved = later(25 / RATE + MIDDLE)
    assert moved > 0.6
    error = np.abs(errors(tracked[-1].detection, A * [1.0, 2**moved], F + np.array([2 * moved, 0.0])))
    assert (error.max(-1) < [0.03, 0.15]).all()
    assert not any(one.detected for one in tracked[4:])


def test_dropped_frames_are_handled_by_their_times(steady):
    frames, _ = steady
    kept = [*range(8), 10, 11, 15, 16, 21, 22]
    tracked = track(frames[kept], [index / RATE for index in kept])
    assert np.abs(errors(tracked[-1].detection)).max() < 0.004
    assert tracked[-1].detection.reliable.all()
    untold = track(frames[kept])  # as if no frame were missing
    assert max(abs(errors(one.detection)).max() for one in untold[8:] if one.detection is not None) > 0.03


def test_the_motion_of_late_frames_is_predicted(steady):
    frames, measured = steady
    tracker, still = rsv.VibrationTracker(TIMING, columns=None), crop(SCENE)
    for index, frame in enumerate(frames):
        is_late = index >= 12 and index % 2 > 0
        tracked = tracker.update(frame, measure=not is_late)
        assert tracked.state == measured[index].state
        if not is_late:
            continue
        assert tracked.measurements is None
        assert decibel(tracked.restored, still) > decibel(measured[index].restored, still) - 0.3
        assert np.abs(errors(tracked.detection)).max() < 0.01
        assert np.abs(phase_errors(tracked.detection, index)).max() < 0.01


def test_a_late_frame_whose_motion_is_uncertain_is_measured():
    def path(t):
        return 8.0 * np.sin(2 * np.pi * 3.1 * t), 6.0 * np.sin(2 * np.pi * 2.3 * t + 1.0)

    tracker = rsv.VibrationTracker(TIMING, columns=None)
    late = [tracker.update(frame, measure=index % 2 == 0) for index, frame in enumerate(taken(Sines(path=path), 24))]
    assert all(one.measurements is not None for one in late[5::2])


def test_the_number_of_tones_changes():
    def path(t):
        return 0.9 * (t > 0.25) * np.sin(2 * np.pi * 97.0 * t), 0 * t

    tracked = track(taken(Sines(path=path), 20))
    before, after = tracked[6].detection.vibration, tracked[-1].detection.vibration
    assert int(before.amplitude.count_nonzero()) == 2
    assert after.frequency[0].numpy() == pytest.approx([52.0, 97.0], abs=0.05)
    assert after.amplitude[0].numpy() == pytest.approx([2.1, 0.9], abs=0.01)
    assert 2 <= sum(one.detected for one in tracked) <= 3


@pytest.mark.parametrize(("amplitude", "frequency"), [((1.6, 4.8), (65.0, 143.0)), ((0.9, 2.7), (164.0, 186.0))])
def test_tones_that_row_bands_do_not_show_are_found_directly(amplitude, frequency):
    fast = Sines(
        amplitude=lambda t: tuple(one + 0 * t for one in amplitude),
        angle=lambda t: tuple(2 * np.pi * one * t + 0.7 for one in frequency),
    )
    *_, last = track(taken(fast, 14))
    assert last.detection.reliable.all()
    assert np.abs(errors(last.detection, np.array(amplitude), np.array(frequency))).max() < 0.05


def test_an_axis_is_reliable_after_one_of_its_tones_has_ended():
    """The tone that has ended is too small in every later frame, which is no reason against the other one."""
    further = Sines(path=lambda t: (1.1 * np.sin(2 * np.pi * 98.0 * t) * (t < 12 / RATE), 0 * t))
    *_, last = track(taken(further, 24))
    assert last.detection.reliable.tolist() == [True, True]
    assert np.abs(errors(last.detection)).max() < 0.02


def test_a_camera_at_rest_needs_no_further_detection():
    tracked = track(taken(Sines(amplitude=lambda t: (0 * t, 0 * t)), 14))
    assert [one.detected for one in tracked] == [index == 3 for index in range(14)]
    assert tracked[-1].state == "tracking"
    assert not tracked[-1].motion.moving_axes().any()


@pytest.mark.parametrize(("roll", "frequency", "reliable"), [(0.01, 0.5, True), (0.003, 41.0, False)])
def test_a_slow_roll_of_the_hand_does_not_affect_tones_but_a_fast_one_does(roll, frequency, reliable):
    timing = rsv.SensorTiming(row_time=100e-6, exposure_rows=6, frame_rows=1 / RATE / 100e-6)
    rolling = rsv.Vibration([*A, roll], [*F, frequency], [0.5, 1.0, 0.3])
    frames = rsv.simulate_frames(draw_scene(320, 320, seed=3), timing, rolling, 9, frame_size=(240, 240))
    tracker = rsv.VibrationTracker(timing)
    found = [one.detection for one in map(tracker.update, frames) if one.detection is not None]
    assert len(found) == 6
    assert all(bool(one.reliable[0]) == reliable for one in found)
    if reliable:
        assert [float(one.vibration.amplitude[0, 0]) for one in found] == pytest.approx([A[0]] * 6, abs=0.015)  # px


def test_attempts_to_detect_motion_without_tones_become_rare():
    random = np.random.default_rng(4)
    frequencies, phases = random.uniform(35.0, 200.0, (2, 60)), random.uniform(0.0, 2 * np.pi, (2, 60))

    def noise_like(times):
        angles = 2 * np.pi * frequencies[..., None] * np.ravel(times) + phases[..., None]
        return tuple((0.15 * np.sin(angles).sum(1)).reshape(2, *np.shape(times)))

    frames = taken(Sines(lambda t: (0 * t, 0 * t), path=noise_like), 112)
    tracker = rsv.VibrationTracker(TIMING)
    detected = np.array([index for index, frame in enumerate(frames) if tracker.update(frame).detected])
    assert 3 <= len(detected) <= 8  # 18 if they are four frames apart after 64 frames
    assert np.diff(detected)[-1] >= 30


def test_slow_motion_is_part_of_the_path_and_not_of_the_tones():
    def path(t):
        return 6 * np.sin(2 * np.pi * 0.8 * t), 20.0 * t

    tracked = track(taken(Sines(path=path), 24), steady=1e-6)
    times = np.array([one.time for one in tracked[5:]]) + MIDDLE
    found = np.stack([one.path.numpy() for one in tracked[5:]])
    truth = np.stack(path(times), -1)
    assert np.abs((found - found[0]) - (truth - truth[0])).max() < 0.15
    assert np.abs(errors(tracked[-1].detection)).max() < 0.01


def test_a_scene_that_cannot_be_followed_is_not_moved():
    frames = torch.as_tensor(np.random.default_rng(0).random((12, SIZE, SIZE)), dtype=torch.float32)  # no scene
    tracked = track(frames)
    assert all(torch.equal(one.restored, frame) for one, frame in zip(tracked, frames, strict=True))
    assert not any(one.detection is not None and one.detection.reliable.any() for one in tracked)


def test_memory_is_constant(steady):
    frames, _ = steady
    tracker, sizes = rsv.VibrationTracker(TIMING, steady=0.2, window=4), []
    for index, frame in enumerate(frames):
        tracker.update(frame)
        if index in (11, 23):
            sizes.append(len(pickle.dumps(tracker)))
    assert sizes[1] < 1.05 * sizes[0]


def test_frames_that_cannot_be_used_do_not_disturb(steady):
    frames, _ = steady
    tracker = rsv.VibrationTracker(TIMING, columns=None)
    states = []
    for index, frame in enumerate(frames[:14]):
        given = torch.full_like(frame, 0.5) if index == 8 else frames[9] if index == 10 else frame
        tracked = tracker.update(given)
        states.append(tracked.state)
        if tracked.state == "unusable":
            assert torch.equal(tracked.restored, given)
    assert [index for index, state in enumerate(states) if state == "unusable"] == [8, 10]
    assert np.abs(errors(tracked.detection)).max() < 0.004


def test_a_copy_of_a_tracker_does_not_affect_the_tracker(steady):
    frames, tracked = steady[0], track(steady[0][:12], steady=0.2)
    tracker = rsv.VibrationTracker(TIMING, columns=None, steady=0.2)
    for frame in frames[:8]:
        tracker.update(frame)
    other = copy.copy(tracker)
    for frame in frames[16:20]:
        other.update(frame)
    again = [tracker.update(frame) for frame in frames[8:12]]
    for ours, theirs in zip(again, tracked[8:12], strict=True):
        assert torch.equal(ours.path, theirs.path)
        assert torch.equal(ours.detection.vibration.phase, theirs.detection.vibration.phase)


def test_frames_without_a_common_scene_or_with_few_rows_are_searched_in_vain(steady):
    frames, _ = steady
    scene = torch.as_tensor(draw_scene(SIZE, SIZE + 900, seed=9), dtype=torch.float32)
    sliding = torch.stack([scene[:, 100 * index : 100 * index + SIZE] for index in range(9)])  # overlap: 60 px
    for given in (sliding, frames[:9, :50]):
        tracked = track(given)
        assert {one.state for one in tracked} == {"searching"}
        assert [index for index, one in enumerate(tracked) if one.detected] == [3]
        assert all(one.detection is None and one.path.isnan().all() for one in tracked)


def test_a_frame_with_almost_no_detail_is_survived(steady):
    frames = steady[0][:16].clone()
    frames[8] = 0.3
    frames[8, 1::2] += 1e-5
    frames[8, 7, 9] = 0.4  # between the rows of which the contrast is a sample
    tracked = track(frames)
    assert all(torch.isfinite(one.restored).all() for one in tracked)
    assert tracked[-1].state == "tracking"
    assert np.abs(errors(tracked[-1].detection)).max() < 0.004


def test_missing_pixels_and_channels(steady):
    frames, _ = steady
    tracker = rsv.VibrationTracker(TIMING, columns=None, channels="last")
    for frame in frames[:9]:
        colours = torch.stack([frame, 0.5 * frame, frame], -1)
        colours[40:60, 50:80] = torch.nan
        tracked = tracker.update(colours)
    assert np.abs(errors(tracked.detection)).max() < 0.01
    assert tracked.restored.shape == colours.shape
    assert torch.isfinite(tracked.restored).all()


def test_wrong_frames_and_times_are_refused(steady):
    frames, _ = steady
    with pytest.raises(ValueError, match="must not have frame_start_times: pass the time of each frame to update"):
        rsv.VibrationTracker(replace(TIMING, frame_start_times=(0.0, 1.0)))
    tracker = rsv.VibrationTracker(TIMING)
    tracker.update(frames[0], 2.0)
    with pytest.raises(ValueError, match=r"time must be later than that of the frame before, 2 s, got 1\.5 s"):
        tracker.update(frames[1], 1.5)
    with pytest.raises(ValueError, match="frame has 160 rows of 100 px, the frames before had 160 of 160"):
        tracker.update(frames[1][:, :100])
    tracker.reset()
    assert tracker.update(frames[1], 1.5).state == "searching"


@pytest.mark.parametrize("unit", [1e3, 1e6, RATE, 2.5])  # ms, us, numbers of frames, and another frame rate
def test_times_in_another_unit_are_why_no_motion_is_found(steady, unit):
    frames, _ = steady
    for tracked in track(frames[:6], [unit * number / RATE for number in range(6)])[1:]:
        if tracked.state == "searching":
            message = f"by their times, frames are {unit / RATE:.3g} s apart, but the frame period is 0.0333 s"
            assert tracked.lost.startswith(message)
    for tracked in track(frames[:3], [0.0, 1 / RATE, 9 / RATE]):  # frames are missing
        assert tracked.lost == ""


def test_large_motions_with_gaps_end_in_a_search_and_not_in_an_error(steady):
    """Filters whose covariance overflows, or whose equations have no solution, ended the session."""
    frames, _ = steady
    generator = np.random.default_rng(107)
    step, longest, share = int(generator.choice([30, 60])), 10 ** generator.uniform(-1, 3), generator.choice([0.2, 0.5])
    tracker, time, lost = rsv.VibrationTracker(TIMING, columns=None, window=2), 0.0, []
    for index in range(20):
        shift = 0 if index < 6 else step * (1 if index % 2 else -1)
        frame = torch.roll(frames[index], (shift, -shift), (0, 1))
        time += 1 / RATE if index < 6 or generator.random() > share else generator.uniform(0.03, longest)
        tracked = tracker.update(frame, time, measure=bool(generator.random() < 0.8))
        lost.append(tracked.state)
        assert torch.isfinite(tracked.restored).all()
        assert tracked.detection is None or tracked.detection.vibration.amplitude.max() < SIZE
    assert {"searching", "tracking"} == set(lost[6:])
    assert torch.isfinite(tracker.update(frames[20], time + 1e9).restored).all()


def walk(t):
    """Sway and bob of a person, 2.5 steps per second, with heels that strike."""
    since = np.mod(t, 0.4)
    strike = 4.0 * np.exp(-since / 0.06) * np.sin(2 * np.pi * 11.0 * since)
    return 6.0 * np.sin(2 * np.pi * 1.25 * t) + 0.3 * strike, 5.0 * np.cos(2 * np.pi * 2.5 * t) + strike


def test_the_path_and_the_rows_of_a_steady_image_are_those_of_a_walk():
    """Predicted steps were wrong by 7 px (rms along y), and most rows were not moved."""
    motion, rows = Sines(amplitude=lambda t: (0 * t, 0 * t), path=walk), np.linspace(-0.4, 0.4, 33) * SIZE * 150e-6
    tracked = track(taken(motion, 36), steady=1.0)[4:]
    middles = np.array([one.time for one in tracked]) + MIDDLE
    truth, found = np.stack(walk(middles), -1), np.stack([one.path.numpy() for one in tracked])
    assert np.sqrt(np.square(np.diff(found - truth, axis=0)).mean(0)).max() < 0.4
    wobble, left = [], []
    for middle, one in zip(middles, tracked, strict=True):
        moved = np.stack(walk(middle + rows), -1)
        removed = one.motion.displacement(torch.as_tensor(rows)).numpy()
        wobble.append(moved - moved.mean(0))
        left.append(moved - removed - (moved - removed).mean(0))
    assert (np.square(left).mean((0, 1)) < 0.25 * np.square(wobble).mean((0, 1))).all()


@pytest.mark.parametrize("what", ["a zoom", "a person who crosses"])
def test_what_does_not_move_the_camera_does_not_move_the_rows_of_a_steady_image(what):
    """The rows of a zoom were bent by 0.2 px, and a person who covers half of the frame moved the image."""
    if what == "a zoom":  # the lens changes its scale by 0.2 in a second
        times = np.arange(20)[:, None] / RATE + TIMING.row_time * (np.arange(SIZE) + 2.0)
        y, x = np.indices((SIZE, SIZE)) - 0.5 * (SIZE - 1)
        places = 0.5 * (len(SCENE) - 1) + np.stack([x, y]) / (1.0 + 0.2 * times)[:, None, :, None]
        scene = SCENE.astype(np.float32)
        frames = [cv2.remap(scene, *of_frame.astype(np.float32), cv2.INTER_CUBIC) for of_frame in places]
        frames = torch.as_tensor(np.stack(frames))
    else:
        frames, person = taken(Sines(lambda t: (0 * t, 0 * t)), 20), torch.as_tensor(draw_scene(SIZE, 80, seed=8))
        for index, frame in enumerate(frames):
            columns = torch.arange(80) - 70 + 5 * index
            seen = (columns >= 0) & (columns < SIZE)
            frame[:, columns[seen]] = person[:, seen].float()
    rows = torch.linspace(-0.4, 0.4, 33) * SIZE * TIMING.row_time
    tracked = track(frames, steady=0.5)[5:]
    assert all(one.motion.displacement(rows).std(0).max() < 0.05 for one in tracked)
    assert all(one.motion.image_shift.abs().max() < 0.1 for one in tracked)


def test_the_line_of_a_steady_image_has_always_as_many_places():
    """By rounding, 30 or 31 places counted, and the image of a slow sway shook by up to twice as much."""
    live, shifts, corners = LivePath.started(TIMING), [], CornerFollower(TIMING)
    pairs = tuple(pair for frame in STILL if (pair := corners.next(frame, 0.0)) is not None)
    for index in range(75):
        place = np.array([3.0 * (index / RATE) ** 2, 0.0])
        live = replace(live, middle=index / RATE + MIDDLE, place=place, pairs=pairs).steadied(1 / RATE, 1.0)
        shifts.append(live.shift)
    assert np.ptp(shifts[31:], 0).max() < 1e-6


@pytest.mark.parametrize("repeats", [True, False])
def test_the_path_before_a_scene_that_repeats_itself_is_not_known(repeats):
    """Corners do not show by how many slats of a fence the camera moves; a drawn scene is followed."""
    scene = 255 * draw_scene(SIZE, SIZE + 40, seed=6)
    if repeats:
        scene = np.broadcast_to(80.0 + 100.0 * (np.arange(SIZE + 40) % 20 < 8), (SIZE, SIZE + 40))
    live = LivePath.started(TIMING)
    for index in range(4):
        grey = np.ascontiguousarray(scene[:, 3 * index : 3 * index + SIZE]).astype(np.uint8)
        live = live.followed(grey, index / RATE, rsv.Vibration([0.0, 0.0], 0.0, 0.0))
    assert bool(live.pairs) != repeats
    np.testing.assert_allclose(live.place, [0.0 if repeats else -9.0, 0.0], atol=0.5)


def test_a_steady_image_does_not_jump_where_its_path_is_lost(steady):
    """It jumped back by its whole displacement, and the video shook more than as taken."""

    def path(t):
        return 12.0 * np.sin(2 * np.pi * 0.9 * t), 0 * t

    frames = taken(Sines(path=path), 16)
    scene = torch.as_tensor(draw_scene(SIZE, SIZE + 400, seed=9), dtype=torch.float32)
    others = [torch.full_like(frames[0], 0.5), *(scene[:, 100 * index : 100 * index + SIZE] for index in range(3))]
    tracked = track(torch.stack([*frames, *others]), steady=0.5)
    shifts = np.stack([one.motion.image_shift.numpy() for one in tracked])
    unknown = np.array([bool(one.path.isnan().all()) for one in tracked])
    assert not unknown[4:16].any()
    assert unknown[[16, 18, 19]].all()
    assert np.abs(shifts[15]).max() > 2.0
    assert shifts[16] == pytest.approx(shifts[15])  # a frame that shows nothing
    assert shifts[18:] == pytest.approx(shifts[17:19] * np.exp(-1 / RATE / 0.5), abs=1e-9)
    assert not torch.equal(tracked[18].restored, others[2])
