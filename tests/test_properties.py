"""Properties that hold for all inputs: signs and adjoints."""

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rsvib_torch import SensorTiming, Vibration, row_psf
from rsvib_torch.imaging import blur_rows, blur_rows_adjoint

few = settings(max_examples=20, deadline=None, derandomize=True, database=None)
seeds = st.integers(0, 2**31)


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


@few
@given(vibrations(), timings(), seeds, st.sampled_from(["linear", "cubic"]), st.integers(3, 20), st.integers(3, 20))
def test_adjoint_of_the_blur(vibration, timing, seed, interpolation, height, width):
    """<A x, y> = <x, A^T y>."""
    psf = row_psf(vibration, timing.row_starts(1, 9)[0], timing, interpolation=interpolation, quadrature="gauss")
    scene, frame = random_tensor(seed, 2, height, width), random_tensor(seed + 1, 2, 9, 7)
    blurred = blur_rows(scene, psf, frame_width=7, origin=(1, -2))
    adjoint = blur_rows_adjoint(frame, psf, scene.shape, origin=(1, -2))
    torch.testing.assert_close((blurred * frame).sum(), (scene * adjoint).sum(), rtol=1e-10, atol=1e-10)
