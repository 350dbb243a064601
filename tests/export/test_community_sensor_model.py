"""ISD of vibrating frames: positions and rays by the formulas of usgscsm against an independent rotating camera."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_truth import TrueCamera
from refusals import refuses
from usgscsm_formulas import FrameModel, LineScanModel

import rsvib_torch as rsv

TIMING = rsv.SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=320)
SIZE = (300, 360)
SLOW = TrueCamera(2e6, SIZE, TIMING, (0.4, 0.6, 0.0), (30.0, 50.0, 0.0))
FAST = TrueCamera(2e6, SIZE, TIMING)
POINTS = [(0.5, 0.5), (299.5, 0.5), (0.5, 359.5), (299.5, 359.5), (150.5, 180.5), (71.5, 300.5), (220.5, 33.5)]
LIMIT = 0.005  # px


def still_isd(truth, **more):
    arguments = {"position": (5000.0, -3000.0, 3800.0), "look": (-5.0, 3.3, -3.9)} | more
    return rsv.camera_isd(truth.camera, truth.size, **arguments)


def template(**more):
    """The fields of a frame camera of the test data of usgscsm: a mirrored image, 10 px/mm, and a rotating body."""
    state = {"ephemeris_times": [50], "reference_frame": 1}
    return {
        "name_model": "USGS_ASTRO_FRAME_SENSOR_MODEL",
        "name_platform": "TEST_PLATFORM",
        "name_sensor": "TEST_SENSOR",
        "center_ephemeris_time": 1000.0,
        "starting_ephemeris_time": 0,
        "detector_sample_summing": 1,
        "detector_line_summing": 1,
        "focal2pixel_lines": [0.0, 10.0, 0.0],
        "focal2pixel_samples": [0.0, 0.0, 10.0],
        "focal_length_model": {"focal_length": 50},
        "image_lines": 16,
        "image_samples": 16,
        "detector_center": {"line": 8.0, "sample": 8.0},
        "interpolation_method": "lagrange",
        "optical_distortion": {"radial": {"coefficients": [0.0, 0.0, 0.0]}},
        "radii": {"semimajor": 1000, "semiminor": 1000, "unit": "km"},
        "reference_height": {"maxheight": 1000, "minheight": -1000, "unit": "m"},
        "starting_detector_line": 0,
        "starting_detector_sample": 0,
        "jitter": {"lineJitterCoefficients": [9.0], "sampleJitterCoefficients": [9.0], "lineExposureTimes": [1.0]},
        "instrument_position": {"unit": "km", "positions": [[1050.0, 0.0, 0.0]], "velocities": [[0, 0, -1.0]], **state},
        "instrument_pointing": {"quaternions": [[-0.707106781186547, 0, -0.707106781186547, 0]], **state},
        "body_rotation": {"quaternions": [[0.96, 0.0, 0.0, 0.28]], "time_dependent_frames": [4, 5, 6], **state},
        "sun_position": {"positions": [[1e5, 1e5, 0.0]], "velocities": [[0, 0, 0]], "unit": "m", **state},
    } | more


def written(path, *arguments, **options):
    model = rsv.write_isd(path, *arguments, **options)
    isd = json.loads(Path(path).read_text())
    return model, (FrameModel if model == "frame" else LineScanModel)(isd), isd


def errors(model, still, truth, frame=0):
    """Largest errors in px at pixel centres: image of a ground point, and ray of the pixel; and without motion."""
    image, ray, nothing = [], [], []
    for line, sample in POINTS:
        # the ray of the camera at rest that this pixel sees, as a position of the still model
        attitude = truth.mean_attitude(line - 0.5, frame)
        rest = cv2.Rodrigues(attitude)[0] @ truth.rest_ray(sample - 0.5, line - 0.5)
        x, y = truth.place(rest, moving=False)
        centre, direction = still.ray(y + 0.5, x + 0.5)
        image.append(np.array(model.image(centre + 7e5 * direction)) - (line, sample))
        nothing.append(np.array(still.image(centre + 7e5 * direction)) - (line, sample))
        at, seen = model.ray(line, sample)
        np.testing.assert_allclose(at, centre, rtol=0, atol=1e-6)
        ray.append(np.cross(seen, direction) * truth.focal_length)
    return [float(np.abs(values).max()) for values in (image, ray, nothing)]


def test_jitter_of_a_frame_camera(tmp_path):
    still = still_isd(SLOW)
    model, sensor, isd = written(tmp_path / "frame.json", SLOW.vibration(), TIMING, still)
    image, ray, nothing = errors(sensor, FrameModel(still), SLOW)
    assert model == "frame"
    assert len(isd["jitter"]["lineJitterCoefficients"]) <= 12
    assert image < LIMIT
    assert ray < LIMIT
    assert nothing > 0.3


def test_jitter_of_the_second_frame_read_in_reverse(tmp_path):
    timing = rsv.SensorTiming(2e-5, 20, 320, readout_direction="reverse")
    truth = TrueCamera(2e6, SIZE, timing, (0.4, 0.6, 0.0), (30.0, 50.0, 0.0))
    still = still_isd(truth)
    model, sensor, _ = written(tmp_path / "frame.json", truth.vibration(), timing, still, frame=1)
    image, ray, _ = errors(sensor, FrameModel(still), truth, frame=1)
    assert model == "frame"
    assert max(image, ray) < LIMIT
    assert max(errors(sensor, FrameModel(still), truth, frame=0)[:2]) > 0.05


@pytest.mark.parametrize("time", [0.0, 366389046.668])
def test_line_scan_with_one_quaternion_per_row(tmp_path, time):
    """Three axes; also at times of real missions, which float64 resolves to 6e-8 s."""
    still = still_isd(FAST, ephemeris_time=time)
    model, sensor, isd = written(tmp_path / "frame.json", FAST.vibration(), TIMING, still)
    image, ray, nothing = errors(sensor, FrameModel(still), FAST)
    assert model == "line-scan"
    assert isd["name_model"] == "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
    assert image < LIMIT
    assert ray < LIMIT
    assert nothing > 2.0


@pytest.mark.parametrize("distortion", [(-0.2, 0.3, 0.0, 0.0, 0.0), (-0.1, 0.02, 1e-3, -2e-3, 0.01)])
def test_lens_distortion_and_principal_point(tmp_path, distortion):
    """A lens of 1.4 degrees, written as radtan: jitter keeps it, a line scanner has it along its line."""
    slow = TrueCamera(
        30000.0, SIZE, TIMING, (0.3, 0.4, 0.0), (30.0, 20.0, 0.0), distortion=distortion, principal_point=(12.0, -7.0)
    )
    still = still_isd(slow)
    model, sensor, isd = written(tmp_path / "frame.json", slow.vibration(), TIMING, still)
    assert model == "frame"
    assert isd["optical_distortion"] == still["optical_distortion"]
    assert max(errors(sensor, FrameModel(still), slow)[:2]) < LIMIT
    fast = TrueCamera(100000.0, SIZE, TIMING, distortion=distortion, principal_point=(12.0, -7.0))
    still = still_isd(fast)
    model, sensor, _ = written(tmp_path / "frame.json", fast.vibration(), TIMING, still)
    assert model == "line-scan"
    assert max(errors(sensor, FrameModel(still), fast)[:2]) < LIMIT


@pytest.mark.parametrize("model", ["frame", "line-scan"])
@pytest.mark.parametrize("matrix", [((10.0, 0.0), (0.0, 10.0)), ((-10.0, 0.0), (0.0, 10.0)), ((0.0, 5.0), (-5.0, 0.0))])
def test_template_of_another_program(tmp_path, model, matrix):
    """A mirrored, a rotated and a binned detector: content at s appears at s + D."""
    still = template(
        focal2pixel_lines=[0.25, *matrix[0]],
        focal2pixel_samples=[0.0, *matrix[1]],
        starting_detector_sample=3,
        detector_sample_summing=2,
        detector_line_summing=2,
        focal_length_model={"focal_length": 400.0},
        detector_center={"line": 16.0, "sample": 19.0},
    )
    timing = rsv.SensorTiming(row_time=2e-5, exposure_rows=4, frame_rows=20)
    still["instrument_pointing"]["constant_rotation"] = [0.6, 0.0, 0.8, 0.0, 1.0, 0.0, -0.8, 0.0, 0.6]
    vibration = rsv.Vibration((0.3, 0.4), (40.0, 60.0), (0.4, 1.0))
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(still))
    found, sensor, isd = written(tmp_path / "out.json", vibration, timing, path, model=model)
    assert found == model
    assert isd["radii"] == still["radii"]
    del still["jitter"]
    for line, sample in ((0.5, 0.5), (15.5, 7.5), (4.5, 14.5)):
        middle = (line - 0.5) * timing.row_time + 0.5 * timing.exposure_time
        size = np.sinc(np.array([40.0, 60.0]) * timing.exposure_time) * (0.3, 0.4)
        x, y = size * np.sin(2 * np.pi * np.array([40.0, 60.0]) * middle + (0.4, 1.0))
        centre, direction = FrameModel(still).ray(line - y, sample - x)
        at, seen = sensor.ray(line, sample)
        np.testing.assert_allclose(at, centre, rtol=0, atol=1e-6)
        per_px = np.linalg.norm(FrameModel(still).ray(line, sample)[1] - FrameModel(still).ray(line, sample + 1)[1])
        assert np.linalg.norm(np.cross(seen, direction)) / per_px < LIMIT
        np.testing.assert_allclose(sensor.image(centre + 5e4 * direction), (line, sample), rtol=0, atol=LIMIT)


def test_models_are_refused_with_their_errors(tmp_path):
    wide = TrueCamera(1000.0, SIZE, TIMING)
    path = tmp_path / "frame.json"
    with pytest.raises(ValueError, match=r"within 0.005 px \(frame: .* px, of which .*line-scan: .*; pass a larger"):
        rsv.write_isd(path, wide.vibration(), TIMING, still_isd(wide))
    with pytest.raises(ValueError, match="step of the exposure time") as refused:
        rsv.write_isd(path, FAST.vibration(), TIMING, still_isd(FAST), model="frame")
    assert "line-scan" not in str(refused.value)
    timing = rsv.SensorTiming(2e-5, 20, 320, readout_direction="reverse")
    refuses(lambda: rsv.write_isd(path, FAST.vibration(), timing, still_isd(FAST)), "bottom to top")
    assert not path.exists()
    assert rsv.write_isd(path, wide.vibration(), TIMING, still_isd(wide), model="frame", tolerance=5.0) == "frame"


@pytest.mark.parametrize(
    ("truth", "motion", "timing", "fields", "message"),
    [
        (SLOW, lambda motion: motion.expanded(2), {}, {}, r"batch of shape \(2,\): pass one of them"),
        (SLOW, None, {"scan_axis": "x"}, {}, "scan_axis must be -2"),
        (SLOW, None, {}, {"image_lines": 1000}, "frame_rows=320 is less than"),
        (FAST, None, {}, {"optical_distortion": {"transverse": {}}}, "'transverse' is not supported"),
        (FAST, None, {}, {"instrument_pointing": {"quaternions": 3}}, r"instrument_pointing\.quaternions"),
        (FAST, lambda motion: motion.with_camera(rsv.Camera(500.0)), {}, {}, "500 px, isd one with 2.*with_camera"),
    ],
)
def test_wrong_arguments(tmp_path, truth, motion, timing, fields, message):
    vibration = truth.vibration() if motion is None else motion(truth.vibration())
    with pytest.raises(ValueError, match=message):
        rsv.write_isd(tmp_path / "frame.json", vibration, replace(TIMING, **timing), still_isd(truth) | fields)
    assert list(tmp_path.iterdir()) == []


def test_wrong_files_and_looks(tmp_path):
    path, vibration, still = tmp_path / "frame.json", SLOW.vibration(), still_isd(SLOW)
    refuses(lambda: still_isd(SLOW, look=(0.0, 0.0, 0.0)), "look must be a direction")
    path.write_text(json.dumps(still))
    refuses(lambda: rsv.write_isd(path, vibration, TIMING, path), "same file as the input")
    assert json.loads(path.read_text()) == still
    (tmp_path / "broken.json").write_text("[1]")
    refuses(lambda: rsv.write_isd(tmp_path / "new.json", vibration, TIMING, tmp_path / "broken.json"), r"broken\.json")
    assert not (tmp_path / "new.json").exists()


def test_uniform_image_motion_and_zoom(tmp_path):
    """Drift is exported; zoom is not a rotation, and refused by both models where it is visible."""
    drift = rsv.Vibration((0.0, 0.0), (1.0, 1.0), image_motion=(30.0, -20.0))
    _, sensor, _ = written(tmp_path / "frame.json", drift, TIMING, still_isd(SLOW))
    time = 100 * TIMING.row_time + 0.5 * TIMING.exposure_time
    line, sample = sensor.without_jitter(100.5, 50.5)
    np.testing.assert_allclose((100.5 - line, 50.5 - sample), (-20.0 * time, 30.0 * time), rtol=0, atol=5e-4)
    zoom = rsv.Vibration((0.0, 0.0, 0.0, 1e-3), (1.0, 1.0, 1.0, 40.0))
    refuses(lambda: rsv.write_isd(tmp_path / "zoom.json", zoom, TIMING, still_isd(SLOW)), "no sensor model represents")
