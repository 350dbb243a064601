"""Results of public functions: they share no memory with arguments, and do not depend on the defaults of PyTorch."""

import itertools
from dataclasses import fields, is_dataclass
from functools import partial

import numpy as np
import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.imaging import blur_rows, blur_rows_adjoint

ROWS, COLUMNS = 128, 128
TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=4, frame_rows=150)
VIBRATION = rsv.Vibration((1.5, 1.2), (90.0, 120.0), (0.3, 0.9))
STILL = rsv.Vibration.still()
FRAMES = rsv.simulate_frames(
    city_and_fields(170, 170, seed=1), TIMING, VIBRATION, num_frames=4, frame_size=(ROWS, COLUMNS)
)
EDGE = 0.2 + 0.6 * torch.sigmoid((torch.arange(64.0) - 32 - 0.15 * torch.arange(64.0)[:, None] + 5) / 0.7)
TWO = torch.ones(2, dtype=torch.float64)
TONES = torch.ones(2, 1, dtype=torch.float64)
TIMES = torch.linspace(0, 0.1, 60, dtype=torch.float64)
PAIR = torch.arange(2.0).reshape(1, 2)
PSF = rsv.row_psf(STILL, TIMES[:8], TIMING)
NOISE = rsv.SensorNoise(full_well=5000.0, read_noise=0.01, bits=12)
REFUSED = rsv.detect_vibration(FRAMES[:1].repeat(2, 1, 1), TIMING)  # a camera at rest: no axis is restored
MOTION = rsv.FreeMotion.through(TIMES, VIBRATION.displacement(TIMES))
RATES = rsv.AngularRates(MOTION.knots[1:-1], MOTION.displacement(MOTION.knots[1:-1])[:, [1, 0, 0]] / 100)


def memory_of(value, seen=None, within_tracker=False):
    """Arrays that share the memory of all tensors and arrays within a value, and its numbers."""
    seen = set() if seen is None else seen
    if id(value) in seen or isinstance(value, (str, bytes, type)):
        return []
    seen.add(id(value))
    if isinstance(value, torch.Tensor):
        assert within_tracker or not value.is_inference()  # it could not be changed or differentiated
        return [value.detach().numpy()]
    if isinstance(value, float):
        return [np.array(value)]
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, dict):
        parts = list(value.values())
    elif isinstance(value, (list, tuple)):
        parts = list(value)
    elif type(value).__module__.startswith("rsvib_torch"):
        parts = [getattr(value, field.name) for field in fields(value)] if is_dataclass(value) else []
        parts += list(vars(value).values()) if hasattr(value, "__dict__") else []
    else:
        parts = []
    within_tracker |= isinstance(value, rsv.VibrationTracker)
    return [array for part in parts for array in memory_of(part, seen, within_tracker)]


def tracked(*frames, **options):
    tracker = rsv.VibrationTracker(TIMING, **options)
    results = [tracker.update(frame) for frame in frames]
    return tracker, results, [(one.restored, one.detection, one.path) for one in results]


def offset_curve(pairs, rows, times, offsets):
    return rsv.OffsetCurve(pairs, rows, times, times, offsets, offsets[..., 0], (2, 2))


FLICKER = 0.4 + 0.2 * torch.cos(0.4 * torch.arange(256.0)).repeat(2, 16, 1).mT
HARD = {"joint": True, "prior": "edges", "saturation": 0.9}
detect = partial(rsv.detect_vibration, timing=TIMING)
restore = partial(rsv.restore, timing=TIMING, vibration=VIBRATION)
# The function, and its arguments that are arrays.
CASES = (
    {
        "AngularRates": (rsv.AngularRates, TIMES, TIMES[:, None].repeat(1, 3)),
        "FixedDewarp": (rsv.FixedDewarp(TIMING, STILL, (ROWS, COLUMNS), 4), FRAMES),
        "FreeMotion": (lambda values: rsv.FreeMotion(values, 0.0, 0.1), torch.zeros(2, 5, dtype=torch.float64)),
        "FreeMotion.through": (rsv.FreeMotion.through, TIMES, TIMES[:, None].repeat(1, 2)),
        "FreeMotion.displacement": (MOTION.displacement, TIMES),
        "OffsetCurve": (
            offset_curve,
            torch.tensor([[0, 1]]),
            PAIR[0],
            PAIR.double(),
            PAIR[:, None].expand(1, 2, 2).double(),
        ),
        "RollingShutterVibration": (rsv.RollingShutterVibration(TIMING), FRAMES[:, None]),
        "RollingShutterVibration, p=0": (rsv.RollingShutterVibration(TIMING, p=0.0), FRAMES[:, None]),
        "RollingShutterVibration, still": (rsv.RollingShutterVibration(TIMING, amplitude=(0.0, 0.0)), FRAMES[:, None]),
        "SensorTiming": (lambda times: rsv.SensorTiming(1e-4, 4, 100, frame_start_times=times), TIMES),
        "Vibration": (rsv.Vibration, TONES, TONES, TONES, TWO, TWO, TWO),
        "Vibration.displacement": (STILL.displacement, TIMES),
        "Vibration.mean_displacement": (lambda times: STILL.mean_displacement(times, 0.0), TIMES),
        "Vibration.scaled": (VIBRATION.scaled, TWO),
        "VibrationStd": (rsv.VibrationStd, TONES, TONES, TONES, TONES, TWO, TWO, TWO),
        "VibrationDetector": (rsv.VibrationDetector(TIMING), FRAMES),
        "VibrationRestorer": (lambda frames: rsv.VibrationRestorer(TIMING, method="dewarp")(frames, STILL), FRAMES),
        "VibrationTracker": (lambda *frames: tracked(*frames, window=3), *FRAMES),
        "VibrationTracker, steady": (lambda *frames: tracked(*frames, window=3, steady=1.0), *FRAMES),
        "calibrate_row_time": (lambda frames: rsv.calibrate_row_time(frames, 1000.0), FLICKER),
        "detect_vibration": (detect, FRAMES),
        "detect_vibration, ignore": (lambda frames, ignore: detect(frames, ignore=ignore), FRAMES, FRAMES > 0.95),
        "slanted_edge_mtf": (rsv.slanted_edge_mtf, EDGE),
        "judge_restoration": (partial(rsv.judge_restoration, timing=TIMING, vibration=VIBRATION), FRAMES, FRAMES),
        "psnr": (lambda *images: rsv.psnr(*images, 1.0), FRAMES, FRAMES.flip(0)),
        "ssim": (lambda *images: rsv.ssim(*images, 1.0), FRAMES, FRAMES.flip(0)),
        "row_psf": (lambda starts: rsv.row_psf(STILL, starts, TIMING), TIMES[:8]),
        "blur_rows": (lambda image: blur_rows(image, PSF), FRAMES[0, :8]),
        "blur_rows_adjoint": (lambda image: blur_rows_adjoint(image, PSF, (8, COLUMNS)), FRAMES[0, :8]),
        "RowVaryingBlur": (rsv.RowVaryingBlur(PSF), FRAMES[0, :8]),
        "simulate_frames": (lambda scene: rsv.simulate_frames(scene, TIMING, VIBRATION), FRAMES[0]),
        "simulate_frames, still": (lambda scene: rsv.simulate_frames(scene, TIMING, STILL), FRAMES[0]),
        "FreeMotion.from_samples": (rsv.FreeMotion.from_samples, TIMES, TIMES[:, None].repeat(1, 2)),
        "Optics": (rsv.Optics(sigma=1.0).apply, FRAMES[0]),
        "SensorNoise": (lambda image: NOISE.apply(image, torch.Generator("cpu").manual_seed(1)), FRAMES[0]),
        "city_and_fields": (lambda: city_and_fields(120, 100, seed=3),),
        "blind_frequencies": (lambda: rsv.blind_frequencies(TIMING, 600.0),),
        "visible_pixels": (lambda: rsv.visible_pixels(TIMING, VIBRATION, (96, 64), 3),),
        "trusted_vibration": (lambda: rsv.trusted_vibration(REFUSED, TIMING),),
        "psf_figure": (lambda: [line.get_ydata() for line in rsv.psf_figure(VIBRATION, TIMING, 96).axes[0].lines],),
        "detect_motion": (lambda frames: rsv.detect_motion(frames, TIMING), FRAMES),
        "detect_motion, batch": (
            lambda frames: rsv.detect_motion(np.stack([frames, frames])[:, :, None], TIMING)[1],
            FRAMES,
        ),
        "detect_vibration, bands": (partial(detect, method="bands", tones=2), FRAMES),
        "align_motion": (lambda frames: rsv.align_motion(frames, TIMING, RATES, camera=rsv.Camera(1e4)), FRAMES),
        "restore, holes": (lambda frames, ignore: restore(frames, ignore=ignore, **HARD), FRAMES, FRAMES > 0.8),
        "RowVaryingBlur.A_adjoint": (rsv.RowVaryingBlur(PSF).A_adjoint, FRAMES[0, :8]),
        "restore, no axis": (partial(restore, vibration=REFUSED), FRAMES),
        "restore, no axis, last": (partial(restore, vibration=REFUSED, channels="last"), FRAMES[..., None]),
        "restore, mosaic": (partial(restore, vibration=REFUSED, mosaic="RGGB"), FRAMES),
    }
    | {
        f"restore, {method}, {name}": (partial(restore, vibration=motion, method=method), FRAMES)
        for method in ("exact", "banded", "dewarp", "richardson-lucy")
        for name, motion in (("moving", VIBRATION), ("still", STILL))
    }
    | {
        f"register_bands, {method}": (partial(rsv.register_bands, timing=TIMING, method=method), FRAMES)
        for method in ("ncc", "phase", "projection")
    }
)


ONLY_TENSORS = (
    "Optics", "SensorNoise", "RowVaryingBlur.A_adjoint",
    "AngularRates", "FixedDewarp", "FreeMotion.displacement", "OffsetCurve",
    "RollingShutterVibration", "RollingShutterVibration, p=0", "RollingShutterVibration, still",
    "Vibration.displacement", "Vibration.mean_displacement", "Vibration.scaled", "VibrationStd",
    "row_psf", "blur_rows", "blur_rows_adjoint", "RowVaryingBlur",
)  # fmt: skip


@pytest.mark.filterwarnings("ignore::rsvib_torch.RestorationWarning")
@pytest.mark.parametrize(
    ("name", "as_array"), [(name, kind) for name in CASES for kind in (False, True)[: 1 + (name not in ONLY_TENSORS)]]
)
def test_results_share_no_memory_with_arguments(name, as_array):
    function, *arguments = CASES[name]
    given = [argument.numpy().copy() if as_array else argument.clone() for argument in arguments]
    result = function(*given)
    assert not any(np.may_share_memory(*pair) for pair in itertools.product(memory_of(result), memory_of(given)))
    for before, after in zip(arguments, given, strict=True):  # and arguments are not changed
        torch.testing.assert_close(torch.as_tensor(after), before, rtol=0, atol=0)


@pytest.mark.filterwarnings("ignore:.*")
@pytest.mark.parametrize(
    ("dtype", "device"), [(torch.float16, "meta"), pytest.param(torch.float64, "cpu", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", [name for name in CASES if "Rolling" not in name])  # Kornia draws by the defaults
def test_defaults_of_pytorch_do_not_change_results(name, dtype, device):
    """Sums of libraries depend on the alignment of arrays, which changes MTF by 4e-8; float32 by 1e-7."""
    function, *arguments = CASES[name]
    given = [[argument.clone() for argument in arguments] for _ in range(2)]
    torch.manual_seed(0)
    expected = memory_of(function(*given[0]))
    torch.manual_seed(0)
    torch.set_default_dtype(dtype)
    torch.set_default_device(device)
    try:
        found = memory_of(function(*given[1]))
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)
    assert [one.dtype for one in found] == [one.dtype for one in expected]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=7e-8, atol=1e-11)


def test_standard_deviations_in_inference_mode():
    expected = rsv.detect_motion(FRAMES, TIMING).std
    with torch.inference_mode():
        found = rsv.detect_motion(FRAMES, TIMING).std
    assert torch.equal(found, expected)
    assert float(expected.max()) > 0


def test_restoration_with_a_detected_motion_is_differentiable():
    found, given = rsv.detect_vibration(FRAMES, TIMING).vibration, FRAMES.clone().requires_grad_()
    found.amplitude.requires_grad_()
    rsv.restore(given, TIMING, found).square().mean().backward()
    assert float(given.grad.abs().max()) > 0
    assert float(found.amplitude.grad.abs().max()) > 0


@pytest.mark.parametrize("buffers", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_buffers_that_are_written_to_again_change_no_tracked_frame(buffers):
    memory = torch.zeros(buffers, *FRAMES.shape[1:])
    trackers = [rsv.VibrationTracker(TIMING, window=4) for _ in range(2)]
    results = []
    for index in range(24):
        frame = FRAMES[index % len(FRAMES)]
        buffer = memory[index % buffers].copy_(frame)
        results.append([tracker.update(one) for tracker, one in zip(trackers, (frame, buffer), strict=True)])
        buffer.fill_(0.5)
    assert all(torch.equal(of_copy.restored, of_buffer.restored) for of_copy, of_buffer in results)
