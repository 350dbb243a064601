"""Arguments of public functions: the message names the argument, whatever the value."""

import math

import numpy as np
import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.core.arguments import as_numbers, check_device, check_shapes, check_tensor, checks_arguments

TIMING = rsv.SensorTiming(1e-4, 6, 104)
CURVES = (torch.zeros(1), torch.zeros(1, 2), torch.zeros(1, 2))  # times, offsets, residual of a MotionCheck
FRAMES = torch.rand(2, 96, 64, generator=torch.Generator().manual_seed(0))
VIBRATION = rsv.Vibration([1.0, 0.5], [130.0, 170.0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FRAMES.to("meta"), "frames must be a tensor with data"),
        (
            lambda: torch.nested.nested_tensor([FRAMES[0], FRAMES[0, :2]]),
            "frames must be a dense tensor, got a nested tensor",
        ),
        (FRAMES.to_sparse, r"frames must be a dense tensor.*to_dense"),
        (lambda: torch.quantize_per_tensor(FRAMES, 0.1, 0, torch.quint8), "frames must not be quantised"),
        (lambda: FRAMES.to(torch.complex64), "frames must be real numbers"),
        (lambda: FRAMES > 0.5, "frames must be real numbers"),
        (lambda: FRAMES.to(torch.float8_e4m3fn), "frames must have at least 16 bits"),
        (lambda: FRAMES.numpy().astype(object), "frames must be a tensor or array of numbers"),
        (lambda: np.ma.masked_invalid(FRAMES.numpy()), "frames must not be a masked array"),
        (lambda: None, "frames must be a tensor or array of numbers"),
        (object, "frames must be a tensor or array of numbers"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*:UserWarning")  # PyTorch states that nested and quantised tensors may change
def test_frames_that_cannot_be_computed_with(make, message):
    value = make()
    for call in (rsv.detect_vibration, rsv.register_bands, lambda v, t: rsv.restore(v, t, VIBRATION)):
        with pytest.raises(TypeError, match=message):
            call(value, TIMING)


@pytest.mark.parametrize("value", [math.inf, 1e38, -3e38, 2e15])
def test_pixels_beyond_all_scales(value):
    frames = FRAMES.clone()
    frames[1, 5, 7] = value
    with pytest.raises(ValueError, match=r"frames (must be finite, but pixel \(1, 5, 7\)|reach .*at most 1e\+15)"):
        rsv.detect_vibration(frames, TIMING)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: rsv.SensorTiming(5e-324, 6, 104), "row_time=.* s is shorter than 1 ns"),
        (lambda: rsv.SensorTiming(1e-4, 6, 104, frame_start_times=[0.0, 1e300]), "frame_start_times must be at most"),
        (lambda: rsv.SensorTiming(1e-4, 6, 104, frame_start_times="abc"), "frame_start_times must be a number"),
        (lambda: rsv.SensorTiming(1e-4, 6, 104, scan_axis=torch.zeros(2)), "scan_axis must be -2"),
        (lambda: rsv.FreeMotion.stacked([]), "motions must contain at least one motion"),
        (lambda: TIMING.row_starts(10**9, 10), "num_frames must be at most"),
        (lambda: TIMING.row_starts(2, 2**63), "num_rows must be at most"),
        (lambda: TIMING.frame_starts(2, "nowhere"), "device='nowhere' is not available"),
        (lambda: rsv.Vibration(1e300, 50.0), "amplitude must be at most 1e"),
        (lambda: rsv.Vibration([[]], [[]]), "amplitude must have shape"),
        (lambda: rsv.Vibration("a", 50.0), "amplitude must be a number, a tensor"),
        (
            lambda: rsv.FreeMotion(torch.full((2, 9), 1e300, dtype=torch.float64), 0.0, 1e-3),
            "coefficients must be at most",
        ),
        (lambda: rsv.FreeMotion(torch.zeros(2, 9), 1e300, 1e-3), "start must be at most"),
        (lambda: VIBRATION.displacement("now"), r"times must be a tensor, got 'now' \(str\)"),
        (lambda: VIBRATION.with_axes([0, 5], [1.0, 1.0]), "order must be a permutation"),
        (lambda: rsv.FreeMotion(torch.zeros(2, 9), 0.0, 1e-3).mean_displacement(torch.zeros(3), 1e9), "exposure_time"),
        (lambda: rsv.detect_vibration(FRAMES, TIMING, harmonics=10**9), "harmonics must be at most"),
        (lambda: rsv.restore(FRAMES, "timing", VIBRATION), "timing must be a SensorTiming"),
        (lambda: rsv.restore(FRAMES, TIMING, 3), "vibration must be a Vibration or a detection, got int"),
        (lambda: rsv.restore(FRAMES, TIMING, VIBRATION, noise=1e308), "noise must be at most"),
        (lambda: rsv.row_psf(VIBRATION, TIMING.row_starts(1, 4)[0], TIMING, num_nodes=10**9), "num_nodes must be at"),
        (lambda: rsv.row_psf(VIBRATION, torch.tensor([math.inf]), TIMING), "starts must be finite times"),
        (lambda: rsv.psnr(FRAMES, FRAMES, 10**400), "data_range must be finite"),
        (lambda: rsv.comparison_figure(torch.tensor(1.0), FRAMES[0]), "raw must have shape"),
        (lambda: rsv.windows_figure([0.0], [math.nan]), r"detections\[0\] must be a detection or None"),
        (lambda: rsv.MotionCheck("x", torch.zeros(2), True, (), *CURVES), "before must be a tensor"),
        (lambda: rsv.MotionCheck(torch.zeros(3), torch.zeros(2), True, (), *CURVES), r"before must have shape \(2,\)"),
    ],
)
def test_values_beyond_the_limits_of_an_argument(build, message):
    with pytest.raises((ValueError, TypeError), match=message):
        build()


def test_checks_leave_calls_unchanged():
    @checks_arguments
    def scaled(values: torch.Tensor, factor: float = 2.0, *, names: tuple[str, str] = ("a", "b")) -> torch.Tensor:
        """Doc."""
        return values * factor

    values = torch.tensor([1.0], requires_grad=True)
    scaled(values, 3).backward()
    assert values.grad.tolist() == [3.0]
    assert scaled.__doc__ == "Doc."
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'values'"):
        scaled()
    with pytest.raises(ValueError, match="names must have 2 values, got 1"):
        scaled(values, names=("a",))
    with pytest.raises(TypeError, match=r"names\[1\] must be text"):
        scaled(values, names=("a", 1))


def test_helpers_return_the_values():
    tensor = torch.ones(2, 3)
    assert check_tensor("x", tensor) is tensor
    assert check_device("device", torch.device("cpu")).type == "cpu"
    assert as_numbers("x", np.arange(2)).tolist() == [0.0, 1.0]
    check_shapes({"a": tensor, "b": torch.ones(5, 3), "c": None}, {"a": "2 N", "b": "... N", "c": "N"})
    with pytest.raises(ValueError, match=r"b must have shape \(\.\.\., N\) with N = 3, got \(4,\)"):
        check_shapes({"a": tensor, "b": torch.ones(4)}, {"a": "2 N", "b": "... N"})


@pytest.mark.parametrize("motions", [torch.tensor(1.0), torch.zeros(0), np.zeros(3)])
def test_arrays_are_no_sequences_of_objects(motions):
    with pytest.raises(TypeError, match="motions must be a sequence, got"):
        rsv.FreeMotion.stacked(motions)


@pytest.mark.parametrize("starts", [None, "0.1", 0, TIMING, [None]])
def test_path_of_starts_that_are_no_tensor(starts):
    with pytest.raises(TypeError, match="starts must be a tensor"):
        VIBRATION.path(starts, torch.zeros(2))


@pytest.mark.parametrize(("name", "value"), [("misfit_after", torch.zeros(2)), ("reasons", ())])
def test_verdicts_of_contradicting_sizes(name, value):
    pair, axes = torch.ones(1), torch.ones(1, 2)
    values = dict.fromkeys(("before", "after", "noise", "chi_square", "predicted_gain"), pair)
    values |= dict.fromkeys(("misfit_before", "misfit_after", "resolution"), axes)
    values |= {"outcome": ("unknown",), "reasons": ("no contrast",)}
    assert "pair" in rsv.RestorationVerdict(**values).summary()
    with pytest.raises(ValueError, match=f"{name} must have"):
        rsv.RestorationVerdict(**values | {name: value})


def test_knots_further_apart_than_the_stack_is_long():
    with pytest.raises(ValueError, match="knot_rows must be at most"):
        rsv.detect_motion(FRAMES, TIMING, knot_rows=10**9, band_rows=16, band_step=8, search=6)


def test_optics_of_frames_of_16_bits():
    optics = rsv.Optics(0.5, 0.4, 1.0)
    image = optics.apply(FRAMES.to(torch.bfloat16))
    assert image.dtype == torch.bfloat16
    torch.testing.assert_close(image.float(), optics.apply(FRAMES), atol=0.01, rtol=0)


def test_samples_with_gradient_are_refused():
    times = torch.linspace(0, 0.1, 11, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"from_samples has no gradient: pass displacement\.detach\(\)"):
        rsv.FreeMotion.from_samples(times, torch.zeros(11, 2, requires_grad=True))
