"""The sensor models of usgscsm in NumPy, written from its public formulas: image positions, rays, ground points.

A ray is a projection centre and a direction in body-fixed axes, m; lines and samples are those of the Community Sensor
Model, with (0.5, 0.5) at the centre of the first pixel.
"""

import numpy as np
from scipy.spatial.transform import Rotation


def rotation_of(quaternions):
    """The rotation of quaternions (w, x, y, z) of any length."""
    return Rotation.from_quat(quaternions, scalar_first=True)


def undistorted(isd, dx, dy):
    ((kind, lens),) = isd["optical_distortion"].items()
    k = lens["coefficients"]
    if kind == "radial":
        r2 = dx * dx + dy * dy
        factor = 1.0 - (k[0] + r2 * (k[1] + r2 * k[2]))
        return dx * factor, dy * factor
    assert kind == "radtan"
    ux, uy = dx, dy
    for _ in range(50):
        ex, ey = radtan(k, ux, uy)
        ux, uy = ux + dx - ex, uy + dy - ey
    return ux, uy


def radtan(k, x, y):
    r2 = x * x + y * y
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3
    return (
        x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
        y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y,
    )


def distorted(isd, ux, uy):
    ((kind, lens),) = isd["optical_distortion"].items()
    if kind == "radtan":
        return radtan(lens["coefficients"], ux, uy)
    dx, dy = ux, uy
    for _ in range(50):
        ex, ey = undistorted(isd, dx, dy)
        dx, dy = dx + ux - ex, dy + uy - ey
    return dx, dy


def focal_plane(isd, line, sample):
    det_line = line * isd["detector_line_summing"] + isd["starting_detector_line"]
    det_sample = sample * isd["detector_sample_summing"] + isd["starting_detector_sample"]
    tl, ts = isd["focal2pixel_lines"], isd["focal2pixel_samples"]
    t1 = det_line - isd["detector_center"]["line"] - tl[0]
    t2 = det_sample - isd["detector_center"]["sample"] - ts[0]
    determinant = tl[1] * ts[2] - tl[2] * ts[1]
    return (ts[2] * t1 - tl[2] * t2) / determinant, (-ts[1] * t1 + tl[1] * t2) / determinant


def pixel(isd, dx, dy):
    tl, ts = isd["focal2pixel_lines"], isd["focal2pixel_samples"]
    line = tl[0] + tl[1] * dx + tl[2] * dy + isd["detector_center"]["line"] - isd["starting_detector_line"]
    sample = ts[0] + ts[1] * dx + ts[2] * dy + isd["detector_center"]["sample"] - isd["starting_detector_sample"]
    return line / isd["detector_line_summing"], sample / isd["detector_sample_summing"]


class FrameModel:
    """The frame camera, with jitter if the ISD has it."""

    def __init__(self, isd):
        self.isd = isd
        self.centre = 1000.0 * np.array(isd["instrument_position"]["positions"][0])
        to_sensor = rotation_of(isd["instrument_pointing"]["quaternions"][0]).as_matrix()
        if "constant_rotation" in isd["instrument_pointing"]:
            to_sensor = np.reshape(isd["instrument_pointing"]["constant_rotation"], (3, 3)) @ to_sensor
        to_body = rotation_of(isd["body_rotation"]["quaternions"][0]).as_matrix()
        self.to_body = to_body @ to_sensor.T  # from the sensor

    def without_jitter(self, line, sample):
        if "jitter" not in self.isd:
            return line, sample
        jitter = self.isd["jitter"]
        times = jitter["lineExposureTimes"]
        nearest = int(np.floor(line + 0.5))  # std::round, for positive lines
        time = times[max(min(nearest, len(times)), 1) - 1]
        count = len(jitter["lineJitterCoefficients"])
        assert len(jitter["sampleJitterCoefficients"]) == count
        powers = [time ** (count - n) for n in range(count)]
        return (
            line - sum(c * p for c, p in zip(jitter["lineJitterCoefficients"], powers, strict=True)),
            sample - sum(c * p for c, p in zip(jitter["sampleJitterCoefficients"], powers, strict=True)),
        )

    def with_jitter(self, line, sample, tolerance=1e-6):
        at_line, at_sample = line, sample
        for _ in range(20):
            without = self.without_jitter(at_line, at_sample)
            if abs(without[0] - line) < tolerance and abs(without[1] - sample) < tolerance:
                break
            at_line, at_sample = line + at_line - without[0], sample + at_sample - without[1]
        return at_line, at_sample

    def ray(self, line, sample):
        ux, uy = undistorted(self.isd, *focal_plane(self.isd, *self.without_jitter(line, sample)))
        look = self.to_body @ np.array([ux, uy, self.isd["focal_length_model"]["focal_length"]])
        return self.centre, look / np.linalg.norm(look)

    def image(self, ground):
        look = self.to_body.T @ (ground - self.centre)
        f = self.isd["focal_length_model"]["focal_length"]
        dx, dy = distorted(self.isd, f * look[0] / look[2], f * look[1] / look[2])
        return self.with_jitter(*pixel(self.isd, dx, dy))


def lagrange(values, start, step, time):
    """Interpolation of evenly spaced values (N, K), with 8 points inside and fewer near the ends."""
    place = (time - start) / step
    index = min(max(int(place), 0), len(values) - 2)
    half = next(h for h in (4, 3, 2, 1) if index >= h - 1 and index < len(values) - h)
    nodes = np.arange(index - half + 1, index + half + 1)
    result = np.zeros(values.shape[1])
    for node in nodes:
        others = nodes[nodes != node]
        result += values[node] * np.prod((place - others) / (node - others))
    return result


class LineScanModel:
    """The line scanner, with constant position and quaternions by time."""

    def __init__(self, isd):
        self.isd = isd
        pointing, body = isd["instrument_pointing"], isd["body_rotation"]
        assert "constant_rotation" not in pointing
        assert pointing["ephemeris_times"] == body["ephemeris_times"] == isd["instrument_position"]["ephemeris_times"]
        times = np.array(pointing["ephemeris_times"])
        steps = np.diff(times)
        self.step = (times[-1] - times[0]) / (len(times) - 1)
        assert np.allclose(steps, self.step, rtol=1e-9, atol=0)
        self.start = times[0] - isd["center_ephemeris_time"]
        products = rotation_of(body["quaternions"]) * rotation_of(pointing["quaternions"]).inv()
        self.quaternions = products.as_quat(scalar_first=True)
        self.positions = 1000.0 * np.array(isd["instrument_position"]["positions"])
        velocities = np.array(isd["instrument_position"]["velocities"])
        assert np.linalg.norm(np.cross(self.positions[0], velocities[0])) > 0  # usgscsm divides by it

    def time(self, line):
        ((first_line, start, duration),) = self.isd["line_scan_rate"]
        return start + duration * (line - first_line + 0.5)

    def to_body(self, time):
        return rotation_of(lagrange(self.quaternions, self.start, self.step, time)).as_matrix()

    def centre(self, time):
        return lagrange(self.positions, self.start, self.step, time)

    def ray(self, line, sample):
        ux, uy = undistorted(self.isd, *focal_plane(self.isd, 0.0, sample))
        time = self.time(line)
        look = self.to_body(time) @ np.array([ux, uy, self.isd["focal_length_model"]["focal_length"]])
        return self.centre(time), look / np.linalg.norm(look)

    def seen(self, line, ground):
        """Detector line, relative to that of the scanner, and sample of a ground point at the time of a line."""
        time = self.time(line)
        look = self.to_body(time).T @ (ground - self.centre(time))
        f = self.isd["focal_length_model"]["focal_length"]
        return pixel(self.isd, *distorted(self.isd, f * look[0] / look[2], f * look[1] / look[2]))

    def image(self, ground):
        """The line at which the ground point lies on the line of the scanner, by the secant method."""
        before, after = 0.4 * self.isd["image_lines"], 0.6 * self.isd["image_lines"]
        off, other = (self.seen(line, ground)[0] for line in (before, after))
        for _ in range(30):
            if abs(after - before) < 1e-9 or other == off:
                break
            before, after, off = after, after - other * (after - before) / (other - off), other
            other = self.seen(after, ground)[0]
        return after, self.seen(after, ground)[1]
