"""Properties that hold for all inputs: signs, orientation, adjoints, and splits that cover every row exactly once."""

import itertools
import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rsvib_torch import FreeMotion, SensorTiming, Vibration, row_psf, simulate_frames
from rsvib_torch.frames.orientation import frames_from_row_order, frames_to_row_order, offsets_from_row_order
from rsvib_torch.imaging import blur_rows, blur_rows_adjoint
from rsvib_torch.restoration.exact.scene_solver import join_windows, row_windows
from rsvib_torch.stacks.windows import cut_windows

few = settings(max_examples=20, deadline=None, derandomize=True, database=None)
seeds = st.integers(0, 2**31)
sizes = st.integers(1, 40)


def numbers(low, high):
    return st.floats(low, high, allow_subnormal=False)


@st.composite
def vibrations(draw, largest=4.0):
    tones = draw(st.integers(1, 3))

    def values(low, high, *shape):
        count = math.prod(shape)
        drawn = draw(st.lists(numbers(low, high), min_size=count, max_size=count))
        return torch.tensor(drawn, dtype=torch.float64).reshape(shape)

    return Vibration(
        values(0.0, largest, 2, tones),
        values(0.0, 500.0, 2, tones),
        values(-math.pi, 3.14, 2, tones),
        values(-50.0, 50.0, 2),
        values(-200.0, 200.0, 2),
    )


@st.composite
def motions(draw):
    tones = draw(vibrations())
    if draw(st.booleans()):
        return tones
    return FreeMotion(random_tensor(draw(seeds), 2, draw(st.integers(4, 12))), -0.01, 5e-3, tones)


@st.composite
def timings(draw):
    return SensorTiming(
        row_time=draw(numbers(1e-5, 1e-4)),
        exposure_rows=draw(numbers(0.5, 60.0)),
        frame_rows=draw(st.integers(80, 400)),
        scan_axis=draw(st.sampled_from([-2, -1])),
        readout_direction=draw(st.sampled_from(["forward", "reverse"])),
    )


def random_tensor(seed, *shape):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


# Signs


@settings(few, max_examples=8)
@given(motions(), timings(), numbers(0.0, 0.05))
def test_offset_is_later_minus_earlier_and_changes_sign_with_the_order(motion, timing, start):
    starts = torch.linspace(start, start + 0.02, 9, dtype=torch.float64)
    later = starts + timing.frame_period
    offset = motion.offset(starts, later, timing.exposure_time)
    torch.testing.assert_close(offset, -motion.offset(later, starts, timing.exposure_time), rtol=0, atol=1e-12)
    nodes = (torch.arange(400, dtype=torch.float64) + 0.5) / 400 * timing.exposure_time
    means = [motion.displacement(times[:, None] + nodes).mean(1) for times in (starts, later)]
    torch.testing.assert_close(offset, means[1] - means[0], rtol=0, atol=2e-3)


@few
@given(numbers(0.1, 5.0), numbers(1.0, 400.0), numbers(-3.14, 3.14), timings())
def test_negative_gain_is_a_phase_of_pi(amplitude, frequency, phase, timing):
    """Offsets are a tone with amplitude |gain| A sinc(f T_e); the sign of the gain is a phase of pi (Eqs. 4-8)."""
    vibration = Vibration(amplitude, frequency, phase)
    gain = float(vibration.gain(timing.frame_period)[0, 0])
    attenuated = amplitude * float(torch.sinc(torch.tensor(frequency * timing.exposure_time, dtype=torch.float64)))
    starts = torch.linspace(0, 0.02, 50, dtype=torch.float64)
    middle = starts + 0.5 * timing.exposure_time + 0.5 * timing.frame_period
    turn = math.pi if gain < 0 else 0.0
    expected = abs(gain) * attenuated * torch.cos(2 * math.pi * frequency * middle + phase + turn)
    offset = vibration.offset(starts, starts + timing.frame_period, timing.exposure_time)[:, 0]
    torch.testing.assert_close(offset, expected, rtol=0, atol=1e-9)


# Orientation


@few
@given(timings(), seeds, sizes, sizes)
def test_orientation_of_frames_is_inverted(timing, seed, height, width):
    frames = random_tensor(seed, 2, height, width)
    rows = frames_to_row_order(frames, timing)
    assert torch.equal(frames_from_row_order(rows, timing), frames)
    assert torch.equal(frames_to_row_order(rows, timing.in_row_order()), rows)


@few
@given(motions(), timings())
def test_orientation_of_motions_is_inverted(motion, timing):
    times = torch.linspace(-0.01, 0.1, 23, dtype=torch.float64)
    rows = motion.to_row_order(timing)
    returned = rows.from_row_order(timing)
    for name in ("displacement", "velocity", "drift"):
        expected = getattr(motion, name)(times)
        torch.testing.assert_close(getattr(returned, name)(times), expected, rtol=1e-9, atol=1e-9)
        in_image = offsets_from_row_order(getattr(rows, name)(times), timing)
        torch.testing.assert_close(in_image, expected, rtol=1e-9, atol=1e-9)
    bounds = rows.largest_displacement(0.0, 0.1), motion.largest_displacement(0.0, 0.1)
    torch.testing.assert_close(bounds[0], bounds[1].flip(-1) if timing.scan_axis == -1 else bounds[1])


@settings(few, max_examples=8)
@given(vibrations(), timings(), seeds)
def test_turned_sensor_records_turned_frames(vibration, timing, seed):
    scene = random_tensor(seed, 112, 104)
    frames = simulate_frames(scene, timing, vibration, frame_size=(20, 16))
    in_rows = simulate_frames(
        frames_to_row_order(scene, timing),
        timing.in_row_order(),
        vibration.to_row_order(timing),
        frame_size=(16, 20) if timing.scan_axis == -1 else (20, 16),
    )
    torch.testing.assert_close(frames, frames_from_row_order(in_rows, timing), rtol=0, atol=1e-9)


# Adjoints: <A x, y> = <x, A^T y>


@few
@given(vibrations(), timings(), seeds, st.sampled_from(["linear", "cubic"]), st.integers(3, 20), st.integers(3, 20))
def test_adjoint_of_the_blur(vibration, timing, seed, interpolation, height, width):
    psf = row_psf(vibration, timing.row_starts(1, 9)[0], timing, interpolation=interpolation, quadrature="gauss")
    scene, frame = random_tensor(seed, 2, height, width), random_tensor(seed + 1, 2, 9, 7)
    blurred = blur_rows(scene, psf, frame_width=7, origin=(1, -2))
    adjoint = blur_rows_adjoint(frame, psf, scene.shape, origin=(1, -2))
    torch.testing.assert_close((blurred * frame).sum(), (scene * adjoint).sum(), rtol=1e-10, atol=1e-10)


# Splits


@few
@given(st.integers(1, 300), st.integers(1, 8), st.integers(0, 20))
def test_windows_cover_every_row_once(rows, count, overlap):
    windows = row_windows(rows, count, overlap)
    values = torch.arange(2 * rows).reshape(rows, 2)
    split = torch.stack([values[window] for window in windows], dim=-2) if len(windows) > 1 else values[:, None]
    assert torch.equal(join_windows(split, windows), values)
    for before, after in itertools.pairwise(windows):
        assert before.stop - after.start >= 2 * overlap


@few
@given(st.integers(1, 300), st.integers(2, 40))
def test_stack_windows_cover_every_frame_once(num_frames, size):
    cut = cut_windows(num_frames, size)
    kept = [frame for window in cut for frame in window.written]
    assert kept == list(range(num_frames))
    pairs = [pair for window in cut for pair in itertools.pairwise(window.frames)]
    assert pairs == list(itertools.pairwise(range(num_frames)))
    assert all(len(window.frames) <= size for window in cut)
