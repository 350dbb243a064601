"""Tables of tones: one row per tone and axis, units in the names, no padding; pandas."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
from detections import detection_of, result_of
from refusals import refuses

import rsvib_torch as rsv
from rsvib_torch.results.reason import Reason
from rsvib_torch.stacks.manifest import StackManifest
from rsvib_torch.stacks.windows import WindowRecord

TIMING = rsv.SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
TWO_TONES = rsv.Vibration(
    [[2.0, 0.5], [1.0, 0.0]], [[60.0, 145.0], [130.0, 0.0]], [[0.3, 2.0], [-1.0, 0.0]], [20.0, 0.0]
)


def window(number, vibration, **options):
    """Window of frames 4 n ... 4 n + 4; None as the vibration for a failed one."""
    detection = None if vibration is None else detection_of(vibration, **options)
    start, error = 4 * number * TIMING.frame_period, "the frames have no contrast" if detection is None else None
    return WindowRecord(number, 4 * number, 4 * number + 4, start, 4, "as taken", detection, error=error)


def manifest_of(*windows):
    settings = {"sensor": TIMING.to_dict()}
    return StackManifest({"shape": [40, 300, 400]}, settings, {}, "restored.tif", windows)


def test_one_row_per_tone_without_padding(tmp_path):
    found = result_of(
        TWO_TONES, TIMING, 0.01, last_row=480, num_pairs=2, reliable=(True, False), reasons=((), ("few", "blind"))
    )
    rsv.write_table(tmp_path / "tones.csv", found)
    with (tmp_path / "tones.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["axis"], row["tone"]) for row in rows] == [("x", "1"), ("x", "2"), ("y", "1")]
    assert [float(row["frequency_Hz"]) for row in rows] == [60.0, 145.0, 130.0]
    assert [float(row["amplitude_px"]) for row in rows] == [2.0, 0.5, 1.0]
    assert {row[f"amplitude_std{which}_px"] for row in rows for which in ("", "_if_hidden_tone")} == {"0.01"}
    assert [row["reliable"] for row in rows] == ["True", "True", "False"]
    assert [row["reasons"] for row in rows] == ["", "", "unspecified unspecified"]
    times = found.offsets
    middle = 0.5 * float(times.times.min() + times.later_times.max())  # the timing of this result is not known
    assert [float(row["middle_time_s"]) for row in rows] == pytest.approx([middle] * 3)


def test_units_of_length():
    found = detection_of(TWO_TONES)
    table = found.table(pixel_size=12.5e-6)
    angular = 2 * math.pi * np.array([60.0, 145.0, 130.0])
    amplitude = 12.5e-6 * np.array([2.0, 0.5, 1.0])
    np.testing.assert_allclose(table["amplitude_um"], 1e6 * amplitude)
    np.testing.assert_allclose(table["velocity_um_per_s"], 1e6 * angular * amplitude)
    np.testing.assert_allclose(table["acceleration_m_per_s2"], angular**2 * amplitude)
    assert table["image_motion_um_per_s"] == [250.0, 250.0, 0.0]
    assert "25.000 ± 0.025" in found.physical_summary(12.5e-6)
    refuses(lambda: found.table(pixel_size=12500.0), r"pixel_size \(in m\) must be at most 1000")


def test_roll_has_a_column_of_its_own_and_an_axis_without_tone_one_row():
    vibration = rsv.Vibration([[2.0], [0.0], [1e-3]], [[60.0], [0.0], [70.0]])
    table = detection_of(vibration, reliable=(True, True, True), reasons=((), (), ())).table(pixel_size=1e-6)
    assert table["tone"] == [1, 0, 1]
    assert table["amplitude_px"] == [2.0, None, None]
    assert table["amplitude_rad"] == [None, None, 1e-3]
    assert table["frequency_Hz"] == [60.0, None, 70.0]
    assert table["amplitude_um"] == [pytest.approx(2.0), None, None]


def test_windows_have_their_middle_and_failed_ones_a_row():
    still = rsv.Vibration([[1.0], [0.0]], [[60.0], [0.0]])
    table = manifest_of(window(0, TWO_TONES), window(1, None), window(2, still)).table()
    assert table["window"] == [0, 0, 0, 1, 2, 2]
    assert table["axis"] == ["x", "x", "y", None, "x", "y"]
    assert table["note"][3] == "the frames have no contrast"
    half = 0.5 * (299 * 2e-5 + 20 * 2e-5)
    assert table["middle_time_s"] == pytest.approx([(2 + 4 * n) * TIMING.frame_period + half for n in table["window"]])


def test_all_tones_are_followed_over_the_windows():
    """Two tones 2 % apart in frequency change places in size; a third one is in one window."""
    windows = [
        window(0, rsv.Vibration([[2.0, 1.0], [0.0, 0.0]], [[100.0, 102.0], [0.0, 0.0]])),
        window(1, rsv.Vibration([[1.9, 1.1], [0.0, 0.0]], [[102.4, 100.2], [0.0, 0.0]])),
        window(2, rsv.Vibration([[2.2, 0.3], [0.0, 0.0]], [[100.4, 310.0], [0.0, 0.0]])),
        window(3, rsv.Vibration([[9.0], [0.0]], [[55.0], [0.0]]), reliable=(False, True)),
    ]
    summary = manifest_of(*windows).totals()["tones"]["x"]
    assert summary["reliable_windows"] == 3
    tones = [(tone["windows"], tone["amplitude"], tone["frequency"]) for tone in summary["tones"]]
    assert tones == [(3, 2.0, 100.2), (2, pytest.approx(1.45), pytest.approx(102.2)), (1, 0.3, 310.0)]
    text = manifest_of(*windows).summary()
    assert all(f"{windows} of 4" in text for windows in (3, 2, 1))


def test_a_table_without_tones_has_no_explanation_of_its_columns():
    table, *explained = manifest_of(window(0, TWO_TONES), window(1, TWO_TONES)).lines()[0]
    assert explained == ["median ± standard deviation over the windows"]
    assert table.split("\n")[1].split() == ["x", "2", "of", "2", "2.000", "60.00"]
    assert manifest_of(window(0, None), window(1, None)).lines()[0] == [
        "axis  reliable windows  amplitude (px)  frequency (Hz)\nx     0 of 2\ny     0 of 2"
    ]


def test_the_answer_about_a_camera_at_rest_is_one_sentence():
    still = [replace(window(0, TWO_TONES), detection=None, window=n) for n in range(2)]
    findings = tuple((Reason("no_tone", axis),) for axis in "xy")
    at_rest = replace(detection_of(TWO_TONES), findings=findings)
    vibration, restoration = manifest_of(*(replace(one, detection=at_rest) for one in still)).lines()
    assert len(vibration) == 1
    assert vibration[0].startswith("no window has a significant tone: the camera stands still")
    assert restoration == []


def test_windows_that_restoration_does_not_help_are_named_with_the_first_reason():
    better = replace(window(0, TWO_TONES), frames="restored", outcome="helps", verdict="restored frames agree")
    worse = replace(window(1, TWO_TONES), outcome="worse", verdict="restored is no better than raw: noise")
    manifest = manifest_of(better, worse)
    (doubt,) = manifest.doubts
    said = "improvement not certain in 1 window; in window 1: restored is no better than raw: noise"
    assert " ".join(doubt.split()) == said
    assert doubt in manifest.lines()[1]
    assert "1 of 2 windows restored" in manifest.summary()
    assert manifest_of(better).doubts == []


def test_pandas_frame_is_the_table():
    pytest.importorskip("pandas")
    frame = detection_of(TWO_TONES).to_pandas(pixel_size=1e-6)
    assert list(frame.columns) == list(detection_of(TWO_TONES).table(pixel_size=1e-6))
    assert frame.groupby("axis").amplitude_um.max().to_dict() == pytest.approx({"x": 2.0, "y": 1.0})
