"""``torch.set_default_dtype`` and ``torch.set_default_device`` do not change results."""

import dataclasses
import math

import numpy as np
import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=104)
VIBRATION = rsv.Vibration([1.2, 0.8], [130.0, 170.0], [0.3, 0.9], image_motion=(5.0, 3.0))
BANDS = {"band_rows": 16, "band_step": 8, "search": 6}


def results():
    """Results of the main entry points by name; inputs that need no generator have explicit types."""
    found = {}
    scene = torch.from_numpy(np.random.default_rng(0).random((160, 128)).astype(np.float32)).clone()
    scene = rsv.Optics(sigma=1.0).apply(scene)
    found["optics"] = scene
    noise = rsv.SensorNoise(full_well=5000.0, read_noise=0.01, bits=12, column_offset=0.01, gain_spread=0.01)
    found["noise"] = noise.apply(scene, torch.Generator("cpu").manual_seed(1))
    frames = rsv.simulate_frames(scene, TIMING, VIBRATION, 3, frame_size=(96, 64))
    found["simulated"] = frames
    found["scene"] = city_and_fields(120, 100, seed=3)
    detected = rsv.detect_vibration(frames, TIMING, **BANDS)
    found["direct"] = detected.to_dict()
    found["bands"] = rsv.detect_vibration(frames, TIMING, method="bands", harmonics=2, **BANDS).to_dict()
    for method in ("ncc", "phase", "projection"):
        found[method] = rsv.register_bands(frames, TIMING, method=method, **BANDS).to_dict()
    free = rsv.detect_motion(frames, TIMING, **BANDS)
    found["free"] = free.to_dict()
    found["swept"] = rsv.detect_swept_tone(frames, TIMING, **BANDS).to_dict()
    for method in ("exact", "banded", "dewarp", "richardson-lucy"):
        options = {"iterations": 3} if method == "richardson-lucy" else {}
        found[f"restore {method}"] = rsv.restore(frames, TIMING, VIBRATION, method=method, **options)
    holes = frames.clone()
    holes[1, 20:24, 30:34] = float("nan")
    found["filled"] = rsv.restore(holes, TIMING, VIBRATION, joint=True, prior="edges", saturation=0.9)
    found["verdict"] = rsv.judge_restoration(frames, found["restore exact"], TIMING, VIBRATION).to_dict()
    found["mtf"] = rsv.restoration_mtf(frames, TIMING, VIBRATION, joint=True, scale=2).to_dict()
    found["visible"] = rsv.visible_pixels(TIMING, VIBRATION, (96, 64), 3)
    found["trusted"] = rsv.trusted_vibration(detected, TIMING, 3, 96)[0].to_dict()
    found["check"] = rsv.check_motion(frames, TIMING, free.motion, **BANDS).to_dict()
    times = np.linspace(-0.01, 0.05, 241)
    path = 0.5 * np.sin(800 * times[:, None] + np.array([0.0, 1.0]))
    recorded = rsv.FreeMotion.from_samples(times, path)
    found["recorded"] = recorded.to_dict()
    found["aligned"] = rsv.align_motion(frames, TIMING, recorded, offsets=(-0.002, 0.002), **BANDS).to_dict()
    found["psnr"] = rsv.psnr(found["restore exact"], frames, 1.0)
    found["ssim"] = rsv.ssim(found["restore exact"], frames, 1.0)
    rows, columns = np.mgrid[:64, :48]
    edge = (0.2 + 0.6 / (1 + np.exp(-(columns - 24 - 0.1 * (rows - 32)) / 0.7))).astype(np.float32)
    edge = torch.from_numpy(edge).clone()  # aligned as all tensors are: sums depend on it
    found["mtf"] = rsv.slanted_edge_mtf(edge).to_dict()
    found["edges"] = rsv.find_slanted_edges(edge)
    light = [0.5 + 0.3 * np.sin(rows * 0.6283 + phase) for phase in (0.3, 1.1)]
    found["row time"] = rsv.calibrate_row_time(torch.from_numpy(np.stack(light)).clone(), 1000.0).to_dict()
    psf = rsv.row_psf(VIBRATION, TIMING.row_starts(1, 96)[0], TIMING, interpolation="cubic", quadrature="gauss")
    blur = rsv.RowVaryingBlur(psf)
    found["blurred"] = blur(frames[0])
    found["adjoint"] = blur.A_adjoint(frames[0])
    found["blind"] = rsv.blind_frequencies(TIMING, 600.0)
    found["block"] = torch.from_numpy(
        rsv.restore_block(frames.numpy(), TIMING, detection={"method": "bands", **BANDS}, force=True)
    )
    for figure in (rsv.rows_figure(VIBRATION, TIMING, 96), rsv.psf_figure(VIBRATION, TIMING, 96)):
        found[f"figure {len(figure.axes)}"] = [line.get_ydata().tolist() for a in figure.axes for line in a.lines]
    found["details"] = len(rsv.comparison_figure(frames[0], found["restore exact"][0], size=32).axes)
    return found


def assert_same(expected, got, name):
    assert type(expected) is type(got), name
    if isinstance(expected, torch.Tensor):
        assert (got.device, got.dtype) == (expected.device, expected.dtype), name
        torch.testing.assert_close(got, expected, rtol=0, atol=0, equal_nan=True, msg=lambda text: f"{name}: {text}")
    elif dataclasses.is_dataclass(expected):
        assert_same(vars(expected), vars(got), name)
    elif isinstance(expected, dict):
        assert expected.keys() == got.keys()
        for key, value in expected.items():
            assert_same(value, got[key], f"{name}.{key}")
    elif isinstance(expected, (list, tuple)):
        assert len(expected) == len(got), name
        for first, second in zip(expected, got, strict=True):
            assert_same(first, second, name)
    elif isinstance(expected, float):
        # the alignment of NumPy arrays in memory changes the last bits of sums in libraries, and a fit changes with
        # them: by 6e-9 of a standard deviation, and by 1e-12 of the standard deviation 9e-7 of an edge without noise;
        # a default of float32 would change 1e-7
        assert math.isclose(got, expected, rel_tol=2e-8, abs_tol=1e-11) or repr(expected) == repr(got), name
    else:
        assert repr(expected) == repr(got), name


@pytest.fixture(scope="module")
def expected():
    return results()


@pytest.mark.parametrize(
    ("dtype", "device"),
    [
        (torch.float16, "meta"),
        *(pytest.param(kind, "cpu", marks=pytest.mark.slow) for kind in (torch.float64, torch.bfloat16)),
        pytest.param(torch.float32, "meta", marks=pytest.mark.slow),
    ],
)
@pytest.mark.filterwarnings("ignore:.*")
def test_defaults_do_not_change_results(expected, dtype, device):
    torch.set_default_dtype(dtype)
    torch.set_default_device(device)
    try:
        got = results()
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)
    assert_same(expected, got, "results")
