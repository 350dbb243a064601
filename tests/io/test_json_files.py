"""JSON files of results: values are read back exactly, and files that do not fit are refused."""

import json
from dataclasses import replace

import pytest

from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.report.results import check_same_timing
from rsvib_torch.stacks import read_manifest

TIMING = SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=104)
WINDOW = {"window": 0, "first": 0, "last": 3, "start_time": 0.0, "written": 4, "frames": "as taken", "left_alone": []}
WINDOW |= dict.fromkeys(("detection", "outcome", "summary", "predicted_gain"))
WINDOW |= {"error": "all pixels of frame 2 are equal", "bad_frames": {"2": "all pixels are equal"}}
MANIFEST = {"format": "rsvib stack", "version": 1, "output": None, "windows": [WINDOW, WINDOW | {"window": 1}]}
MANIFEST |= {name: {} for name in ("input", "settings", "versions", "bad_frames")}


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
    check_same_timing("vibration.json", TIMING, replace(TIMING, row_time=1e-4 * (1 + 1e-12)))
