"""Forms in which users give frames: channels last, lists, files and half precision, for all public functions."""

import re
from functools import partial

import cv2
import h5py
import numpy as np
import pytest
import torch
from refusals import refuses

import rsvib_torch as rsv
from rsvib_torch.checks.arguments import as_tensor
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.frames.prepare import prepare_frames

TIMING = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
VIBRATION = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])


@pytest.fixture(scope="module", name="grey")
def simulate_grey():
    """Three frames of 284 x 202 px."""
    return rsv.simulate_frames(city_and_fields(320, 240, seed=3), TIMING, VIBRATION, num_frames=3)


@pytest.fixture(scope="module", name="colour")
def tint(grey):
    return torch.stack([grey, 0.5 * grey, 0.8 * grey], 1)


dewarp = partial(rsv.restore, method="dewarp")  # the fastest method


def rms(values):
    return float(values.double().square().mean().sqrt())


# Every public function of frames: the call, and the axes of the frames in its result, if it returns frames.
FUNCTIONS = {
    "detect_vibration": lambda frames, **options: rsv.detect_vibration(frames, TIMING, tones=1, **options),
    "detect_motion": lambda frames, **options: rsv.detect_motion(frames, TIMING, **options),
    "VibrationDetector": lambda frames, **options: rsv.VibrationDetector(TIMING, tones=1, **options)(frames),
    "register_bands": lambda frames, **options: rsv.register_bands(frames, TIMING, **options),
    "judge_restoration": lambda frames, **options: rsv.judge_restoration(frames, frames, TIMING, VIBRATION, **options),
    "restore": lambda frames, **options: rsv.restore(frames, TIMING, VIBRATION, **options),
    "VibrationRestorer": lambda frames, **options: rsv.VibrationRestorer(TIMING, **options)(frames, VIBRATION),
}


@pytest.mark.filterwarnings("ignore::rsvib_torch.RestorationWarning")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_channels_last_is_an_option_and_refused_without_it(colour, name):
    function, last = FUNCTIONS[name], colour.permute(0, 2, 3, 1)
    message = 'frames of shape (3, 284, 202, 3) do not appear to be (T, C, H, W): pass channels="last"'
    refuses(lambda: function(last), re.escape(message))
    refuses(lambda: function(last[0].numpy()), r"one image \(H, W, C\) is frames\[None\]")
    found, expected = function(last, channels="last"), function(colour)
    for attribute in ("vibration.amplitude", "motion.coefficients", "misfit_after", "offsets", "predicted_gain"):
        values = [found, expected]
        for part in attribute.split("."):
            values = [getattr(value, part, None) for value in values]
        if isinstance(values[0], torch.Tensor):
            torch.testing.assert_close(*values, equal_nan=True)
    if isinstance(found, torch.Tensor):
        torch.testing.assert_close(found.movedim(-1, -3) if found.ndim == 4 else found, expected)


def test_channels_last_in_calibration_and_files(colour, tmp_path):
    rows = torch.arange(512)
    light = (0.4 + 0.2 * torch.cos(2 * torch.pi * rows / 64))[None, :, None, None].expand(1, 512, 16, 3)
    refuses(lambda: rsv.calibrate_row_time(light, 1000.0), r"not appear to be \(T, C, H, W\): pass channels")
    found = rsv.calibrate_row_time(light, 1000.0, channels="last")
    assert found.row_time == pytest.approx(1 / 64e3, rel=1e-6)
    last = colour.permute(0, 2, 3, 1)
    refuses(lambda: rsv.write_stack(tmp_path / "frames.tif", last), r"not appear to be \(T, C, H, W\): pass channels")
    assert not list(tmp_path.iterdir())
    rsv.write_stack(tmp_path / "frames.tif", last, channels="last")
    assert torch.equal(rsv.read_stack(tmp_path / "frames.tif"), colour)


def test_channels_last_in_scenes_and_quality(grey):
    with pytest.raises(ValueError, match=r"appears to have its channels last: pass scene.permute\(2, 0, 1\)"):
        rsv.simulate_frames(torch.rand(320, 240, 3), TIMING, VIBRATION)
    assert rsv.psnr(list(grey), list(0.9 * grey), 1.0).shape == (3,)


@pytest.mark.parametrize("shape", [(2, 40, 30, 3), (40, 30, 3), (40, 30, 1)])
def test_arrays_in_files_with_channels_last_are_refused(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.zeros(shape, np.uint8))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = np.zeros(shape, np.uint8)
    for name, remedy in (("a.npy", r"store \(T, C, H, W\)$"), ("a.h5", r"store \(T, C, H, W\)$")):
        with pytest.raises(ValueError, match=rf"{name}: .* appears to have its channels last; .*{remedy}"):
            rsv.read_stack(tmp_path / name)
    with pytest.raises(ValueError, match=r"of shape \(8, 30, 3\) would be read as one with channels last; write .tif"):
        rsv.write_stack(tmp_path / "b.npy", torch.rand(8, 30, 3), channels="first")


@pytest.mark.parametrize("scan_axis", [-2, -1])
@pytest.mark.parametrize("batch", [False, True])
def test_channels_last_keeps_masks_and_comes_back(scan_axis, batch):
    timing = rsv.SensorTiming(20e-6, 20, 2048, scan_axis=scan_axis, readout_direction="reverse")
    frames = torch.rand(*((4,) if batch else ()), 2, 5, 7, 3)
    frames[..., 0, 1, 2] = torch.nan
    for ignore in (torch.rand(2, 5, 7) > 0.8, torch.rand(5, 7) > 0.8, torch.rand(frames.shape) > 0.8):
        prepared = prepare_frames(frames, timing, channels="last", ignore=ignore, saturation=0.9)
        first = ignore.movedim(-1, -3) if ignore.shape == frames.shape else ignore
        expected = prepare_frames(frames.movedim(-1, -3), timing, ignore=first, saturation=0.9)
        for attribute in ("images", "missing", "saturated"):
            assert torch.equal(getattr(prepared, attribute), getattr(expected, attribute))
        back = prepared.from_row_order(prepared.images)
        assert torch.equal(back, torch.where(prepared.from_row_order(prepared.missing) > 0, 0.0, frames))


@pytest.mark.parametrize(
    ("shape", "channels"),
    [
        ((2, 8, 48, 64), "first"),  # eight bands
        ((2, 48, 64, 8), "last"),
        ((2, 3, 48, 4), None),  # few columns
        ((2, 8, 64, 4), "first"),  # appears to be channels last
        ((2, 48, 64), "last"),  # no channels
        ((3, 2, 3, 48, 64), None),
    ],
)
def test_valid_shapes_are_accepted(shape, channels):
    frames = torch.rand(shape)
    prepared = prepare_frames(frames, TIMING, channels=channels)
    assert prepared.images.ndim == 5
    assert torch.equal(prepared.from_row_order(prepared.images), frames)


def test_lists_are_stacked(grey, colour):
    expected = dewarp(grey, TIMING, VIBRATION)
    lists = {
        "tensors": list(grey),
        "arrays": [frame.numpy() for frame in grey],
        "reversed": [np.ascontiguousarray(frame.numpy()[::-1])[::-1] for frame in grey],
        "mixed": [grey[0], grey[1].numpy(), grey[2]],
    }
    for frames in lists.values():
        assert torch.equal(dewarp(frames, TIMING, VIBRATION), expected)
    counts = [(4095 * frame.numpy()).round().astype(np.uint16) for frame in grey]
    restored = dewarp(counts, TIMING, VIBRATION, full_scale=4095)
    assert rms(restored - expected) < 2e-3
    last = [frame.permute(1, 2, 0).numpy() for frame in colour]
    assert dewarp(last, TIMING, VIBRATION, channels="last").shape == (3, 284, 202, 3)
    assert as_tensor("frames", [list(grey), list(grey)]).shape == (2, 3, 284, 202)


def test_files_are_read(grey, tmp_path):
    counts = (65535 * grey.numpy()).round().astype(np.uint16)
    counts[:, 60:62, 60:62] = 65535  # saturated
    for index, frame in enumerate(counts):
        cv2.imwrite(str(tmp_path / f"{index}.png"), frame)
    np.save(tmp_path / "stack.npy", counts)
    paths = sorted(tmp_path.glob("*.png"))
    expected = dewarp(counts, TIMING, VIBRATION, full_scale=65535)
    for frames in (paths, str(tmp_path / "stack.npy")):
        assert torch.equal(dewarp(frames, TIMING, VIBRATION, full_scale=65535), expected)
        found = rsv.detect_vibration(frames, TIMING, tones=1, full_scale=65535)
        torch.testing.assert_close(found.vibration.amplitude[:, 0], VIBRATION.amplitude[:, 0], rtol=0.02, atol=0)
        assert torch.equal(rsv.read_stack(frames, full_scale=65535), torch.from_numpy(np.float32(counts)) / 65535)
    rsv.write_stack(tmp_path / "floats.tif", grey)
    assert torch.equal(dewarp([tmp_path / "floats.tif"], TIMING, VIBRATION), dewarp(grey, TIMING, VIBRATION))
    for frames, error, message in (
        (paths, ValueError, "0.png: full scale of uint16 frames unknown: pass full_scale"),
        ([paths[0], tmp_path / "floats.tif"], ValueError, r"0.png is \(284, 202\) uint16, .*floats.tif is"),
        ([tmp_path / "none.png"], FileNotFoundError, "none.png does not exist"),
    ):
        with pytest.raises(error, match=message):
            dewarp(frames, TIMING, VIBRATION)
    refuses(lambda: rsv.read_stack([]), "path must contain at least one file")


def test_half_precision_is_accurate_to_its_quantisation(grey):
    """Differences from float32 are those that noise of the size of the quantisation causes."""
    dtype, scale = torch.float16, 4095.0
    half = (scale * grey).to(dtype)
    quantisation = rms(half.float() / scale - grey)
    restored, expected = rsv.restore(half, TIMING, VIBRATION), rsv.restore(grey, TIMING, VIBRATION)
    assert restored.dtype == dtype
    assert 0 < rms(restored.float() / scale - expected) < 2.5 * quantisation
    found, truth = (rsv.detect_vibration(frames, TIMING, tones=1) for frames in (half, grey))
    assert found.reliable.all()
    for name in ("amplitude", "frequency", "phase"):
        difference = getattr(found.vibration, name) - getattr(truth.vibration, name)
        assert bool((difference.abs() < 3 * getattr(found.std, name)).all()), name
    assert found.vibration.amplitude.dtype == torch.float64


@pytest.mark.parametrize(("shape", "order"), [((48, 64, 3, 10), (3, 2, 0, 1)), ((2, 3, 10, 48, 64), (0, 2, 1, 3, 4))])
def test_frames_on_another_axis_are_refused(shape, order):
    frames = torch.zeros(shape)
    refuses(lambda: rsv.restore(frames, TIMING, VIBRATION), "do not appear to be .* or channels=.first. if they are")
    assert rsv.restore(frames.permute(order), TIMING, VIBRATION).shape == frames.permute(order).shape
    assert rsv.restore(frames, TIMING, rsv.Vibration.still(), channels="first").shape == shape


def test_equal_frames_are_those_of_a_camera_at_rest(grey):
    assert not rsv.detect_vibration(grey[[0, 0, 0]], TIMING).reliable.any()
