"""The augmentation with roll and zoom, compared with a camera independent of the package."""

import numpy as np
import pytest
import torch
from field_truth import FieldMotion, take_field_frames
from kornia.geometry.keypoints import Keypoints
from scipy.optimize import fsolve
from truth import decibel, draw_scene

from rsvib_torch import RollingShutterVibration, SensorTiming

TIMING = SensorTiming(row_time=8e-5, exposure_rows=12, frame_rows=220)
# frequency and phase of roll and zoom are drawn from the ranges of x
MOTION = FieldMotion((1.4, 1.9, 8e-3, 5e-3), (38.0, 31.0, 38.0, 38.0), (0.3, 1.1, 0.3, 0.3))
SIZE, RIM = (192, 240), 32
INNER = (slice(12, -12), slice(12, -12))


def fixed(axes=4, timing=TIMING, **options):
    """The augmentation with ranges of one value."""
    ranges = {name: tuple((v, v) for v in getattr(MOTION, name)[:2]) for name in ("amplitude", "frequency", "phase")}
    turns = dict(zip(("roll", "zoom"), MOTION.amplitude[2:axes], strict=False))
    return RollingShutterVibration(timing, **ranges, **turns, **options)


def moved(point, timing=TIMING, size=SIZE):
    """Position in the frame of a scene point (x, y) in px: the mean displacement over the exposure of its row."""
    nodes = (np.arange(200) + 0.5) / 200 * timing.exposure_time
    middle = np.array([(size[1] - 1) / 2, (size[0] - 1) / 2])
    x, y = np.asarray(point) - middle

    def mean(row):
        return [part.mean() for part in MOTION.components(row * timing.row_time + nodes)]

    def miss(place):
        X, Y, roll, zoom = mean(place[1])
        return place - point - np.array([X - roll * y + zoom * x, Y + roll * x + zoom * y])

    return fsolve(miss, np.asarray(point, dtype=float), xtol=1e-12)


@pytest.fixture(scope="module")
def scene():
    return draw_scene(SIZE[0] + 2 * RIM, SIZE[1] + 2 * RIM, 11, blur=1.2)


@pytest.fixture(scope="module")
def still(scene):
    return torch.from_numpy(scene[RIM:-RIM, RIM:-RIM].copy())[None, None]


def test_images_equal_those_of_the_independent_camera(scene, still):
    truth = take_field_frames(scene, TIMING, MOTION, SIZE, 1)[0]
    image = fixed()(still)[0, 0].numpy()
    without = fixed(axes=2)(still)[0, 0].numpy()
    assert decibel(without[INNER], truth[INNER]) < 44
    assert decibel(image[INNER], truth[INNER]) > 57


def test_keypoints_move_with_the_image(still):
    augmentation = fixed()
    augmentation(still)
    points = torch.tensor(
        [[[5.0, 3.0], [230.0, 10.0], [120.5, 96.0], [20.0, 180.0], [235.0, 188.0]]], dtype=torch.float64
    )
    found = augmentation.transform_keypoints(Keypoints(points), augmentation._params, augmentation.flags).to_tensor()
    expected = np.stack([moved(point) for point in points[0].numpy()])
    np.testing.assert_allclose(found[0].numpy(), expected, rtol=0, atol=1e-6)
    assert np.abs(expected - points[0].numpy()).max() > 2.0


def test_the_drawn_vibration_has_the_axes():
    augmentation = RollingShutterVibration(TIMING, roll=(1e-3, 2e-3))
    augmentation(torch.rand(3, 1, 64, 48))
    vibration = augmentation.drawn_vibration()
    assert vibration.amplitude.shape == (3, 3, 1)
    assert bool((vibration.amplitude[:, 2] >= 1e-3).all() and (vibration.amplitude[:, 2] <= 2e-3).all())
    assert len(set(vibration.amplitude[:, 2, 0].tolist())) == 3
    zoom = RollingShutterVibration(TIMING, zoom=1e-3)
    zoom(torch.rand(2, 1, 64, 48))
    torch.testing.assert_close(zoom.drawn_vibration().amplitude[:, 2:, 0].float(), torch.tensor([[0.0, 1e-3]] * 2))
