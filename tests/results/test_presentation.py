"""Text, dictionaries, files, devices and figures of results."""

import json
import math
import re
from dataclasses import replace

import cv2
import pytest
import torch
from refusals import refuses
from truth import Motion, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch.text import measured_text, text_table

TIMING = rsv.SensorTiming(row_time=4e-5, exposure_rows=12, frame_rows=300)
MOTION = Motion((1.6, 1.1), (71.0, 113.0), (0.6, -1.2))


@pytest.fixture(scope="module", name="frames")
def make_frames():
    return torch.from_numpy(take_frames(draw_scene(336, 336, 4), TIMING, MOTION, 4, noise=0.005)).float()


def recording():
    """The motion as a recording whose clock is 0.3 s ahead of that of the frames."""
    times = torch.linspace(0.28, 0.38, 1001, dtype=torch.float64)
    return rsv.FreeMotion.through(times, torch.from_numpy(MOTION.displacement(times.numpy() - 0.3)))


def rates():
    """The same as rates of a gyroscope of a camera with a focal length of 900 px."""
    motion = recording()
    velocity = torch.gradient(motion.displacement(motion.knots[1:-1]), spacing=motion.spacing, dim=0)[0]
    zero = torch.zeros_like(velocity[:, 0])
    return rsv.AngularRates(motion.knots[1:-1], torch.stack([velocity[:, 1], -velocity[:, 0], zero], -1) / 900.0)


@pytest.fixture(scope="module", name="detection")
def make_detection(frames):
    return rsv.detect_vibration(frames, TIMING)


@pytest.fixture(scope="module", name="windows")
def make_windows(frames):
    starts = TIMING.frame_starts(4).tolist()
    timings = [replace(TIMING, frame_start_times=tuple(starts[first : first + 2])) for first in range(3)]
    found = [rsv.detect_vibration(frames[first : first + 2], timing) for first, timing in enumerate(timings)]
    return rsv.DetectionResult.stacked(found)


@pytest.fixture(scope="module", name="results")
def make_results(frames, detection, windows):
    """One result of every public type."""
    restored = rsv.restore(frames, TIMING, detection)
    light = 0.4 + 0.2 * torch.cos(2 * torch.pi * torch.arange(512) / 64)
    free = rsv.detect_motion(frames, TIMING)
    edge = torch.arange(60.0)[:, None] * 0.1 + torch.arange(40.0) - 22.0
    found = (
        detection,
        windows,
        detection.vibration,
        windows.vibration,
        detection.std,
        detection.offsets,
        windows.offsets,
        free,
        free.motion,
        rsv.judge_restoration(frames, restored, TIMING, detection),
        rates(),
        rsv.align_motion(frames, TIMING, rates(), camera=rsv.Camera(900.0), offsets=(0.299, 0.301)),
        rsv.calibrate_row_time(light[None, :, None].expand(1, 512, 16), 1000.0),
        rsv.slanted_edge_mtf(torch.special.ndtr(edge / 0.8)),
    )
    return [(type(result).__name__, result) for result in found]


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (5.2, 0.00009, "5.200000 ± 0.000090"),
        (60.0, 0.996, "60.0 ± 1.0"),
        (12345.6, 789.0, "12350 ± 790"),
        (-0.0004, 0.02, "0.000 ± 0.020"),
        (3.14159, math.inf, "3.142 ± ∞"),
        (3.14159, math.nan, "3.142 ± unknown"),
        (math.inf, 1.0, "∞ ± 1.0"),
        (0.0, 0.0, "0.000 ± 0.000"),
        (1234.56, None, "1235"),
        (1e-20, 1e-12, "0.000000000 ± 0.000000000"),
    ],
)
def test_values_have_the_digits_of_their_standard_deviation(value, std, text):
    assert measured_text(value, std) == text
    assert measured_text(torch.tensor(value, dtype=torch.float64), std) == text


HIDDEN = "(±): if another tone is hidden in the record"


def test_a_detection_prints_in_seven_lines(detection, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")  # texts are wrapped at the width of the terminal
    lines = str(detection).splitlines()
    assert repr(detection) == detection.summary() == str(detection)
    assert len(lines) == 7
    assert lines[0].split() == ["axis", "amplitude", "(px)", "frequency", "(Hz)", "phase", "(rad)"]
    for line, letter, amplitude, frequency, phase in zip(
        lines[1:3], "xy", MOTION.amplitude, MOTION.frequency, MOTION.phase, strict=True
    ):
        assert line.startswith(f"{letter} ")
        numbers = [float(number) for number in re.findall(r"-?[\d.]+", re.sub(r"\(.*?\)", "", line))]
        for value, std, true in zip(numbers[::2], numbers[1::2], (amplitude, frequency, phase), strict=True):
            assert abs(value - true) < 5 * std < 0.5
    assert lines[3:5] == ["x: reliable", "y: reliable"]
    assumed = "83.33 frames/s; frequencies scale with it; a wrong row_time=4e-05 s adds multiples of it"
    assert lines[5:] == [f"assumed: {assumed}", HIDDEN]


def test_batches_print_as_a_compact_table(windows):
    lines = windows.summary().splitlines()
    assert len(lines) == 1 + 2 * 3 + 1
    assert lines.pop() == HIDDEN
    assert lines[0].split()[0] == "index"
    assert [line.split()[:2] for line in lines[1:]] == [[str(i), axis] for i in range(3) for axis in "xy"]
    assert all(line.endswith("reliable") for line in lines[1:])
    assert len(windows.vibration.summary().splitlines()) == 7
    assert len(text_table(("n",), [[str(i)] for i in range(1000)]).splitlines()) == 22


def test_no_result_prints_tensors(results, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")  # texts are wrapped at the width of the terminal
    for name, result in results:
        text = repr(result)
        assert 0 < len(text.splitlines()) <= 9, (name, text)
        assert "tensor(" not in text, name
        assert max(map(len, text.splitlines())) <= 110, (name, text)


def assert_equal(one, other, name):
    """Both are equal, with the same types and no loss of precision."""
    if isinstance(one, torch.Tensor):
        torch.testing.assert_close(other, one, rtol=0, atol=0, equal_nan=True, msg=name)
    elif hasattr(one, "__dataclass_fields__"):
        for field in one.__dataclass_fields__:
            assert_equal(getattr(one, field), getattr(other, field), f"{name}.{field}")
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key, value in one.items():
            assert_equal(value, other[key], f"{name}.{key}")
    else:
        assert one == other, name


def test_every_result_is_saved_and_loaded_exactly(results, tmp_path):
    for number, (name, result) in enumerate(results):
        path = tmp_path / f"{number}.json"
        result.save(path)
        data = json.loads(path.read_text())
        assert {key: value for key, value in data.items() if key not in ("format", "version", "units")} == json.loads(
            json.dumps(result.to_dict(), allow_nan=False)
        ), name
        assert_equal(result, type(result).load(path), name)


def test_results_move_between_devices(results):
    for name, result in results:
        assert_equal(result, result.to("cpu"), name)
        moved = result.to("meta")
        tensors = [value for value in vars(moved).values() if isinstance(value, torch.Tensor)]
        assert all(value.device.type == "meta" for value in tensors), name
    detection = results[0][1].to("meta")
    assert detection.vibration.amplitude.device.type == "meta"
    assert detection.offsets.times.device.type == "meta"


def test_results_are_drawn(results, tmp_path):
    for number, (name, result) in enumerate(results):
        path = tmp_path / f"{number}.png"
        if name in ("AngularRates", "RowTimeCalibration", "VibrationStd"):
            with pytest.raises(TypeError, match=r"has no figure; these have one: DetectionResult, D"):
                result.plot(path)
        elif result.batch_shape:
            with pytest.raises(ValueError, match=r"result is a batch of shape \(3,\): pass one of them, result\[0\]"):
                result.plot(path)
        else:
            result.plot(path)
            assert cv2.imread(str(path)).std() > 5, name
        html = result._repr_html_()
        assert html.startswith("<pre"), name
        assert ("<img" in html) == path.exists()
    assert results[0][1].plot()._repr_png_().startswith(b"\x89PNG")
    results[0][1].plot(tmp_path / "offsets.svg")
    assert "<svg" in (tmp_path / "offsets.svg").read_text()


def test_figures_of_batches_are_refused(windows):
    for draw in (rsv.offset_figure, lambda w: rsv.motion_figure(w.vibration)):
        with pytest.raises(ValueError, match=r"is a batch of shape \(3,\): pass one of them"):
            draw(windows)


def test_a_saved_detection_is_a_vibration_json(detection, windows, frames, tmp_path):
    path = tmp_path / "vibration.json"
    detection.save(path)
    given = rsv.read_vibration(path, TIMING)
    assert given.summary() == detection.summary()
    torch.testing.assert_close(rsv.restore(frames, TIMING, given), rsv.restore(frames, TIMING, detection))
    windows.save(path)
    refuses(lambda: rsv.read_vibration(path), r"is a batch of shape \(3,\): pass one of them")
