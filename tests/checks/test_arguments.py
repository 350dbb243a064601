"""Arguments of public functions: the message names the argument, whatever the value."""

import gc
import math
from dataclasses import replace
from typing import TypeVar, get_origin

import numpy as np
import pytest
import torch
from typing_extensions import TypeAliasType

import rsvib_torch as rsv
from rsvib_torch.checks.values import members_of
from rsvib_torch.datasets import city_and_fields

TIMING = rsv.SensorTiming(1e-4, 6, 104)
LONG = rsv.SensorTiming(1e-4, 6, 104, frame_start_times=[0.0, 2.0])
BANDS = {"band_rows": 16, "band_step": 8, "search": 6}
CURVES = (torch.zeros(1), torch.zeros(1, 2), torch.zeros(1, 2))  # times, offsets, residual of a MotionCheck
FRAMES = torch.rand(2, 96, 64, generator=torch.Generator().manual_seed(0))
VIBRATION = rsv.Vibration([1.0, 0.5], [130.0, 170.0])
STARTS = TIMING.row_starts(1, 96)[0]
ROLL = rsv.Vibration([1.0, 0.5, 1e-3], [130.0, 170.0, 26.0])
STRIPES = (0.5 + 0.3 * torch.sin(0.5 * torch.arange(64.0)))[None, :, None].expand(1, 64, 32)
PAIR, NO_TONE = torch.zeros(1, 3), torch.zeros(2, 1)
STD = rsv.VibrationStd(NO_TONE, NO_TONE, NO_TONE, NO_TONE, torch.zeros(2), torch.zeros(2))
CURVE = rsv.OffsetCurve(
    torch.tensor([[0, 1]]), torch.arange(3), PAIR, PAIR + 0.01, torch.zeros(1, 3, 2), PAIR + 1, (16, 16)
)
SWEPT = rsv.SweptTone(
    *[torch.zeros(2)] * 6,
    {name: torch.ones(2) for name in ("amplitude", "frequency", "decay", "chirp", "phase")},
    rsv.FreeMotion(torch.zeros(2, 9), 0.0, 1e-3),
    torch.zeros(2),
    torch.ones(2, dtype=torch.bool),
    ((), ()),
)


def blur():
    return rsv.RowVaryingBlur(rsv.row_psf(VIBRATION, STARTS, TIMING))


def nested():
    return torch.nested.nested_tensor([FRAMES[0], FRAMES[0, :2]])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FRAMES.to("meta"), "frames must be a tensor with data"),
        (nested, "frames must be a dense tensor, got a nested tensor"),
        (FRAMES.to_sparse, r"frames must be a dense tensor.*to_dense"),
        (lambda: FRAMES.to(torch.complex64), "frames must be real numbers"),
        (lambda: FRAMES.to(torch.float8_e4m3fn), "frames must have at least 16 bits"),
        (lambda: FRAMES.numpy().astype(object), "frames must be a tensor or array of numbers"),
        (lambda: np.ma.masked_invalid(FRAMES.numpy()), "frames must not be a masked array"),
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
        (lambda: rsv.SensorTiming(1e-4, 6, 104, frame_start_times=[0.0, 1e300]), "frame_start_times must be at most"),
        (lambda: rsv.SensorTiming(1e-4, 6, 104, scan_axis=torch.zeros(2)), "scan_axis must be -2"),
        (lambda: rsv.FreeMotion.stacked([]), "motions must contain at least one motion"),
        (lambda: TIMING.row_starts(2, 2**63), "num_rows must be at most"),
        (lambda: TIMING.frame_starts(2, "nowhere"), "device='nowhere' is not available"),
        (lambda: rsv.Vibration(1e300, 50.0), "amplitude must be at most 1e"),
        (
            lambda: rsv.FreeMotion(torch.full((2, 9), 1e300, dtype=torch.float64), 0.0, 1e-3),
            "coefficients must be at most",
        ),
        (lambda: VIBRATION.displacement("now"), r"times must be an instance of Tensor, got 'now' \(str\)"),
        (lambda: rsv.FreeMotion(torch.zeros(2, 9), 0.0, 1e-3).mean_displacement(torch.zeros(3), 1e9), "exposure_time"),
        (lambda: rsv.restore(FRAMES, "timing", VIBRATION), "timing must be a SensorTiming"),
        (lambda: rsv.restore(FRAMES, TIMING, 3), r"vibration must be a Motion or a DetectedVibration \(from .*\),"),
        (lambda: rsv.row_psf(VIBRATION, torch.tensor([math.inf]), TIMING), "starts must be finite times"),
        (lambda: rsv.psnr(FRAMES, FRAMES, 10**400), "data_range must be a number, got a very large int"),
        (lambda: rsv.comparison_figure(FRAMES[0], FRAMES[None]), r"restored must have shape \(C, H, W\) with C = 1"),
        (lambda: rsv.calibrate_row_time(STRIPES, 1000.0, frame_rate=1e-40), "flicker_frequency=1000 Hz is ambiguous"),
        (
            lambda: rsv.row_psf(rsv.Vibration(1e6, 50.0), STARTS, TIMING),
            r"point spread functions of 96 rows, .* GB .* free; check amplitude",
        ),
        (
            lambda: rsv.detect_swept_tone(FRAMES[:1].expand(2, 96, 64), LONG, **BANDS),
            "frames cover 2.01 s; starts of the swept model .* at most .* s: pass larger band_rows",
        ),
        (
            lambda: rsv.restore(FRAMES, TIMING, VIBRATION, method="banded", noise_to_signal=1e300),
            r"noise_to_signal must be at most 1e\+15",
        ),
        (lambda: VIBRATION.expanded(10**9), "size must be at most"),
        (lambda: rsv.SensorNoise(5000.0).apply(FRAMES / 0), r"frames must be finite, but pixel \(0, 0, 0\) is inf"),
        (
            lambda: rsv.simulate_frames(FRAMES[0] * 1e38, TIMING, VIBRATION, noise=rsv.SensorNoise(5000.0)),
            r"scene reach .*, at most 1e\+15",
        ),
        (lambda: rsv.StackInfo(torch.zeros(3), "uint8", 255.0), r"shape\[0\] must be a whole number, got 0.0"),
        (lambda: blur().adjoint(FRAMES[0, 0], (96, 64)), r"frames must have shape \(..., R, W\)"),
        (lambda: blur().adjoint(FRAMES[0], (10**6, 10**6)), r"scenes \(1000000, 1000000\) need .* check scene_shape"),
        (lambda: rsv.visible_pixels(TIMING, VIBRATION, (96, 64), 10**9), "masks of num_frames=1000000000 .* fewer"),
        (lambda: rsv.Vibration.still((10**4, 10**4)), "batch_shape must have at most 1000000 motions"),
        (lambda: blur().A_adjoint(torch.tensor(1.0)), r"y must have shape \(..., R, W\)"),
        (lambda: blur()(FRAMES[0].to(torch.uint16)), "scene must be a floating-point tensor, got torch.uint16"),
        (lambda: rsv.row_psf(VIBRATION, STARTS, TIMING, quadrature="simpson"), "quadrature must be 'midpoint'"),
        (lambda: rsv.row_psf(ROLL, TIMING.row_starts(1, 8), TIMING), "not defined with roll, zoom or a camera"),
        (lambda: rsv.MotionCheck(torch.zeros(3), torch.zeros(2), True, (), *CURVES), r"before must have shape \(2,\)"),
        (lambda: rsv.restore_block(nested(), TIMING), "frames must be an instance of ndarray, got a nested tensor"),
        (lambda: rsv.detect_motion(FRAMES, TIMING, knot_rows=10**9, **BANDS), "knot_rows must be at most"),
        (
            lambda: rsv.FreeMotion.from_samples(torch.arange(11.0), torch.zeros(11, 2, requires_grad=True)),
            r"from_samples has no gradient: pass displacement\.detach\(\)",
        ),
        *(
            (lambda motions=motions: rsv.FreeMotion.stacked(motions), r"motions(\[0\])? must be an instance of")
            for motions in (torch.tensor(1.0), torch.zeros(0), np.zeros(3))
        ),
        *(
            (lambda starts=starts: VIBRATION.path(starts, torch.zeros(2)), "starts must be an instance of Tensor")
            for starts in (None, "0.1", 0, TIMING, [None])
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:.*:UserWarning")  # PyTorch states that nested tensors may change
def test_values_beyond_the_limits_of_an_argument(build, message):
    with pytest.raises((ValueError, TypeError), match=message):
        build()


@pytest.mark.parametrize(
    ("result", "changes", "message"),
    [
        ("std", {"amplitude": torch.zeros(4, 2, 1)}, r"frequency must have shape .* with \.\.\. = \(4,\), A = 2, K ="),
        ("curve", {"times": torch.zeros(4, 1, 3)}, r"times must have shape .* with \.\.\. = \(\), P = 1, N = 3"),
        ("swept", {"reliable": torch.ones(1, 2, dtype=torch.bool)}, r"reliable must have shape .* with \.\.\. = \(\)"),
        ("swept", {"std": {"a": 1}}, r"std.a must be an instance of Tensor, got 1 \(int\)"),
    ],
)
def test_results_of_contradicting_shapes(result, changes, message):
    results = {"std": STD, "curve": CURVE, "swept": SWEPT}
    assert str(replace(results[result]))
    with pytest.raises((TypeError, ValueError), match=message):
        replace(results[result], **changes)


def test_figures_of_motions_with_gradient():
    vibration = rsv.Vibration(torch.tensor([1.0, 0.5], requires_grad=True), [130.0, 170.0])
    for draw in (rsv.rows_figure, rsv.psf_figure):
        assert draw(vibration, TIMING, 96).axes


def test_tensors_are_freed_without_garbage_collection():
    """No cycle of references holds them, such as an exception that a check has caught, with its traceback."""
    frames = rsv.simulate_frames(city_and_fields(160, 160, seed=3), TIMING, VIBRATION, 3, frame_size=(96, 96))

    def work():
        found = rsv.detect_vibration(frames, TIMING)
        restored = rsv.restore(frames, TIMING, VIBRATION)
        rsv.judge_restoration(frames, restored, TIMING, VIBRATION)
        rsv.detect_motion(frames, TIMING)
        tracker = rsv.VibrationTracker(TIMING, window=3)
        for frame in frames:
            tracked = tracker.update(frame)
            _ = tracked.restored, tracked.detection
        return found

    work()  # tables that are kept
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        work()
        gc.collect()
        assert not [one for one in gc.garbage if isinstance(one, torch.Tensor)]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()


def test_arrays_of_numpy_with_a_type_alias_are_known():
    """``NDArray`` is an alias from NumPy 2.5 on."""
    parameter = TypeVar("parameter", bound=np.generic)
    alias = TypeAliasType("alias", np.ndarray[tuple[int, ...], np.dtype[parameter]], type_params=(parameter,))
    array, of_union = members_of(alias[np.float64] | int | None)
    assert (get_origin(array), of_union) == (np.ndarray, int)
