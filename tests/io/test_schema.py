"""The JSON schema: records are read back exactly, and files written by version 0.1.0 still load."""

import json
import math
from dataclasses import replace

import pytest
import torch

from rsvib_torch.io.schema import DetectionRecord, TimingRecord, VibrationRecord, check_same_timing
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.report.results import read_vibration
from rsvib_torch.stacks import read_manifest

TIMING = SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=104)
TIMING_JSON = (
    '{"row_time": 0.0001, "exposure_rows": 6.0, "frame_rows": 104.0, "scan_axis": "y", '
    '"readout_direction": "forward", "frame_start_times": null}'
)
# Written by version 0.1.0 before the packages were reorganised; numbers are rounded.
OLD_VIBRATION = f"""{{
  "format": "rsvib vibration",
  "version": 1,
  "timing": {TIMING_JSON},
  "vibration": {{"amplitude": [[1.203], [0.8041]], "frequency": [[130.1], [170.1]], "phase": [[0.2884], [0.9144]],
    "image_motion": [0.6647, -0.9765], "image_acceleration": [0.0, 0.0]}},
  "period": [[0.007689], [0.005881]],
  "std": {{"amplitude": [[0.01524], [0.01569]], "frequency": [[0.1334], [null]], "period": [[7.888e-06], [null]],
    "phase": [[0.03353], [0.04423]], "image_motion": [1.822, 1.179], "image_acceleration": [0.0, 0.0]}},
  "gain": [[-1.789], [-1.33]],
  "residual": [0.08381, null],
  "reliable": [true, false],
  "reasons": [[], ["only a third of a period is seen"]],
  "units": {{"amplitude": "px", "frequency": "Hz", "period": "s", "phase": "rad at the first row of frame 0",
    "image_motion": "px/s", "image_acceleration": "px/s^2", "residual": "px",
    "gain": "px of offset per px of displacement"}}
}}
"""
OLD_DETECTION = """{"vibration": {"amplitude": [[1.2], [0.8066]], "frequency": [[130.2], [169.9]],
  "phase": [[0.2787], [0.9319]], "image_motion": [0.9906, -0.7447], "image_acceleration": [0.0, 0.0]},
  "std": {"amplitude": [[0.02371], [0.02871]], "frequency": [[0.4174], [0.5968]],
  "period": [[2.462e-05], [2.067e-05]], "phase": [[0.05791], [0.08482]], "image_motion": [2.707, 1.971],
  "image_acceleration": [0.0, 0.0]}, "gain": [[-1.793], [-1.337]], "residual": [0.07824, 0.05529],
  "reliable": [true, true], "reasons": [[], []]}"""
OLD_MANIFEST = f"""{{
  "format": "rsvib stack",
  "version": 1,
  "input": {{"name": "frames.npy", "bytes": 86144, "sha256_of_samples": "c6f95bb5", "shape": [7, 96, 64],
    "dtype": "uint16"}},
  "settings": {{"sensor": {TIMING_JSON}, "full_scale": 4095.0, "window": 4,
    "detection": {{"method": "bands", "tones": 1, "band_rows": 16, "band_step": 8, "search": 8}},
    "restoration": null, "given": null, "bad_frames": "pass", "force": false, "device": "cpu"}},
  "versions": {{"rsvib_torch": "0.1.0", "torch": "2.13.0+cpu", "numpy": "2.4.6"}},
  "output": null,
  "units": {{"start_time": "s, of the first row of the first frame of a window, where its time begins",
    "amplitude": "px", "frequency": "Hz", "period": "s", "phase": "rad at start_time", "image_motion": "px/s",
    "image_acceleration": "px/s^2", "residual": "px"}},
  "windows": [
    {{"window": 0, "first": 0, "last": 3, "start_time": 0.0, "written": 0, "frames": "as taken",
      "detection": {OLD_DETECTION}, "left_alone": [], "outcome": null, "summary": null, "error": null,
      "bad_frames": {{}}}},
    {{"window": 1, "first": 3, "last": 6, "start_time": 0.0312, "written": 0, "frames": "as taken",
      "detection": null, "left_alone": [], "outcome": null, "summary": null,
      "error": "all pixels of frame 4 are equal", "bad_frames": {{"4": "all pixels are equal"}}}}
  ],
  "bad_frames": {{"4": "all pixels are equal"}}
}}
"""


def test_vibration_json_of_version_0_1_0_loads(tmp_path):
    (tmp_path / "vibration.json").write_text(OLD_VIBRATION)
    detected = read_vibration(tmp_path / "vibration.json", TIMING)
    assert detected.vibration.amplitude.tolist() == [[1.203], [0.8041]]
    assert detected.vibration.frequency.tolist() == [[130.1], [170.1]]
    assert detected.vibration.phase.tolist() == [[0.2884], [0.9144]]
    assert detected.vibration.image_motion.tolist() == [0.6647, -0.9765]
    assert detected.std.frequency.tolist() == [[0.1334], [math.inf]]
    assert detected.std.image_motion.tolist() == [1.822, 1.179]
    assert detected.gain.tolist() == [[-1.789], [-1.33]]
    assert detected.residual[0] == 0.08381
    assert detected.residual[1].isnan()
    assert detected.reliable.tolist() == [True, False]
    assert detected.findings[0] == ()
    assert [(reason.code, str(reason)) for reason in detected.findings[1]] == [
        ("unspecified", "only a third of a period is seen")
    ]


def test_vibration_json_without_image_acceleration_and_shift_loads(tmp_path):
    data = json.loads(OLD_VIBRATION)
    assert "image_shift" not in data["vibration"]
    del data["vibration"]["image_acceleration"], data["std"]["image_acceleration"]
    (tmp_path / "vibration.json").write_text(json.dumps(data))
    detected = read_vibration(tmp_path / "vibration.json", TIMING)
    assert detected.vibration.image_acceleration.tolist() == [0.0, 0.0]
    assert detected.vibration.image_shift.tolist() == [0.0, 0.0]
    assert detected.std.image_acceleration.tolist() == [math.inf, math.inf]


def test_manifest_of_version_0_1_0_loads(tmp_path):
    (tmp_path / "manifest.json").write_text(OLD_MANIFEST)
    manifest = read_manifest(tmp_path / "manifest.json")
    first, second = manifest.detections()
    assert first.vibration.frequency.tolist() == [[130.2], [169.9]]
    assert first.std.phase.tolist() == [[0.05791], [0.08482]]
    assert first.reliable.tolist() == [True, True]
    assert second is None
    assert [record.start_time for record in manifest.windows] == [0.0, 0.0312]
    assert manifest.bad_frames == {"4": "all pixels are equal"}
    assert TimingRecord.from_timing(TIMING).model_dump() == manifest.settings["sensor"]
    assert [(record.left_alone, record.error) for record in manifest.windows] == [
        ([], None),
        ([], "all pixels of frame 4 are equal"),
    ]


@pytest.mark.parametrize("starts", [None, (0.0, 0.011, 0.03)])
@pytest.mark.parametrize(("axis", "direction"), [("y", "forward"), ("x", "reverse")])
def test_timing_is_read_back_exactly(axis, direction, starts):
    timing = SensorTiming(2e-5, 20, 512.25, axis, direction, starts)
    data = json.loads(json.dumps(TimingRecord.from_timing(timing).model_dump()))
    assert TimingRecord.model_validate(data).to_timing() == timing


def test_vibration_is_read_back_exactly():
    vibration = Vibration(
        [[2.0, 0.5], [1.0, 0.0]], [[60.0, 145.1], [1 / 3, 0.0]], 0.3, [20.0, 0.0], [0.0, -3.0], [1.5, 0.0]
    )
    data = json.loads(json.dumps(VibrationRecord.from_vibration(vibration).model_dump()))
    back = VibrationRecord.model_validate(data).to_vibration()
    for name in VibrationRecord.model_fields:
        torch.testing.assert_close(getattr(back, name), getattr(vibration, name), rtol=0, atol=0)


def test_different_numbers_of_tones_are_refused():
    data = json.loads(OLD_DETECTION)
    data["std"]["phase"] = [[0.1, 0.2], [0.1, 0.2]]
    with pytest.raises(ValueError, match=r"phase must have shape \(\.\.\., A, K\) with .*K = 1"):
        DetectionRecord.model_validate(data).to_detection()


def test_timings_are_compared_up_to_rounding():
    stored = TimingRecord.from_timing(TIMING)
    check_same_timing("vibration.json", stored, replace(TIMING, row_time=1e-4 * (1 + 1e-12)))
    with pytest.raises(ValueError, match=r"^v\.json: .* another timing: row_time=0\.0001 \(here 0\.000101\); detect"):
        check_same_timing("v.json", stored, replace(TIMING, row_time=1.01e-4))
