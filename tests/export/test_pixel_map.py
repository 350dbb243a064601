"""Sampling maps against positions by scalar iteration, and sampling with OpenCV against ``dewarp``."""

import cv2
import numpy as np
import pytest
import tifffile
import torch
from camera_truth import TrueCamera
from field_truth import FieldMotion, take_field_frames
from refusals import refuses
from truth import draw_scene

import rsvib_torch as rsv

MOTION = FieldMotion()
LIMIT = 0.005  # px


def field_position(x, y, frame, size, timing, motion, axes):
    """Position (x, y) in a frame of the content that a still camera shows at pixel (x, y)."""
    height, width = size
    right, down = x - 0.5 * (width - 1), y - 0.5 * (height - 1)
    there = np.array([x, y], dtype=float)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    for _ in range(40):
        line, lines = (there[1], height) if timing.scan_axis == -2 else (there[0], width)
        line = lines - 1 - line if timing.readout_direction == "reverse" else line
        times = frame * timing.frame_period + line * timing.row_time + 0.5 * (nodes + 1) * timing.exposure_time
        means = [0.5 * weights @ values for values in motion.components(times)]
        a, b, roll, zoom = [mean if axis < axes else 0.0 for axis, mean in enumerate(means)]
        there = np.array([x + a - roll * down + zoom * right, y + b + roll * right + zoom * down])
    return there


@pytest.mark.parametrize("axes", [2, 3, 4])
@pytest.mark.parametrize(("scan_axis", "direction"), [("y", "forward"), ("y", "reverse"), ("x", "reverse")])
def test_positions_in_all_orientations(axes, scan_axis, direction):
    size = (140, 180)
    timing = rsv.SensorTiming(8e-5, 12, 200, scan_axis=scan_axis, readout_direction=direction)
    maps = rsv.sampling_map(MOTION.vibration(axes), timing, size, 2)
    assert maps.shape == (2, *size, 2)
    still = np.stack(np.meshgrid(np.arange(180.0), np.arange(140.0)), -1)
    for x, y in ((0, 0), (179, 139), (3, 130), (90, 70), (170, 12)):
        for frame in (0, 1):
            expected = field_position(x, y, frame, size, timing, MOTION, axes)
            np.testing.assert_allclose(maps[frame, y, x].numpy(), expected, rtol=0, atol=LIMIT)
    assert np.abs(maps.numpy() - still).max() > 2.0


def test_positions_with_a_camera():
    """Exact rotation with a wide field of view and distortion, second frame."""
    timing = rsv.SensorTiming(5e-5, 15, 260)
    truth = TrueCamera(
        180.0, (200, 240), timing, distortion=(-0.15, 0.05, 1e-3, -1e-3, 0.0), principal_point=(9.0, -6.0)
    )
    maps = rsv.sampling_map(truth.vibration(), timing, truth.size, 2)
    without = rsv.sampling_map(truth.vibration(camera=False), timing, truth.size, 2)
    for x, y in ((0, 0), (239, 0), (0, 199), (239, 199), (120, 100), (60, 170)):
        expected = truth.place(truth.rest_ray(x, y), frame=1)
        np.testing.assert_allclose(maps[1, y, x].numpy(), expected, rtol=0, atol=LIMIT)
    assert (without - maps).abs().max() > 1.0


def sampled(frame, path, convention, size):
    """A frame at the positions of a map, by the interpolation of OpenCV."""
    first, second, inside = cv2.split(tifffile.imread(path))
    assert set(np.unique(inside)) <= {0.0, 1.0}
    if convention == "nuke":
        first, second = first * size[1] - 0.5, size[0] - second * size[0] - 0.5
    return cv2.remap(frame.astype(np.float32), first, second, cv2.INTER_LANCZOS4), inside


@pytest.mark.parametrize("convention", ["nuke", "opencv"])
@pytest.mark.parametrize("axes", [2, 3])
def test_sampling_with_opencv_is_dewarp(tmp_path, axes, convention):
    size, timing = (180, 220), rsv.SensorTiming(8e-5, 10, 240)
    motion = FieldMotion(tuple(a if k < axes else 0.0 for k, a in enumerate((2.0, 3.0, 4e-3, 0.0))))
    scene = draw_scene(230, 270, 11, blur=1.2)
    frames = take_field_frames(scene, timing, motion, size, 2)
    vibration = motion.vibration(axes)
    files = rsv.write_stmap(tmp_path / "maps", vibration, timing, size, 2, convention=convention)
    assert [file.name for file in files] == ["stmap_0000.tif", "stmap_0001.tif"]
    restored = rsv.restore(torch.from_numpy(frames), timing, vibration, method="dewarp", check=False).numpy()
    for frame, path, expected in zip(frames, files, restored, strict=True):
        found, inside = sampled(frame, path, convention, size)
        middle = (slice(12, -12), slice(12, -12))
        assert inside[middle].all()
        error = np.sqrt(np.mean((found - expected)[middle] ** 2))
        nothing = np.sqrt(np.mean((frame - expected)[middle] ** 2))
        assert error < 0.002
        assert nothing > 10 * error


def test_uniform_image_motion_keeps_the_shift_of_restoration():
    """Content stays where restore leaves it: moved by the whole-pixel shift of each frame."""
    timing = rsv.SensorTiming(2e-5, 10, 100)
    motion = rsv.Vibration((0.0, 0.0), (10.0, 10.0), image_motion=(4000.0, 0.0))
    maps = rsv.sampling_map(motion, timing, (80, 60), 3)
    _, shift = rsv.visible_pixels(timing, motion, (80, 60), 3)
    row = torch.arange(80, dtype=torch.float64)
    for frame in range(3):
        mean = 4000.0 * (frame * timing.frame_period + row * timing.row_time + 0.5 * timing.exposure_time)
        torch.testing.assert_close(maps[frame, :, 30, 0], 30 + mean - shift[frame, 0], rtol=0, atol=1e-6)
    assert shift[2, 0] > 10


def test_errors(tmp_path):
    timing, motion = rsv.SensorTiming(2e-5, 10, 100), rsv.Vibration((1.0, 1.0), (10.0, 10.0))
    refuses(lambda: rsv.sampling_map(motion.expanded(2), timing, (80, 60), 1), "is a batch")
    refuses(lambda: rsv.sampling_map(motion, timing, (120, 60), 1), "frame_rows=100 is less than")
    refuses(lambda: rsv.sampling_map(motion, timing, (80, 0), 1), r"size\[1\] must be at least 1")
    refuses(lambda: rsv.write_stmap(tmp_path / "maps", motion, timing, (80, 60), 0), "num_frames must be at least 1")
    with pytest.raises(ValueError, match="convention must be one of 'nuke', 'opencv'"):
        rsv.write_stmap(tmp_path / "maps", motion, timing, (80, 60), 1, convention="fusion")
    with pytest.raises(ValueError, match="more than its size"):
        rsv.write_stmap(tmp_path / "maps", rsv.Vibration((900.0, 1.0), (10.0, 10.0)), timing, (80, 60), 1)
    assert not (tmp_path / "maps").exists()
