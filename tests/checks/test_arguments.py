"""Arguments of public functions: the message names the argument, whatever the value."""

import gc
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.results.reason import Reason
from rsvib_torch.video import Margins

TIMING = rsv.SensorTiming(1e-4, 6, 104)
LONG = rsv.SensorTiming(1e-4, 6, 104, frame_start_times=[0.0, 2.0])
BANDS = {"band_rows": 16, "band_step": 8, "search": 6}
FRAMES = torch.rand(2, 96, 64, generator=torch.Generator().manual_seed(0))
RGB = FRAMES[:, None].repeat(1, 3, 1, 1)
WIDE = torch.rand(2, 96, 128, generator=torch.Generator().manual_seed(0))
VIBRATION = rsv.Vibration([1.0, 0.5], [130.0, 170.0])
STARTS = TIMING.row_starts(1, 96)[0]
ROLL = rsv.Vibration([1.0, 0.5, 1e-3], [130.0, 170.0, 26.0])
STRIPES = (0.5 + 0.3 * torch.sin(0.5 * torch.arange(64.0)))[None, :, None].expand(1, 64, 32)
PAIR, NO_TONE = torch.zeros(1, 3), torch.zeros(2, 1)
STD = rsv.VibrationStd(NO_TONE, NO_TONE, NO_TONE, NO_TONE, torch.zeros(2), torch.zeros(2))
CURVE = rsv.OffsetCurve(
    torch.tensor([[0, 1]]), torch.arange(3), PAIR, PAIR + 0.01, torch.zeros(1, 3, 2), PAIR + 1, (16, 16)
)


def blur():
    return rsv.RowVaryingBlur(rsv.row_psf(VIBRATION, STARTS, TIMING))


def detect(frames, **options):
    return rsv.detect_vibration(frames, TIMING, **options)


def augment(images=None, **options):
    augmentation = rsv.RollingShutterVibration(TIMING, **options)
    return augmentation.drawn_vibration() if images is None else augmentation(images)


def dewarp(**changes):
    return rsv.FixedDewarp(**{"timing": TIMING, "vibration": VIBRATION, "size": (96, 64), "num_frames": 2} | changes)


def free(coefficients, *tones):
    return rsv.FreeMotion(coefficients, 0.0, 1e-3, *tones)


def simulate(scene, vibration=VIBRATION, **options):
    return rsv.simulate_frames(scene, TIMING, vibration, **options)


def by_motion(**options):
    return rsv.calibrate_row_time_by_motion(FRAMES, frame_rate=90.0, **options)


def flicker(frames, frequency=1000.0, **options):
    return rsv.calibrate_row_time(frames, frequency, **options)


def judge(frames, vibration=VIBRATION):
    return rsv.judge_restoration(frames, FRAMES, TIMING, vibration)


def in_seconds(exposure_time):
    return rsv.SensorTiming.from_seconds(row_time=20e-6, exposure_time=exposure_time, frame_rate=30)


def bound(scene=None, frame_size=(80, 40)):
    scene = torch.rand(128, 96) if scene is None else scene
    return rsv.evaluation.cramer_rao_bound(scene, TIMING, VIBRATION, noise=0.01, frame_size=frame_size)


def restore(**options):
    return rsv.restore(FRAMES, TIMING, VIBRATION, **options)


def dewarped(*shape, channels=None):
    return rsv.restore(torch.rand(shape), TIMING, VIBRATION, method="dewarp", channels=channels)


def sharpened(optics):
    return restore(optics=optics)


def nested():
    return torch.nested.nested_tensor([FRAMES[0], FRAMES[0, :2]])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FRAMES.to("meta"), "frames must be a dense tensor that has data, got .* on meta"),
        (nested, "frames must be a dense tensor that has data, got a nested tensor"),
        (FRAMES.to_sparse, "frames must be a dense tensor that has data, got torch.sparse"),
        (lambda: FRAMES.to(torch.complex64), "frames must be real numbers"),
        (lambda: FRAMES.to(torch.float8_e4m3fn), "frames must be real numbers of at least 16 bits"),
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
        (lambda: rsv.FreeMotion.stacked([]), "results must be a list of FreeMotion, at least one, got"),
        (lambda: TIMING.frame_starts(2, "nowhere"), "device='nowhere' is not available"),
        (lambda: rsv.Vibration(1e300, 50.0), "amplitude must be at most 1e"),
        (lambda: VIBRATION.displacement("now"), r"times must be an instance of Tensor, got 'now' \(str\)"),
        (lambda: free(torch.zeros(2, 9)).mean_displacement(torch.zeros(3), 1e9), "exposure_time"),
        (lambda: rsv.restore(FRAMES, "timing", VIBRATION), "timing must be a SensorTiming"),
        (lambda: rsv.restore(FRAMES, TIMING, 3), r"vibration must be a Motion or a DetectedVibration \(from .*\),"),
        (lambda: rsv.row_psf(VIBRATION, torch.tensor([math.inf]), TIMING), "starts must be finite times"),
        (lambda: rsv.psnr(FRAMES, FRAMES, 10**400), r"data_range must be a number, got 10+…0+ \(int\)"),
        (lambda: rsv.comparison_figure(FRAMES[0], FRAMES[None]), r"restored must have shape \(C, H, W\) with C = 1"),
        (lambda: rsv.calibrate_row_time(STRIPES, 1000.0, frame_rate=1e-40), "flicker_frequency=1000 Hz is ambiguous"),
        (lambda: rsv.row_psf(rsv.Vibration(1e6, 50.0), STARTS, TIMING), r"96 rows, .* GB .* check amplitude"),
        (lambda: rsv.SensorNoise(5000.0).apply(FRAMES / 0), r"frames must be finite, but pixel \(0, 0, 0\) is inf"),
        (lambda: simulate(FRAMES[0] * 1e38, noise=rsv.SensorNoise(5000.0)), r"scene reach .*, at most 1e\+15"),
        (lambda: rsv.StackInfo(torch.zeros(3), "uint8", 255.0), r"shape\[0\] must be a whole number, got 0.0"),
        (lambda: blur().A_adjoint(FRAMES[0, 0], (96, 64)), r"y must have shape \(..., R, W\)"),
        (lambda: rsv.visible_pixels(TIMING, VIBRATION, (96, 64), 10**9), "masks of num_frames=1000000000 .* fewer"),
        (lambda: rsv.Vibration.still((10**4, 10**4)), "batch_shape must have at most 1000000 motions"),
        (lambda: blur().A_adjoint(torch.tensor(1.0)), r"y must have shape \(..., R, W\)"),
        (lambda: blur()(FRAMES[0].to(torch.uint16)), "scene must be a floating-point tensor, got torch.uint16"),
        (lambda: rsv.row_psf(ROLL, TIMING.row_starts(1, 8), TIMING), "not defined with roll, zoom or a camera"),
        (
            lambda: rsv.FreeMotion.from_samples(torch.arange(11.0), torch.zeros(11, 2, requires_grad=True)),
            r"from_samples has no gradient: pass displacement\.detach\(\)",
        ),
        (lambda: rsv.Vibration(-1.0, 50.0), "amplitude must not be negative, got -1"),
        (lambda: rsv.Vibration(math.nan, 50.0), "amplitude must be finite"),
        (lambda: rsv.Vibration(1.0, 50.0, image_motion=[1.0, 2.0, 3.0]), "image_motion must have shape"),
        (lambda: rsv.register_bands(FRAMES, TIMING, method="sift"), "registration must be .*got 'sift'"),
        (lambda: rsv.Vibration([1.0, 2.0, 3.0, 4.0, 5.0], 50.0), r"amplitude must have shape \(2,\)"),
        (lambda: rsv.Vibration([[1.0, 2.0], [1.0, 2.0]], [[1.0, 2.0, 3.0]] * 2), "do not fit together"),
        (lambda: free(torch.zeros(2, 3)), "N >= 4"),
        (lambda: free(torch.full((2, 8), torch.nan)), "finite"),
        (lambda: free(torch.zeros(2, 8), rsv.Vibration.still((3,))), "batch shape"),
        (lambda: rsv.FreeMotion.through([0.0, 1.0, 2.0, 4.0], torch.zeros(4, 2)), "evenly spaced"),
        (
            lambda: rsv.FreeMotion.from_samples([0.0, 1.0, 1.0, 4.0], torch.zeros(4, 2)),
            "times must increase",
        ),
        (lambda: rsv.Camera(500.0, distortion=(0.1, 0.2)), "distortion must be 5 numbers"),
        (lambda: rsv.Camera(500.0, distortion=(0.1,) * 5, fisheye=True), "distortion must be 4 numbers"),
        (lambda: rsv.register_bands(FRAMES, TIMING, search=60), "frames of 96 x 64 px .* of 32 rows searched over 60"),
        (lambda: rsv.register_bands(FRAMES, TIMING, band_rows=240), "too small for bands of 240 rows"),
        (lambda: simulate(STRIPES[0].byte()), "scene must be a floating-point tensor"),
        (lambda: simulate(torch.zeros(600, 99), frame_size=(400, 50)), "frame_rows=104 is"),
        (lambda: simulate(STRIPES[0], rsv.Vibration.still((2,))), "vibration is a batch of shape"),
        (
            lambda: simulate(FRAMES[0], rsv.Vibration([3.5, 5.5], 50.0), frame_size=(96, 64)),
            r"scene of \(96, 64\) .* is too small: a frame of \(96, 64\) .* \(140, 104\)",
        ),
        (lambda: bound(frame_size=(400, 40)), "too small"),
        (lambda: bound(torch.zeros(128, 96, dtype=torch.uint8)), "floating-point"),
        (lambda: sharpened({"mtf": ([0.0, 0.1, 0.2], [0.0, 0.0, 0.0])}), "optics transmit 0 at 0.1 cycles per px"),
        (lambda: sharpened({"mtf": ([0.2, 0.1], [0.9, 0.8])}), "frequencies of mtf must increase, but 0.1 follows 0.2"),
        (lambda: sharpened(0.5), "optics must be"),
        (lambda: rsv.psnr(FRAMES, FRAMES[..., 1:], 1.0), r"\(2, 96, 63\)"),
        (lambda: rsv.ssim(FRAMES[:1], FRAMES, 1.0), "more images"),
        (lambda: rsv.ssim(FRAMES[0, 0], FRAMES[0, 0], 1.0), r"\(64,\)"),
        (lambda: rsv.psnr(FRAMES, FRAMES, 1.0, rim=32), "rim=32"),
        (lambda: rsv.SensorTiming(0.02052, 20, 2048), "longer than 10 ms; .*20.52 us is 20.52e-6"),
        (lambda: rsv.SensorTiming(5e-3, 20, 2048), "frame period of 10.24 s, longer than 10 s"),
        (lambda: rsv.SensorTiming("20us", 20, 2048), "row_time must be a number, got '20us'"),
        (lambda: rsv.SensorTiming(2e-5, 2049, 2048), "exposure_rows=2049 exceeds the frame period"),
        (lambda: rsv.SensorTiming(2e-5, 20, 2048, frame_start_times=[0.0, 0.2, 0.1]), "must be strictly increasing"),
        (lambda: TIMING.check_rows(105), "frame_rows=104 is less than the 105 rows of the frames"),
        (lambda: rsv.SensorTiming(20e-6, 0.002, 1700), r"exposure_rows=0.002 .* \(0.002 s are exposure_rows=100\)"),
        (lambda: in_seconds(410.0), "exposure 410 s, .*; 410 us is 410us"),
        (lambda: detect(FRAMES[:1]), "at least 2 frames are needed, got 1"),
        (lambda: detect(WIDE * torch.tensor([1.0, 0.0])[:, None, None]), "frame 1 is constant.*; remove this frame"),
        (
            lambda: detect((WIDE * torch.tensor([1.0, 0.0])[:, None, None])[:, None, None].expand(2, 2, 1, -1, -1)),
            "frame 0 of stack 1 is constant and cannot be registered; leave out this stack",
        ),
        (lambda: detect(torch.stack([WIDE, 0 * WIDE])[:, :, None]), "frame 0 of stack 1 is"),
        (lambda: detect(WIDE[:, :24], method="bands"), "too small for bands of 32 rows searched over 16 px"),
        (lambda: detect(WIDE, roll=True), "frames of 96 x 128 px .* in 2 parts .* at least 64 x 192 are needed"),
        (lambda: detect(torch.rand(2, 64, 90)), "frames of 64 x 90 px .* at least 64 x 96 are needed"),
        (lambda: detect(WIDE, columns=64, roll=True), "columns=64 goes with roll=False"),
        (lambda: detect(WIDE, roll=False, zoom=True), "zoom=True measures roll as well"),
        (lambda: detect(WIDE, principal_point=(1.0, 2.0)), "principal_point=.* requires focal_length"),
        (lambda: detect(WIDE, distortion=(0.1, 0.0, 0.0, 0.0, 0.0)), "distortion=.* requires focal_length"),
        (lambda: detect(WIDE, focal_length=300.0, distortion=(-3.0, 0.0, 0.0, 0.0, 0.0)), "not invertible in frames"),
        (lambda: by_motion(row_time=(6e-5, 5e-5)), "the first must be smaller"),
        (lambda: by_motion(row_time=(20.0, 60.0)), "in seconds"),
        (lambda: rsv.restore(FRAMES, TIMING, SimpleNamespace(motion=None)), "of other results, pass .motion"),
        (lambda: restore(ignore=FRAMES[..., 1:] > 0), "ignore must be a boolean mask"),
        (lambda: rsv.register_bands(FRAMES * torch.nan, TIMING), r"pixel \(0, 0, 0\) is nan"),
        (lambda: restore(ignore=FRAMES[:, :5, :5] > 0), r"ignore \(2, 5, 5\) does not fit .* \(2, 96, 64\)"),
        (lambda: restore(ignore=FRAMES), "ignore must be a bool tensor, got torch.float32"),
        (lambda: restore(saturation=1e-9), "every pixel is saturated"),
        (lambda: rsv.restore(FRAMES, TIMING, rsv.Vibration.still((3,))), r"vibration of batch shape \(3,\) does"),
        (lambda: rsv.restore(FRAMES, TIMING, rsv.Vibration(1.0, 5e7)), "periods while a row is exposed"),
        (lambda: restore(half_row=2), "unknown option 'half_row'; the options are .*regularisation"),
        (lambda: restore(method="dewarp", half_rows=2), "half_rows is no option of method='dewarp', which has none"),
        (lambda: restore(noise=-1.0), r"noise must be at least 0, got -1.0 \(float\)"),
        (lambda: restore(method="richardson-lucy", iterations=10**9), "iterations must be at most 1000, got"),
        (lambda: sharpened({"sigma": "wide"}), "optics.sigma must be a number, got 'wide'"),
        (lambda: rsv.restore(FRAMES[:, 1:], TIMING, VIBRATION, mosaic="RGGB"), "2 x 2 px, but frames have 95 x 64"),
        (lambda: rsv.restore(RGB, TIMING, VIBRATION, mosaic="RGGB"), "but frames have 3 channels"),
        (lambda: augment(amplitude=(2.0, 1.0)), "amplitude must not have low above high"),
        (lambda: augment(exposure_rows=(20, 400)), "exposure_rows must be at most 104"),
        (augment, "no vibration has been drawn yet"),
        (lambda: augment(torch.zeros(1, 1, 400, 8)), "less than the 400 rows"),
        (lambda: augment(torch.rand(2, 48, 64, 3)), r"have their channels last: pass images.movedim\(-1, -3\)"),
        (lambda: dewarp(vibration=VIBRATION.expanded(2)), "vibration is a batch"),
        (lambda: dewarp(vibration=ROLL), "roll, zoom or a camera"),
        (lambda: dewarp(size=(500, 90)), "500"),
        (lambda: dewarp(vibration=rsv.Vibration(500.0, 50.0)), "more than its size"),
        (lambda: dewarp()(FRAMES[:1]), r"frames must be stacks of .* = \(2, 96, 64\)"),
        (lambda: dewarp()(FRAMES.double()), r"frames must be torch\.float32"),
        (lambda: flicker(torch.ones(1, 64, 64)), "100% of the pixels are saturated"),
        (lambda: flicker(torch.full((2, 128, 64), 0.5)), "no flicker found"),
        (lambda: flicker(torch.rand(1, 16, 64)), "16 rows along the scan"),
        (lambda: flicker(FRAMES[:1], 30.0, frame_rate=29.97), "slower than a frame"),
        (lambda: flicker(torch.full((1, 64, 64), 900, dtype=torch.int16)), "full_scale"),
        (lambda: Margins(4, 4, 0, 0).cut(torch.zeros(8, 8)), "leave nothing of frames of 8 x 8 px"),
        (lambda: Reason("unknown"), "code must be one of"),
        (lambda: Reason("tone_blind", value=0.05, limit=0.1), "do not fit its text"),
        (lambda: Reason("tone_averaged_out", value="much", limit=0.1), "do not fit its text"),
        (lambda: detect(RGB[:1]), "got 1 of 3 channels; grey frames are"),
        (lambda: detect(FRAMES[[0, 1, 1, 0]]), "frames 1 and 2 are identical: .* use frames without copies"),
        (
            lambda: rsv.Camera(390.0, distortion=(-1.0, 0, 0, 0), fisheye=True).check_size(800, 600),
            r"order \(k1, k2, k3",
        ),
        (lambda: detect(WIDE, columns=64), "at least 64 x 96 are needed; reduce search, or use more columns$"),
        (lambda: dewarped(2, 48, 64, 1), r'channels="last" for \(T, H, W, C\).* or channels="first" if they are'),
        (lambda: dewarped(48, 64, 3, channels="last"), r"one image \(H, W, C\) is frames\[None\] with"),
        (lambda: dewarped(48, 64, 1), r'not appear to be \(T, H, W\): .* or channels="first" if they are'),
        (lambda: dewarped(2, 3, 48, 64, channels="last"), r"before the image axes: omit channels=\"last\""),
        (lambda: dewarped(8, 2, 48, 64), r"frames\[:, :, None\] for a batch \(B, T, H, W\)"),
        (lambda: dewarped(5, 7), r"got \(5, 7\); one grey image is frames\[None\]"),
        (lambda: detect([FRAMES[0], FRAMES[1, 1:]]), r"frames\[1\] is \(95, 64\) float32 on cpu and frames\[0\]"),
        (lambda: detect([FRAMES[0], FRAMES[1].byte()]), r"frames\[1\] is \(96, 64\) uint8 on cpu and"),
        (
            lambda: detect([FRAMES[0], "b.png"]),
            r"frames\[1\] must be a tensor or array of numbers, got str of <U5",
        ),
        (lambda: detect([]), r"frames must have shape .* got \(0,\)"),
        (lambda: detect(frame for frame in FRAMES), "got generator of object; .* pass a list"),
        (lambda: judge(FRAMES[:1]), "at least 2 frames are needed, got 1"),
        (lambda: judge(FRAMES[:, :16]), r"restored must have the shape \(2, 16, 64\)"),
        (lambda: judge(FRAMES[None, :, None]), "frames must be one stack"),
        (lambda: judge(FRAMES, rsv.Vibration(1.0, 50.0, image_motion=(9e3, 0.0))), "nothing in common"),
        (lambda: judge(FRAMES, VIBRATION.expanded(2)), "does not fit frames of shape"),
        (lambda: judge(FRAMES * torch.nan), "no pixel with data"),
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
    ],
)
def test_results_of_contradicting_shapes(result, changes, message):
    results = {"std": STD, "curve": CURVE}
    assert str(replace(results[result]))
    with pytest.raises((TypeError, ValueError), match=message):
        replace(results[result], **changes)


def test_figures_of_motions_with_gradient():
    vibration = rsv.Vibration(torch.tensor([1.0, 0.5], requires_grad=True), [130.0, 170.0])
    assert rsv.psf_figure(vibration, TIMING, 96).axes


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
