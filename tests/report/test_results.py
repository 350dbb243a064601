"""Result files, manifests and figures."""

import csv
import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from detections import result_of

from rsvib_torch.detection import DetectionResult
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.report.plots import comparison_figure, detailed_places, offset_figure, save_figure
from rsvib_torch.report.results import (
    check_same_timing,
    read_vibration,
    write_offsets,
)
from rsvib_torch.stacks import read_manifest

TIMING = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)


@pytest.fixture(name="result")
def draw_result() -> DetectionResult:
    """A detection of two tones along x and one along y from three frames, with one band that failed."""
    vibration = Vibration(
        [[2.0, 0.5], [1.0, 0.0]], [[60.0, 145.0], [130.0, 0.0]], [[0.3, 2.0], [-1.0, 0.0]], [20.0, 0.0]
    )
    reasons = ([], ["only one period is seen"])
    found = result_of(vibration, TIMING, 0.01, last_row=480, num_pairs=2, reliable=(True, False), reasons=reasons)
    found.std.period[1, 1] = math.inf
    offsets = found.offsets.offsets
    offsets += 0.02 * torch.randn(offsets.shape, generator=torch.Generator().manual_seed(2)).double()
    offsets[1, 3], found.offsets.quality[1, 3] = torch.nan, 0.0
    residual = (offsets - found.fitted).abs().nanmean((0, 1))
    return replace(found, residual=residual, assumptions=("row_time=2e-05 s: assumed",))


def test_vibration_file_is_plain_json(tmp_path, result):
    replace(result, timing=TIMING).save(tmp_path / "vibration.json")
    text = (tmp_path / "vibration.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    data = json.loads(text)
    assert data["period"] == [[1 / 60, 1 / 145], [1 / 130, None]]
    assert data["std"]["period"][1] == [0.01, None]
    assert data["timing"]["frame_rows"] == 512
    assert data["reliable"] == [True, False]


@pytest.mark.parametrize(
    "timing",
    [
        replace(TIMING, row_time=2.01e-5),
        replace(TIMING, scan_axis="x"),
        replace(TIMING, readout_direction="reverse"),
        replace(TIMING, frame_start_times=[0.0, 0.01, 0.03]),
    ],
)
def test_vibration_of_another_timing_is_refused(tmp_path, result, timing):
    replace(result, timing=timing).save(tmp_path / "vibration.json")
    read_vibration(tmp_path / "vibration.json", timing)
    with pytest.raises(ValueError, match=r"the vibration was detected with another timing: .*here") as caught:
        read_vibration(tmp_path / "vibration.json", TIMING)
    assert str(caught.value).count("(here") == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("vibration"), "vibration: missing key"),
        (lambda d: d["timing"].pop("frame_rows"), "timing.frame_rows: missing key"),
        (lambda d: d.pop("reliable"), "reliable: missing key"),
        (
            lambda d: d["vibration"]["amplitude"][0].append(math.nan),
            "not a file of DetectionResult.save: NaN is not a JSON",
        ),
        (lambda d: d["vibration"].update(amplitude=[[None, 0.5], [1.0, 0.0]]), "vibration: amplitude must be finite"),
        (lambda d: d["vibration"].update(frequency=[["3"]]), "vibration.frequency: expected numbers in lists"),
        (lambda d: d.update(version=2), "expected format 'rsvib vibration' of version 1"),
        (lambda d: d.update(format="rsvib windows"), "expected format 'rsvib vibration' of version 1, as D"),
        (lambda d: d.update(gain=[[1.0], [2.0, 3.0]]), "gain: expected numbers in lists of equal lengths"),
    ],
)
def test_malformed_vibration_files_are_refused(tmp_path, result, change, message):
    path = tmp_path / "vibration.json"
    replace(result, timing=TIMING).save(path)
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError) as caught:
        read_vibration(path, TIMING)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_offsets_are_written_one_line_per_band(tmp_path, result):
    write_offsets(tmp_path / "offsets.csv", result)
    with (tmp_path / "offsets.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == result.offsets.times.numel() == 58
    assert [line["offset_x_px"] for line in lines].count("") == 1
    failed = lines[29 + 3]
    names = ("earlier_frame", "later_frame", "row", "offset_y_px")
    assert [failed[name] for name in names] == ["1", "2", "64.0", ""]
    for name, values in (("time_s", result.offsets.times), ("fitted_y_px", result.fitted[..., 1])):
        np.testing.assert_array_equal([float(line[name]) for line in lines], values.flatten())
    names = ("offset_x_px", "residual_x_px", "fitted_x_px")
    before, after, fitted = (np.array([float(line[name]) for line in lines if line["offset_x_px"]]) for name in names)
    np.testing.assert_allclose(after, before - fitted, rtol=0, atol=1e-12)
    assert after.std() < 0.1 * before.std()  # noise of 0.02 px
    good = [float(line["offset_x_px"]) for line in lines if line["offset_x_px"]]
    np.testing.assert_array_equal(good, result.offsets.offsets[..., 0][result.offsets.good])


def test_offset_figure_draws_the_measurements(tmp_path, result):
    figure = offset_figure(result)
    panels = {axes.get_title(loc="left"): axes for axes in figure.axes}
    for axis, name in enumerate("xy"):
        upper = panels[f"Offset along {name}"]
        shown = upper.collections[0].get_offsets()
        good = result.offsets.good
        np.testing.assert_allclose(shown[:, 0], 1e3 * result.offsets.times[good])
        np.testing.assert_allclose(shown[:, 1], result.offsets.offsets[..., axis][good])
        assert len(upper.collections[1].get_offsets()) == 1  # the band that failed
        for pair, line in enumerate(upper.lines):
            np.testing.assert_allclose(line.get_ydata(), result.fitted[pair, :, axis])
        assert "(px)" in upper.get_ylabel()
    below = panels[f"mean |residual| {result.residual[1]:.4f} px"]
    residual = (result.offsets.offsets - result.fitted)[..., 1][good]
    np.testing.assert_allclose(below.collections[0].get_offsets()[:, 1], residual)
    assert "(ms)" in below.get_xlabel()
    texts = " ".join(text.get_text() for axes in figure.axes for text in axes.texts)
    assert "2.000 ± 0.010 px at 60.000 ± 0.010 Hz" in texts
    assert "not reliable: only one period is seen" in texts
    save_figure(figure, tmp_path / "offsets.png", dpi=50)
    assert cv2.imread(str(tmp_path / "offsets.png")).std() > 5


def test_crops_are_at_the_strongest_detail_and_do_not_overlap():
    image = torch.full((90, 120), 0.4)
    image[10:30, 70:90] = torch.rand(20, 20, generator=torch.Generator().manual_seed(1))
    image[60:80, 20:40] = 0.5 * torch.rand(20, 20, generator=torch.Generator().manual_seed(2))
    (first, second) = detailed_places(image, 20, 2)
    assert max(abs(first[0] - 10), abs(first[1] - 70)) <= 1
    assert max(abs(second[0] - 60), abs(second[1] - 20)) <= 1
    places = detailed_places(image, 40, 50)
    assert 2 <= len(places) <= 6
    assert all(max(abs(a[0] - b[0]), abs(a[1] - b[1])) >= 40 for i, a in enumerate(places) for b in places[:i])
    assert detailed_places(image, 90, 3)[0][0] == 0


@pytest.mark.parametrize("shape", [(96, 130), (3, 96, 130), (2, 40, 30)])
def test_comparison_draws_the_same_crop_of_both_frames(tmp_path, shape):
    raw = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    figure = comparison_figure(raw, raw * 0.5, count=2, size=32)
    pictures = [axes.images[0] for axes in figure.axes]
    half = len(pictures) // 2
    for before, after in zip(pictures[:half], pictures[half:], strict=True):
        assert before.get_extent() == after.get_extent()
        left, _, _, top = before.get_extent()
        row, column = int(top + 0.5), int(left + 0.5)
        grey = raw if raw.ndim == 2 else raw.mean(0) if raw.shape[0] == 2 else raw[0]
        crop = grey[row : row + 30, column : column + 30].flatten()
        shown = before.get_array()[:30, :30, 0].flatten()
        assert np.corrcoef(shown, crop)[0, 1] > 0.99
        assert after.get_array().mean() < before.get_array().mean()  # the grey scale is common to both
    save_figure(figure, tmp_path / "before_after.png", dpi=40)
    assert (tmp_path / "before_after.png").stat().st_size > 1000


WINDOW = {"window": 0, "first": 0, "last": 3, "start_time": 0.0, "written": 4, "frames": "as taken", "left_alone": []}
WINDOW |= dict.fromkeys(("detection", "outcome", "predicted_gain"))
WINDOW |= {"error": "all pixels of frame 2 are equal", "bad_frames": {"2": "all pixels are equal"}}
MANIFEST = {"format": "rsvib stack", "version": 1, "output": "a.tif", "windows": [WINDOW, WINDOW | {"window": 1}]}
MANIFEST |= {name: {} for name in ("input", "settings", "versions")}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"windows": [WINDOW, WINDOW]}, r"windows\[1\]\.window: expected 1, got 0"),
        ({"windows": [WINDOW | {"first": "0"}]}, r"windows\[0\]: first must be a whole number, got '0'"),
        ({"windows": [{}]}, r"windows\[0\]\.window: missing key"),
        ({"windows": [WINDOW | {"detection": {}}]}, r"windows\[0\]\.detection\.vibration: missing key"),
        ({"version": 2}, "expected format 'rsvib stack' of version 1"),
    ],
)
def test_manifests_that_do_not_fit_are_refused(tmp_path, change, message):
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps(MANIFEST))
    assert [record.error for record in read_manifest(path).windows] == [WINDOW["error"]] * 2
    path.write_text(json.dumps(MANIFEST | change))
    with pytest.raises(ValueError, match=message):
        read_manifest(path)


def test_timings_are_compared_up_to_rounding():
    check_same_timing("vibration.json", TIMING, replace(TIMING, row_time=TIMING.row_time * (1 + 1e-12)))
