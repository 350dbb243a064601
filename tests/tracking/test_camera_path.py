"""The path of a camera and its vibration from corners, on frames of a camera that is held by hand, with parallax."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter
from truth import draw_scene

from rsvib_torch import SensorTiming, calibrate_row_time_by_motion
from rsvib_torch.registration.corners import CornerFollower, Corners
from rsvib_torch.tracking.camera_path import camera_path, shake
from rsvib_torch.tracking.window_tones import WindowTone
from rsvib_torch.video.steadying import largest_displacement, steady_shifts

HEIGHT, WIDTH, COUNT, RATE, SAMPLES = 216, 288, 36, 30.0, 3
TIMING = SensorTiming(row_time=90e-6, exposure_rows=20, frame_rows=1 / RATE / 90e-6)
TONES = {0: (1.2, 93.0, 0.3), 1: (0.8, 71.0, 1.0)}  # axis: px, Hz, rad


def hand(t):
    """Components (4, ...) of a hand: x, y (px), roll (rad), zoom."""
    x = 9.0 * np.sin(2 * np.pi * 1.1 * t) + 1.5 * np.sin(2 * np.pi * 7.0 * t + 1.0) + 15.0 * t
    y = 6.0 * np.sin(2 * np.pi * 0.8 * t + 2.0) + 1.2 * np.sin(2 * np.pi * 9.0 * t)
    roll = 0.01 * np.sin(2 * np.pi * 1.7 * t) + 0.002 * np.sin(2 * np.pi * 6.0 * t)
    return np.stack([x, y, roll, 0.01 * np.sin(2 * np.pi * 0.5 * t)])


def vibration(t, tones, decay, sweep):
    """(2, ...) px; the tones decay with a time in s, and their frequencies change by ``sweep`` in Hz/s."""
    parts = np.zeros((2, *t.shape))
    for axis, (size, frequency, phase) in tones.items():
        parts[axis] += size * np.exp(-t / decay) * np.sin(2 * np.pi * (frequency + 0.5 * sweep * t) * t + phase)
    return parts


def simulated(
    tones,
    subject=True,
    decay=np.inf,
    sweep=0.0,
    timing=TIMING,
    samples=SAMPLES,
    count=COUNT,
    zoom=(0.0, 0.0),
    of_hand=1.0,
    rate=RATE,
):
    """(T, H, W) counts: a scene whose left part is nearer, with a subject that walks through, as a hand records it."""
    scene = spline_filter(draw_scene(HEIGHT + 160, WIDTH + 160, 3), order=3)
    patch = draw_scene(200, 170, 9)
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    from_x, from_y = x - (WIDTH - 1) / 2, y - (HEIGHT - 1) / 2
    frames = []
    for number in range(count):
        total = np.zeros((HEIGHT, WIDTH))
        for sample in range(samples):
            t = number / rate + y[:, :1] * timing.row_time + (sample + 0.5) / samples * timing.exposure_time
            (dx, dy, roll, size), moved = of_hand * hand(t), vibration(t, tones, decay, sweep)
            size = size + zoom[0] * np.sin(2 * np.pi * zoom[1] * t)
            near = np.where(x < 0.3 * WIDTH, 3.0 * of_hand * np.sin(2 * np.pi * 0.7 * t), 0.0)
            # content at p appears at p + D(p): to first order, as the displacement is defined
            at_x = from_x - (dx + moved[0] + near - roll * from_y + size * from_x)
            at_y = from_y - (dy + moved[1] + roll * from_x + size * from_y)
            at = [at_y + (HEIGHT - 1) / 2 + 80, at_x + (WIDTH - 1) / 2 + 80]
            image = map_coordinates(scene, at, order=3, prefilter=False)
            left = 0.3 * WIDTH + 70.0 * number / RATE
            inside = (x > left) & (x < left + 60) & (y > 60) & (y < 150)
            if subject:
                image = np.where(
                    inside, map_coordinates(patch, [y - 40, x - left + 20], order=1, mode="reflect"), image
                )
            total += image / samples
        frames.append(np.clip(np.round(255 * (total + 0.004 * rng.normal(size=total.shape))), 0, 255).astype(np.uint8))
    return frames


RECORDINGS = {}


def recorded(tones, **options):
    """Frames of ``simulated``; those that several tests use are simulated once."""
    key = repr((list(tones.items()), options))
    if key not in RECORDINGS:
        RECORDINGS[key] = simulated(tones, **options)
    return [frame.copy() for frame in RECORDINGS[key]]


def fitted(frames, timing=TIMING):
    follower = CornerFollower(timing)
    pairs = [follower.next(frame, number / RATE) for number, frame in enumerate(frames)]
    return pairs[1:], camera_path(pairs[1:], timing, frames[0].shape)


def test_tones_and_path_of_a_hand_with_parallax_and_a_subject():
    pairs, path = fitted(recorded(TONES))
    tones = {tone.axis: tone for tone in path.tones(0.0)}
    assert len(path.tones(0.0)) == 2
    for axis, (size, frequency, phase) in TONES.items():
        # three samples of the exposure average less than all of it, by 1 to 2 %
        assert abs(tones[axis].coefficient) == pytest.approx(size, rel=0.05)
        assert tones[axis].frequency == pytest.approx(frequency, abs=0.05)
        error = np.angle(tones[axis].coefficient * np.exp(-1j * (phase - np.pi / 2)))
        assert abs(error) < 0.1
    times = np.arange(2, COUNT - 2) / RATE + 0.01
    true = hand(times).T
    errors = path.places(times) - (true - true[0])
    # px, changes from frame to frame; a tenth of those of the hand. Parallax adds up slowly, and does not count
    assert np.abs(np.diff(errors[:, :2], 2, axis=0)).max() < 0.15
    assert np.abs(np.diff(true[:, :2], 2, axis=0)).max() > 1.5
    assert np.abs(np.diff(errors[:, 2])).max() < 5e-4  # rad
    assert np.sqrt(np.mean([shake(pair)[1] ** 2 for pair in pairs])) > 0.3  # the rows vibrate


def test_a_hand_without_vibration_has_no_tones_and_shows_the_readout():
    frames = recorded({}, subject=False)
    right, reverse = (fitted(frames, replace(TIMING, readout_direction=way))[1] for way in ("forward", "reverse"))
    assert right.tones(0.5) == []
    assert right.windows[0].other_readout is None
    other, stated, with_other = reverse.windows[0].other_readout
    assert other == "in reverse"
    assert with_other < 0.8 * stated
    # rows are displaced as they are read, not as it is stated
    forward, backward = (path.derivatives(np.array([0.711]), 1)[0, :2] for path in (right, reverse))
    np.testing.assert_allclose(backward, -forward, atol=5.0)
    assert np.abs(forward).max() > 30  # px/s


@pytest.mark.parametrize("tones", [{}, TONES])
def test_columns_that_are_read_one_after_another_are_noticed(tones):
    """A phone held upright: the rows of a clip that was reported as steady moved apart as much as before."""
    frames = [np.ascontiguousarray(frame.T) for frame in recorded(tones, subject=False)]
    row_time = TIMING.row_time * HEIGHT / WIDTH
    timing = SensorTiming(row_time, TIMING.exposure_time / row_time, 1 / RATE / row_time)
    path = fitted(frames, timing)[1]
    other, stated, by_columns = path.windows[0].other_readout
    assert other == "column by column"
    assert by_columns < (0.3 if tones else 0.9) * stated
    assert path.tones(0.7) == []  # frames are moved as a whole
    assert not path.derivatives(np.array([0.7]), 1).any()


def test_slow_motion_with_the_frame_rate_of_its_playback_contradicts_the_readout():
    """120 frames per second, stored as 30: tones of 147 Hz are none from frame to frame by the times of the file."""
    readout = SensorTiming(row_time=25e-6, exposure_rows=40, frame_rows=1 / 120 / 25e-6)
    frames = recorded({0: (1.5, 147.0, 0.3), 1: (1.0, 97.0, 1.0)}, subject=False, timing=readout, rate=120.0)
    timing = replace(readout, frame_rows=1 / RATE / 25e-6)
    path = fitted(frames, timing)[1]
    assert path.windows[0].other_readout is not None
    # with any of the readouts that explain the corners, tones displace the rows as they are displaced
    frequency = {tone.axis: tone.frequency for tone in path.tones(0.8)}
    assert frequency[0] == pytest.approx(147.0, abs=15.0)
    assert frequency[1] == pytest.approx(97.0, abs=15.0)


@pytest.mark.parametrize("factor", [0.7, 1.5, *(pytest.param(one, marks=pytest.mark.slow) for one in (1.25, 2.0))])
def test_tones_beside_a_hand_show_the_row_time(factor):
    """With the row time by the frame rate and the height, 1.5 times too long, 93 Hz became a reliable tone of 63 Hz."""
    row_time = factor * TIMING.row_time
    stated = SensorTiming(row_time, TIMING.exposure_time / row_time, 1 / RATE / row_time)
    part, *_ = fitted(recorded(TONES, subject=False), stated)[1].windows[0].other_readout
    assert float(part.split()[1]) == pytest.approx(1 / factor, abs=0.015)


@pytest.mark.slow
def test_without_a_hand_other_row_times_agree_with_a_tone():
    tones = {0: (1.2, 93.0, 0.3), 1: (0.9, 93.0, 1.0)}
    agreeing = fitted(recorded(tones, subject=False, of_hand=0.02))[1].windows[0].agreeing
    assert "in 0.76 times the time, with tones of 123 Hz" in agreeing
    assert fitted(recorded(tones, subject=False))[1].windows[0].agreeing == ()


@pytest.mark.slow
def test_several_tones_of_an_axis_are_told_from_their_aliases():
    """As long as the others are not known, they hide which alias of a tone leaves less."""
    timing = SensorTiming(row_time=50e-6, exposure_rows=10, frame_rows=1 / RATE / 50e-6)
    first, second = {0: (0.6, 77.7, 0.3), 1: (0.53, 100.9, 1.0)}, {0: (0.69, 88.0, 1.0), 1: (0.92, 105.6, 2.0)}

    class Both(dict):
        def items(self):
            return [*first.items(), *second.items()]

    frames = recorded(Both(), subject=False, timing=timing, count=64)
    _, path = fitted(frames, timing)
    assert sorted((tone.axis, round(tone.frequency, 1)) for tone in path.tones(0.5)) == [
        (0, 77.7),
        (0, 88.0),
        (1, 100.9),
        (1, 105.6),
    ]


def test_a_part_of_the_rows_that_moves_by_itself_is_no_vibration():
    """A dashboard moves the same rows against the others again and again, as a tone at the frame rate does."""
    frames, top = recorded({}, subject=False), 150
    dashboard = np.round(255 * draw_scene(HEIGHT - top, WIDTH, 7)).astype(np.uint8)
    for frame in frames:
        frame[top:] = dashboard
    (window,) = fitted(frames)[1].windows
    # what moves apart from the scene refuses the window; without a limit, there were six tones, of up to 10 px
    assert window.residual_of_most > 0.3
    assert all(abs(tone.at(0.0, 0.0).coefficient) < 0.5 for tone in window.tones)


def test_a_vibration_of_the_zoom_is_no_tone_along_x():
    """Off-centre corners showed zoom of 6e-3 as 0.42 +- 0.004 px along x, reliable, where the camera does not move."""
    frames = recorded({}, subject=False, zoom=(0.006, 64.0))
    tones = fitted(frames)[1].windows[0].tones
    assert all(tone.axis == 1 and tone.left_in_third > 0.25 for tone in tones)  # refused: the halves move apart


# a wobble in px of corners that move by themselves: other readouts are tried
@pytest.mark.parametrize(("rate", "wobble"), [(1000.0, 0.6), (5000.0, 0.0), (5000.0, 0.6)])
def test_tones_of_fast_cameras_are_found(rate, wobble):
    """Up to 2000 Hz were searched: two other tones were found at 1000 frames per second, and 5000 ended in an error."""
    frequency, random, height, width = 2.3 * rate, np.random.default_rng(1), 240, 320
    timing = SensorTiming(row_time=0.6 / rate / height, exposure_rows=2, frame_rows=height / 0.6)
    pairs = []
    for number in range(40):
        places = random.uniform([-width / 2, -height / 2], [width / 2, height / 2], (150, 2))
        rows = places[:, 1] / height + 0.5
        times = (number + np.arange(2) + 0.6 * rows[:, None]) / rate
        moved = np.diff(np.sin(2 * np.pi * frequency * times), axis=1) * [1.0, 0.0]
        offsets = moved + random.normal(0.0, 0.1 + wobble, (150, 2))
        every = np.ones(150, bool)
        pairs.append(Corners(0 * rows.astype(int), rows, times, places, offsets, every, np.zeros((150, 4, 4))))
    (window,) = camera_path(pairs, timing, (height, width)).windows
    (tone,) = window.tones
    assert tone.frequency == pytest.approx(frequency, rel=1e-3)
    assert tone.size == pytest.approx(1.0, abs=0.1)
    assert window.other_readout is None


def test_a_subject_on_two_fifths_of_the_frame_is_not_followed():
    """It moves, stands still, and moves again; the path of the hand was wrong by up to 4 px from frame to frame."""
    frames, right = recorded({}, subject=False), round(0.4 * WIDTH)
    subject = np.round(255 * draw_scene(HEIGHT + 60, right + 60, 7)).astype(np.uint8)
    for number, frame in enumerate(frames):
        x, y = np.round(28 + 25 * np.sin([0.35 * number, 0.25 * number + 1])).astype(int)
        frame[:, :right] = subject[y : y + HEIGHT, x : x + right]
    times = np.arange(COUNT) / RATE + 0.01
    true, found = hand(times).T, fitted(frames)[1].places(times)
    assert np.abs(np.diff(found - true, axis=0)[:, :2]).max() < 0.5
    assert np.abs(np.diff(true, axis=0)[:, :2]).max() > 2.0


def test_a_subject_on_two_thirds_of_the_frame_of_a_still_camera_is_not_followed():
    rng, left, right = np.random.default_rng(4), WIDTH // 6, 5 * WIDTH // 6
    scene, subject = (255 * draw_scene(HEIGHT + 40, WIDTH + 40, seed) for seed in (3, 7))
    frames = []
    for number in range(COUNT):
        x, y = np.round(20 + 12 * np.sin(2 * np.pi * np.array([3.1, 5.3]) * number / RATE)).astype(int)
        frame = scene[:HEIGHT, :WIDTH] + rng.normal(size=(HEIGHT, WIDTH))
        frame[:, left:right] = subject[y : y + HEIGHT, left + x : right + x]
        frames.append(np.clip(np.round(frame), 0, 255).astype(np.uint8))
    path = fitted(np.stack(frames))[1]
    assert np.abs(path.places(np.arange(COUNT) / RATE)[:, :2]).max() < 0.1  # px; the subject moves by 12 px
    assert path.tones(0.5) == []


def test_a_lamp_that_flickers_is_no_vibration():
    """Rows have up to twice the light of the same rows before: the frames were refused as different scenes."""
    frames = recorded({}, subject=False)
    rows = np.arange(HEIGHT)[:, None] * TIMING.row_time
    for number, frame in enumerate(frames):
        light = 1 + 0.35 * np.sin(2 * np.pi * 100.0 * (number / RATE + rows))
        frame[:] = np.clip(np.round(0.74 * light * frame), 0, 255)
    path, times = fitted(frames)[1], np.arange(2, COUNT - 2) / RATE + 0.01
    assert all(abs(tone.coefficient) < 0.07 for tone in path.tones(0.8))  # px; the contrast still flickers
    errors = np.diff(path.places(times) - hand(times).T, axis=0)[:, :2]
    assert np.sqrt(np.square(errors).mean()) < 0.1  # parallax


def test_a_vibration_faster_than_the_exposure_is_found():
    """Its mean over 1/60 s is a fifth of the amplitude, with the opposite sign."""
    timing = SensorTiming(row_time=90e-6, exposure_rows=1 / 60 / 90e-6, frame_rows=1 / RATE / 90e-6)
    frames = recorded({0: (3.0, 87.0, 0.3)}, subject=False, timing=timing, samples=8, count=30)
    (tone,) = fitted(frames, timing)[1].tones(0.0)
    assert tone.axis == 0
    assert tone.frequency == pytest.approx(87.0, abs=0.1)
    assert abs(tone.coefficient) == pytest.approx(3.0, rel=0.2)
    assert abs(np.angle(tone.coefficient * np.exp(-1j * (0.3 - np.pi / 2)))) < 0.2


@pytest.mark.parametrize(
    ("truth", "decay", "sweep", "times", "error"),
    [
        ({0: (1.5, 37.0, 0.3), 1: (1.0, 53.0, 1.0)}, 0.8, 0.0, (0.15, 0.7, 1.4), 0.06),  # px
        pytest.param(
            {0: (2.0, 40.0, 0.3), 1: (1.5, 63.0, 1.0)}, np.inf, 24.0, (0.3, 0.7, 1.2), 0.15, marks=pytest.mark.slow
        ),
    ],
)
def test_tones_that_decay_or_sweep_are_followed(truth, decay, sweep, times, error):
    path = fitted(recorded(truth, subject=False, decay=decay, sweep=sweep, count=48))[1]
    assert all(window.residual < path.allowed for window in path.windows)
    for time in times:
        for axis, (size, frequency, phase) in truth.items():
            tones = [tone for tone in path.tones(time) if tone.axis == axis]
            assert all(abs(tone.frequency - frequency - sweep * time) < 0.5 for tone in tones)
            turned = 2 * np.pi * (frequency + 0.5 * sweep * time) * time + phase - np.pi / 2
            expected = size * np.exp(-time / decay) * np.exp(1j * turned)
            assert abs(sum(tone.coefficient for tone in tones) - expected) < error


def test_a_few_lights_are_followed_beside_flakes_that_one_frame_shows():
    rng, (y, x) = np.random.default_rng(3), np.mgrid[:360, :640]
    lights, flakes = (rng.uniform((20, 20), (340, 620), (count, 2)) for count in (25, 120))
    follower = CornerFollower(TIMING)

    def taken(spots):
        light = sum(np.exp(-0.5 * ((y - row) ** 2 + (x - column) ** 2) / 4) for row, column in spots)
        return np.clip(220 * light, 0, 255).astype(np.uint8)

    assert follower.next(taken([*lights, *flakes]), 0.0) is None
    moved, _ = shake(follower.next(taken(lights + np.array([-2.0, 3.0])), 1 / 30))
    np.testing.assert_allclose(moved, (3.0, -2.0), atol=0.1)


def test_unrelated_frames_have_no_path():
    noise = np.random.default_rng(0).integers(0, 255, (6, HEIGHT, WIDTH), dtype=np.uint8)
    with pytest.raises(ValueError, match="the frames show different scenes, or no detail"):
        fitted(list(noise))


def test_the_smooth_path_keeps_slow_motion_and_the_limit():
    times = np.arange(150) / RATE
    places = hand(times).T

    def shifts(duration, limit):
        return steady_shifts(times, places, duration, (HEIGHT, WIDTH), limit)

    steady = places - shifts(0.5, 0.4)
    jitter = [np.abs(np.diff(path[:, :2], 3, axis=0)).mean() for path in (places, steady)]
    assert jitter[1] < 0.05 * jitter[0]
    assert np.abs(steady[:, 0].mean() - places[:, 0].mean()) < 1.0
    assert largest_displacement(shifts(2.0, 0.4), (HEIGHT, WIDTH)).max() > 0.03
    limited = largest_displacement(shifts(2.0, 0.02), (HEIGHT, WIDTH))
    assert 0.019 < limited.max() < 0.0203
    # frames that need no limit are hardly moved less, and the path is smoother than one that is cut off at the limit
    free, cut = shifts(2.0, 0.4), np.clip(shifts(2.0, 0.4), *(sign * limited.max() * WIDTH for sign in (-1, 1)))
    bends = [np.abs(np.diff((places - path)[:, 0], 2)).max() for path in (free, shifts(2.0, 0.02), cut)]
    assert bends[0] <= bends[1] < 0.5 * bends[2]
    assert not shifts(0.0, 0.1).any()


def test_a_hand_does_not_determine_the_row_time():
    """The frames have parallax, a subject, roll and zoom, and no vibration."""
    assert not calibrate_row_time_by_motion(np.stack(recorded({}, count=12)), frame_rate=RATE).reliable


def test_a_single_tone_does_not_determine_the_row_time():
    """From frame to frame, 49.5 Hz are 10.5 Hz in the other direction, which a smooth path follows."""
    shaken = [(4.0 * np.sin(2 * np.pi * 49.5 * (number / RATE + 40e-6 * np.arange(HEIGHT)))) for number in range(30)]
    scene = spline_filter(draw_scene(HEIGHT, WIDTH, 3), order=3)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    at = (np.stack([y, x - moved[:, None]]) for moved in shaken)
    frames = np.stack([map_coordinates(scene, place, order=3, prefilter=False, mode="nearest") for place in at])
    found = calibrate_row_time_by_motion(np.clip(frames, 0, 1).astype(np.float32), frame_rate=RATE)
    assert not found.reliable


def test_a_tone_that_sweeps_through_zero_has_a_positive_frequency_and_the_same_displacement():
    knots = np.full(8, 1.5 - 0.7j)
    tone = WindowTone(axis=0, frequency=12.0, knots=knots, start=-0.5, step=0.2, slope=-30.0)
    times = 0.49 + np.linspace(-0.005, 0.005, 5)
    now = tone.at(0.49, 0.0)  # 12 Hz - 30 Hz/s 0.49 s = -2.7 Hz; phases count from the middle of the window
    displaced = (now.coefficient * np.exp(2j * np.pi * now.frequency * times)).real
    assert now.frequency == pytest.approx(2.7)
    assert displaced == pytest.approx((knots[0] * tone.waves(times, ())).real, abs=0.02)
