"""Camera with lens distortion: projection against OpenCV, image formation against direct sampling of the scene."""

import json

import cv2
import numpy as np
import pytest
import torch
from refusals import refuses
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

LENS = rsv.Camera(574.0, (6.5, 9.5), (-0.12, 0.05, 1e-3, -2e-3, 0.01))
FISHEYE = rsv.Camera(390.0, (-6.0, 7.0), (0.15, -0.148, 0.083, -0.0155), fisheye=True)  # 75 degrees at a corner


def grid(width, height, dtype=torch.float64):
    x = torch.linspace(-0.5, 0.5, 9, dtype=dtype) * (width - 1)
    y = torch.linspace(-0.5, 0.5, 7, dtype=dtype)[:, None] * (height - 1)
    return torch.broadcast_tensors(x, y)


def project_angle(lens, angle):
    """Distance from the principal point over the focal length of a ray at an angle, by OpenCV."""
    ray = np.array([[[np.tan(angle), 0.0, 1.0]]])
    return cv2.fisheye.projectPoints(ray, np.zeros(3), np.zeros(3), np.eye(3), lens)[0][0, 0, 0]


def opencv_displacement(camera, components, points):
    """Displacement by a rotation: undistorted by root finding, rotated by SciPy, projected by OpenCV."""
    f, (cx, cy), lens = camera.focal_length, camera.principal_point, np.array(camera.distortion)

    def project(rays, scale=1.0):
        matrix = np.array([[scale * f, 0, cx], [0, scale * f, cy], [0, 0, 1]])
        if camera.fisheye:
            return cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, lens)[0][:, 0]
        return cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, lens)[0][:, 0]

    rays = np.c_[(points - camera.principal_point) / f, np.ones(len(points))]
    if camera.fisheye:
        far = np.linalg.norm(rays[:, :2], axis=1)
        angles = [brentq(lambda angle, d=d: project_angle(lens, angle) - d, 0, 1.5) for d in far]
        rays[:, :2] *= (np.tan(angles) / far)[:, None]
    else:
        for _ in range(100):  # fixed point: the distortion of this lens moves points by less than a tenth
            rays[:, :2] -= (project(rays) - points) / f
    x, y, theta, zeta = components
    turned = Rotation.from_rotvec([-y / f, x / f, theta]).apply(rays)
    return project(turned, 1 + zeta) - points


@pytest.mark.parametrize("camera", [LENS, FISHEYE])
def test_displacement_equals_rotation_and_projection_of_opencv(camera):
    components = torch.tensor([7.0, -5.0, 4e-3, 3e-4], dtype=torch.float64)
    x, y = grid(800, 600)
    moved = camera.displacement(components, x, y).reshape(-1, 2)
    expected = opencv_displacement(camera, components.tolist(), torch.stack([x, y], -1).reshape(-1, 2).numpy())
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
    camera, height, width, margin = rsv.Camera(300.0, (6.5, 9.5), (-0.12, 0.05, 1e-3, -2e-3, 0.01)), 120, 160, 40
    scene = gaussian_filter(city_and_fields(height + 2 * margin, width + 2 * margin, seed=3).double().numpy(), 1.0)
    timing = rsv.SensorTiming(row_time=4e-5, exposure_rows=1, frame_rows=150)
    motion = rsv.Vibration((3.0, 5.0, 2e-3), (90.0, 61.0, 70.0), (0.3, 1.0, 2.0), camera=camera)
    frames = rsv.simulate_frames(torch.from_numpy(scene), timing, motion, 2, frame_size=(height, width)).numpy()
    coefficients = spline_filter(scene, order=5)
    x = torch.arange(width, dtype=torch.float64) - 0.5 * (width - 1)
    for frame, row in ((0, 3), (0, 60), (1, 20), (1, 116)):
        time = torch.tensor((frame * 150 + row + 0.5) * 4e-5, dtype=torch.float64)
        y = torch.full_like(x, row - 0.5 * (height - 1))
        at_x, at_y = x, y
        for _ in range(20):
            moved = camera.displacement(motion.displacement(time), at_x, at_y)
            at_x, at_y = x - moved[:, 0], y - moved[:, 1]
        places = [at_y.numpy() + margin + 0.5 * (height - 1), at_x.numpy() + margin + 0.5 * (width - 1)]
        expected = map_coordinates(coefficients, places, order=5, prefilter=False)
        assert np.sqrt(np.square(frames[frame, row] - expected).mean()) < 1.5e-3
        still = map_coordinates(coefficients, [y.numpy() + margin + 59.5, x.numpy() + margin + 79.5], order=5)
        assert np.sqrt(np.square(frames[frame, row] - still).mean()) > 0.03


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


def test_a_lens_that_folds_the_image_is_refused():
    FISHEYE.check_size(800, 600)
    with pytest.raises(ValueError, match=r"check the order \(k1, k2, k3, k4\)"):
        rsv.Camera(390.0, distortion=(-1.0, 0.0, 0.0, 0.0), fisheye=True).check_size(800, 600)
