"""A camera that turns, apart from the package: frames of a distant scene, and the rates of a gyroscope."""

import numpy as np
import torch
from benchmarks.independent_camera import exposed
from field_truth import LensMotion, pixel_starts
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial.transform import Rotation
from truth import draw_scene

import rsvib_torch as rsv

FOCAL_LENGTH, SIZE, COUNT = 380.0, (200, 216), 4
BIAS, OFFSET = (0.012, -0.02, 0.008), 0.35
TIMING = rsv.SensorTiming(row_time=8e-5, exposure_rows=10, frame_rows=420)


def attitude(times, size=1.0):
    """Attitude of the camera: rotations about its axes z, y, x one after another, each a sum of two tones."""
    angles = [
        size * a * np.sin(2 * np.pi * f * times + p) + size * b * np.sin(2 * np.pi * g * times + q)
        for a, f, p, b, g, q in (
            (4e-3, 7.1, 0.2, 2e-3, 17.3, 1.0),
            (3e-3, 9.7, 1.2, 2e-3, 21.1, 0.1),
            (4e-3, 6.3, 2.2, 3e-3, 14.9, 0.6),
        )
    ]
    return Rotation.from_euler("ZYX", np.stack(angles, -1))


def rates_of(times, size=1.0, step=1e-6):
    """Angular rates (N, 3) about the axes of the camera, by the difference of two attitudes."""
    return (attitude(times - step, size).inv() * attitude(times + step, size)).as_rotvec() / (2 * step)


def take(timing, size=1.0, *, noise=0.003, dashboard=0, subject=None, count=COUNT, fisheye=None):
    """Frames (T, H, W) of a distant scene, and of what is fixed to the camera in the last ``dashboard`` rows.

    A subject on 62 % of the frame moves before the scene by ``subject`` of the time, (N, 2) px. The lens has the four
    coefficients ``fisheye`` of OpenCV.
    """
    height, width = SIZE
    scene = draw_scene(height + 60, width + 60, 5)
    middle = (np.array(scene.shape[::-1]) - 1) / 2
    coefficients = spline_filter(scene, 5)
    row, column = np.mgrid[:height, :width].astype(float)
    points = np.stack([column - (width - 1) / 2, row - (height - 1) / 2], -1).reshape(-1, 2)
    lens = {} if fisheye is None else {"distortion": fisheye, "fisheye": True}
    rays = LensMotion(focal_length=FOCAL_LENGTH, **lens).rays(points)

    def seen_at(times):
        seen = attitude(times.ravel(), size).apply(rays).reshape(height, width, 3)
        seen = FOCAL_LENGTH * seen[..., :2] / seen[..., 2:] + middle
        image = map_coordinates(coefficients, [seen[..., 1], seen[..., 0]], order=5, prefilter=False)
        if subject is not None:
            place = seen - subject(times.ravel()).reshape(seen.shape)
            inside = (np.abs(place - np.array(scene.shape[::-1]) / 2 - [0, 20]) < [95, 70]).all(-1)
            image[inside] = map_coordinates(draw_scene(*scene.shape, 8), place[inside].T[::-1], order=3)
        return image

    starts = pixel_starts(timing, SIZE, count)
    frames = np.stack([exposed(seen_at, of_frame, timing.exposure_time, 3) for of_frame in starts])
    if dashboard:
        frames[:, -dashboard:] = draw_scene(dashboard, width, 9)
    frames += noise * np.random.default_rng(1).standard_normal(frames.shape)
    return torch.from_numpy(frames).float()


def in_axes(orientation, of_camera):
    """Rates (N, 3) about the axes of a gyroscope, from those about the axes of the camera."""
    own = np.zeros_like(of_camera)
    for axis, letter in enumerate(orientation):
        own[:, "xyz".index(letter.lower())] = of_camera[:, axis] * (1.0 if letter.isupper() else -1.0)
    return own


def unrelated_rates(times):
    """Rates (N, 3) of a smooth motion that is not that of the camera."""
    noise = np.random.default_rng(4).standard_normal((len(times), 3))
    smooth = np.stack([np.convolve(column, np.hanning(25) / 12, "same") for column in noise.T], -1)
    return rsv.AngularRates(times, torch.from_numpy(0.3 * smooth))


def recorded(orientation="XYZ", size=1.0, mirrored=1.0, count=COUNT):
    """Rates about the axes of a gyroscope, for an assignment of the axes of the camera."""
    times = np.arange(-0.04, 0.0656 + count * TIMING.frame_period, 1e-3)
    own = in_axes(orientation, rates_of(times, size))
    own[:, 0] *= mirrored
    return rsv.AngularRates(torch.from_numpy(times + OFFSET), torch.from_numpy(own + np.array(BIAS)))
