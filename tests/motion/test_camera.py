"""Camera with lens distortion: projection against OpenCV, image formation against direct sampling of the scene."""

import json
from dataclasses import asdict

import numpy as np
import pytest
import torch
from field_truth import LensMotion, take_field_frames
from refusals import refuses
from truth import draw_scene

import rsvib_torch as rsv

LENS = rsv.Camera(574.0, (6.5, 9.5), (-0.12, 0.05, 1e-3, -2e-3, 0.01))
FISHEYE = rsv.Camera(390.0, (-6.0, 7.0), (0.15, -0.148, 0.083, -0.0155), fisheye=True)  # 75 degrees at a corner


def grid(width, height, dtype=torch.float64):
    x = torch.linspace(-0.5, 0.5, 9, dtype=dtype) * (width - 1)
    y = torch.linspace(-0.5, 0.5, 7, dtype=dtype)[:, None] * (height - 1)
    return torch.broadcast_tensors(x, y)


@pytest.mark.parametrize("camera", [LENS, FISHEYE])
def test_displacement_equals_rotation_and_projection_of_opencv(camera):
    components = torch.tensor([7.0, -5.0, 4e-3, 3e-4], dtype=torch.float64)
    x, y = grid(800, 600)
    moved = camera.displacement(components, x, y).reshape(-1, 2)
    truth = LensMotion(**asdict(camera))
    points = torch.stack([x, y], -1).reshape(-1, 2).numpy()
    expected = truth.turned(points, np.array([7.0, -5.0, 4e-3]), scale=1 + 3e-4) - points
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    assert float((moved - components[:2]).abs().max()) > 3.0  # px: far from a translation


@pytest.mark.parametrize("camera", [LENS, FISHEYE, rsv.Camera(390.0, fisheye=True)])
def test_factors_are_the_derivative_of_the_displacement(camera):
    x, y = grid(800, 600)
    factors = camera.factors(x, y, 4)
    for axis, step in enumerate((1e-4, 1e-4, 1e-7, 1e-7)):
        unit = torch.zeros(4, dtype=torch.float64)
        unit[axis] = step
        slope = (camera.displacement(unit, x, y) - camera.displacement(-unit, x, y)) / (2 * step)
        torch.testing.assert_close(slope, factors[..., axis], atol=2e-5, rtol=1e-6)


@pytest.mark.parametrize(("scan_axis", "direction"), [("x", "forward"), ("y", "reverse"), ("x", "reverse")])
def test_motion_in_row_order_displaces_turned_images_alike(scan_axis, direction):
    timing = rsv.SensorTiming(4e-5, 5, 700, scan_axis=scan_axis, readout_direction=direction)
    motion = rsv.Vibration((3.0, 5.0, 2e-3, 1e-4), (90.0, 61.0, 70.0, 50.0), (0.3, 1.0, 2.0, 0.5), camera=LENS)
    time = torch.tensor(0.003, dtype=torch.float64)
    x, y = grid(800, 600)
    moved = LENS.displacement(motion.displacement(time), x, y)
    rowwise = motion.to_row_order(timing)
    # image coordinates in row order: transposed for scan axis x, then flipped
    to_rows = (lambda p: p.flip(-1)) if scan_axis == "x" else (lambda p: p)
    sign = torch.tensor([1.0, -1.0 if direction == "reverse" else 1.0], dtype=torch.float64)
    points = to_rows(torch.stack([x, y], -1)) * sign
    turned = rowwise.camera.displacement(rowwise.displacement(time), points[..., 0], points[..., 1])
    torch.testing.assert_close(turned, to_rows(moved) * sign)
    assert rowwise.from_row_order(timing).camera == LENS


def test_simulated_frames_equal_a_scene_sampled_through_the_lens():
    lens, timing = (-0.12, 0.05, 1e-3, -2e-3, 0.01), rsv.SensorTiming(row_time=4e-5, exposure_rows=4, frame_rows=150)
    truth = LensMotion((3.0, 5.0, 2e-3, 0.0), (90.0, 61.0, 70.0, 0.0), (0.3, 1.0, 2.0, 0.0), 300.0, (6.5, 9.5), lens)
    motion = truth.vibration(3).with_camera(rsv.Camera(300.0, (6.5, 9.5), lens))
    scene, inner = draw_scene(200, 240, 3, blur=1.3), (slice(None), slice(6, -6), slice(6, -6))
    expected = take_field_frames(scene, timing, truth, (120, 160))[inner]
    found, flat = (
        rsv.simulate_frames(torch.from_numpy(scene), timing, one, 2, frame_size=(120, 160)).numpy()[inner]
        for one in (motion, truth.vibration(3))
    )
    assert np.std(found - expected) < 1.5e-3
    assert np.std(flat - expected) > 5 * np.std(found - expected)


def test_files_keep_the_camera(tmp_path):
    vibration = rsv.Vibration((3.0, 5.0), (90.0, 61.0), camera=LENS)
    free = rsv.FreeMotion(torch.zeros(3, 8), 0.0, 0.01, camera=LENS)
    for motion in (vibration, free, vibration.with_camera(FISHEYE)):
        motion.save(tmp_path / "motion.json")
        assert type(motion).load(tmp_path / "motion.json").camera == motion.camera


# Format of the files in https://github.com/gyroflow/lens_profiles.
PROFILE = {
    "calib_dimension": {"w": 3840, "h": 2160},
    "fisheye_params": {
        "camera_matrix": [[1248.0, 0.0, 1909.5], [0.0, 1250.0, 1086.5], [0.0, 0.0, 1.0]],
        "distortion_coeffs": [0.15, -0.148, 0.083, -0.0155],
    },
    "distortion_model": None,
    "digital_lens": None,
    "fps": 59.94,
}


def test_lens_profile_for_scaled_frames(tmp_path):
    (tmp_path / "lens.json").write_text(json.dumps(PROFILE))
    camera = rsv.Camera.from_gyroflow(tmp_path / "lens.json", 1920, 1080)
    assert camera.focal_length == pytest.approx(624.5, abs=0.01)
    assert camera.principal_point == pytest.approx((-5.0, 3.5))
    assert (camera.fisheye, camera.distortion) == (True, (0.15, -0.148, 0.083, -0.0155))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"digital_lens": "gopro_superview"}, "lens model 'gopro_superview' is not supported"),
        ({"distortion_model": "poly5"}, "lens model 'poly5' is not supported"),
        ({"calib_dimension": {"w": 3840, "h": 2880}}, "is for frames of 3840 x 2880 px, got 1920 x 1080 px"),
        ({"calib_dimension": {"w": 3840}}, "not a lens profile of Gyroflow: KeyError"),
        ({"fisheye_params": {"camera_matrix": [["1", 0, 0]] * 3}}, "not a lens profile of Gyroflow: TypeError"),
        (
            {"fisheye_params": PROFILE["fisheye_params"] | {"camera_matrix": [[9.0, 0, 0], [0, 12.0, 0], [0, 0, 1]]}},
            "different focal lengths along x and y, 9 and 12 px",
        ),
    ],
)
def test_other_lens_profiles_are_refused(tmp_path, change, message):
    (tmp_path / "lens.json").write_text(json.dumps(PROFILE | change))
    refuses(lambda: rsv.Camera.from_gyroflow(tmp_path / "lens.json", 1920, 1080), message)
