"""Image support data (ISD) of a vibrating frame for the Community Sensor Model plug-in usgscsm of the USGS.

Formulas of the plug-in (github.com/DOI-USGS/usgscsm), in the units of its ISD: focal plane in the unit of the focal
length, usually mm; the upper left pixel centre has line and sample 0.5. With the detector position
``line * line_summing + starting_line`` (sample likewise), the focal plane position d is the solution of
``focal2pixel . (1, d) = detector position - detector centre`` for lines and samples; without distortion it becomes u;
``(u_x, u_y, focal length)`` is the ray in axes of the sensor. Quaternions (w, x, y, z) of ``instrument_pointing``
rotate vectors from the reference frame to the sensor, those of ``body_rotation`` from it to the body.

* Frame camera with ``jitter``: before all this, ``line - sum_n a_n t^(N - n)`` takes the place of the line, n = 0 to
  N - 1, and the same with other coefficients for samples. t is the entry of ``lineExposureTimes`` of the line rounded
  to a whole number (of row i for lines from i + 0.5 to i + 1.5, rows counted from 0); from ground to image, the plug-in
  inverts this by fixed-point iteration. The polynomials have no constant term.
* Line scanner: the focal plane position is that of line 0 at all times; the line only determines the time,
  ``start + duration (line - first line + 0.5)`` after ``center_ephemeris_time`` by ``line_scan_rate``, at which the
  quaternions are interpolated (Lagrange, 8 points at equal distances).
"""

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, TypeAdapter
from scipy.spatial.transform import Rotation

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.validation import Count, Number, Positive, read_json, validated
from rsvib_torch.export.pixel_map import Size, num_rows_of
from rsvib_torch.files.atomic import check_outputs, whole_file
from rsvib_torch.files.reading import Table
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.field import displacement_at
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import IsdModel
from rsvib_torch.text import quoted

_FRAME, _LINE_SCAN = "USGS_ASTRO_FRAME_SENSOR_MODEL", "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
_MAX_DEGREE = 12  # 8e-7 px for 5 px and 0.8 periods per frame; rounding of float64 stays below 1e-8 px up to 14
_COLUMNS = 17  # columns at which the displacement is evaluated; it changes smoothly along a row
_PADDING = 4  # rows before and behind the frame, so that 8 quaternions surround every row
_FIXED_POINT_STEPS = 10  # the displacement changes by less than 5 % over a pixel: 1e-13 px

_Row = Annotated[list[Number], Field(min_length=3, max_length=3)]


@checks_arguments
def camera_isd(
    camera: Camera,
    size: Size,
    *,
    position: tuple[float, float, float],
    look: tuple[float, float, float],
    radii: tuple[Positive, Positive] = (6378.137, 6356.752),
    ephemeris_time: float = 0.0,
) -> Table:
    """Build the ISD of a still frame camera, for users who have none: ``write_isd`` adds the motion.

    The axes of the sensor are those of ``Camera`` (x to the right along samples, y down along lines, z along the
    optical axis), and the unit of the focal plane is the px. The reference frame is that of the body.

    Args:
        camera: Focal length and lens; distortion is written as ``radtan``, which recent versions of usgscsm read.
        size: (height, width) of the frames.
        position: Projection centre in km, in body-fixed axes.
        look: Direction of the optical axis in the same axes, of any length. The samples increase along
            ``look x (0, 0, 1)``: to the east for a camera that looks north or at the ground north of it; along
            (0, 1, 0) if it looks along the axis of the body.
        radii: Semi-major and semi-minor axis of the body in km; by default those of the Earth.
        ephemeris_time: Time of the middle of the frame in s.

    Returns:
        The ISD, which ``json.dump`` can write.

    Example:
        >>> isd = camera_isd(Camera(2e5), (1024, 1024), position=(6878.0, 0.0, 0.0), look=(-1.0, 0.0, 0.0))
        >>> isd["focal_length_model"], isd["detector_center"]
        ({'focal_length': 200000.0}, {'line': 512.0, 'sample': 512.0})
    """
    height, width = size
    forward = np.asarray(look, dtype=float)
    if not np.linalg.norm(forward) > 0:
        raise ValueError(f"look must be a direction, got {look}")
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = np.array([0.0, 1.0, 0.0]) if np.linalg.norm(right) < 1e-9 else right / np.linalg.norm(right)
    # rows: axes of the sensor in axes of the body
    pointing = Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward]))
    f = camera.focal_length
    if camera.fisheye:
        raise ValueError("an ISD has no fisheye lens: pass a camera with the coefficients (k1, k2, p1, p2, k3)")
    k1, k2, p1, p2, k3 = camera.distortion
    lens: Table = {"radial": {"coefficients": [0.0, 0.0, 0.0]}}
    if any(camera.distortion):  # usgscsm does not divide by the focal length
        lens = {"radtan": {"coefficients": [k1 / f**2, k2 / f**4, p1 / f, p2 / f, k3 / f**6]}}
    once = {"ephemeris_times": [ephemeris_time], "reference_frame": 1}
    centre = [0.5 * side + offset for side, offset in zip((width, height), camera.principal_point, strict=True)]
    return {
        "name_model": _FRAME,
        **dict.fromkeys(("name_platform", "name_sensor"), "unknown"),
        "image_lines": height,
        "image_samples": width,
        **dict.fromkeys(("center_ephemeris_time", "starting_ephemeris_time"), ephemeris_time),
        **dict.fromkeys(("detector_sample_summing", "detector_line_summing"), 1),
        **dict.fromkeys(("starting_detector_line", "starting_detector_sample"), 0),
        "focal2pixel_lines": [0.0, 0.0, 1.0],
        "focal2pixel_samples": [0.0, 1.0, 0.0],
        "focal_length_model": {"focal_length": f},
        "detector_center": {"line": centre[1], "sample": centre[0]},
        "interpolation_method": "lagrange",
        "optical_distortion": lens,
        "radii": {"semimajor": radii[0], "semiminor": radii[1], "unit": "km"},
        "reference_height": {"maxheight": 1000, "minheight": -1000, "unit": "m"},
        "instrument_position": {"unit": "km", "positions": [list(position)], "velocities": [[0.0] * 3], **once},
        "instrument_pointing": {"quaternions": [pointing.as_quat(scalar_first=True).tolist()], **once},
        "body_rotation": {"quaternions": [[1.0, 0.0, 0.0, 0.0]], **once},
        "sun_position": {"unit": "km", "positions": [[1.5e8, 0.0, 0.0]], "velocities": [[0.0] * 3], **once},
    }


@checks_arguments
def write_isd(
    path: str | os.PathLike[str],
    motion: Motion,
    timing: SensorTiming,
    isd: Mapping[str, Any] | str | os.PathLike[str],
    *,
    frame: Annotated[int, Field(ge=0)] = 0,
    model: IsdModel = "auto",
    tolerance: Positive = 0.005,
) -> Literal["frame", "line-scan"]:
    """Write the ISD of one frame of a vibrating camera, for the Community Sensor Model.

    The given ISD describes the camera at rest: without the motion, pixel and ray belong together as it states. The
    pixel at p of the frame, whose row is displaced by D (mean over its exposure), has the ray of the camera at rest at
    p - D. Two models are available:

    * ``"frame"``: the ISD with polynomials ``jitter`` for lines (the displacement along y) and samples (along x), of
      the lowest degree up to 12 that suffices. They hold for all columns, and the exposure times have a step at every
      line, so that this model is for slow motion without roll. ``lineExposureTimes`` are seconds since one readout
      duration before the exposure of the first row, since the polynomials are zero at time 0.
    * ``"line-scan"``: a line scanner with one quaternion per row. All rows have the rays of one line of the sensor,
      which a rotation takes to their place: a row at y px from the principal point is wider by the factor
      ``sqrt(1 + y^2 / f^2)``, so that this model is for narrow fields of view, and for rows read from top to bottom.
      The position is constant during the frame; uniform image motion is part of the quaternions.

    Args:
        path: The file to write; an existing file is replaced, but not that of ``isd``.
        motion: One motion, in image axes. A camera is not required; if it has one, its focal length must be that of
            the ISD.
        timing: The sensor, with image rows as rows.
        isd: The ISD of the camera as a mapping or JSON file, or that of ``camera_isd``. Fields that do not concern the
            motion are kept. Of several positions and quaternions, those nearest to ``center_ephemeris_time`` are used,
            which becomes the middle of the frame.
        frame: Number of the frame.
        model: ``"frame"``, ``"line-scan"``, or ``"auto"`` for the first of them that is accurate enough.
        tolerance: Largest error of a position in px, in both directions between image and ground.

    Returns:
        The model that was written.

    Raises:
        ValueError: If the motion is a batch, the ISD lacks a field or has another focal length, columns are exposed one
            after another, or no permitted model is accurate enough; the message states the errors and their reasons.

    Example:
        >>> import tempfile
        >>> from rsvib_torch import SensorTiming, Vibration
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> isd = camera_isd(Camera(2e6), (480, 480), position=(6878.0, 0.0, 0.0), look=(-1.0, 0.0, 0.0))
        >>> path = tempfile.mkdtemp() + "/frame.json"
        >>> write_isd(path, Vibration((0.4, 0.6), (30.0, 50.0)), timing, isd)
        'frame'
        >>> write_isd(path, Vibration((3.0, 5.0, 1e-3), (90.0, 130.0, 70.0)), timing, isd)
        'line-scan'
        >>> len(json.loads(Path(path).read_text())["instrument_pointing"]["quaternions"])  # 480 rows and 4 around them
        488
    """
    if timing.scan_axis != -2:
        raise ValueError(
            "scan_axis must be -2: the lines of these sensor models are image rows, one exposure time each; transpose "
            "the frames, the camera and the ISD"
        )
    if isinstance(isd, Mapping):
        camera = _Camera(dict(isd), "isd")
    else:
        check_outputs([path], [isd])
        camera = _Camera(read_json(Path(isd), "ISD"), str(isd))
    lines, displacement = _displacements(motion, timing, camera.size, frame)
    if motion.camera is not None:
        same = motion.with_camera(replace(motion.camera, focal_length=camera.focal_length_px))
        wrong = float(np.abs(_displacements(same, timing, camera.size, frame)[1] - displacement).max())
        if wrong > tolerance:
            raise ValueError(
                f"the motion has a camera with focal_length={motion.camera.focal_length:g} px, {camera.source} one "
                f"with {camera.focal_length_px:g} px, which displaces pixels differently by {wrong:.2g} px; use one of "
                "them: motion.with_camera(...)"
            )
    reasons = []
    models: dict[Literal["frame", "line-scan"], Any] = {"frame": _with_jitter, "line-scan": _as_line_scan}
    for name, build in models.items():
        found, reason = build(camera, lines, displacement, timing, tolerance) if model in ("auto", name) else (None, "")
        if found is not None:
            with whole_file(path) as part:
                part.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", encoding="utf-8")
            return name
        reasons += [reason] * bool(reason)
    raise ValueError(
        f"no sensor model represents this motion within {tolerance:g} px ({'; '.join(reasons)}); pass a larger "
        "tolerance, or export the exact positions with write_stmap"
    )


def _displacements(motion: Motion, timing: SensorTiming, size: tuple[int, int], frame: int) -> tuple[Array, Array]:
    """Mid-exposure times (R,) of image rows in s since the readout began, and displacements (R, C, 2) in px at columns.

    Rows beyond the frame, ``_PADDING`` on each side, are included; columns are spread over the width.
    """
    rows = num_rows_of(motion, timing, size)
    line = torch.arange(-_PADDING, rows + _PADDING, dtype=torch.float64, device=motion.device)
    row = rows - 1 - line if timing.readout_direction == "reverse" else line
    starts = timing.frame_starts(frame + 1, motion.device)[frame] + row * timing.row_time
    components = motion.mean_displacement(starts, timing.exposure_time)[:, None]
    x = torch.linspace(-0.5, 0.5, _COLUMNS, dtype=torch.float64, device=motion.device) * (size[1] - 1)
    y = (line - 0.5 * (rows - 1))[:, None]
    moved = torch.zeros(len(line), _COLUMNS, 2, dtype=torch.float64, device=motion.device)
    for _ in range(_FIXED_POINT_STEPS):  # D belongs to the position at rest, p - D
        moved = displacement_at(components, x - moved[..., 0], y - moved[..., 1], motion.camera).expand_as(moved)
    return (row * timing.row_time + 0.5 * timing.exposure_time).cpu().numpy(), moved.detach().cpu().numpy()


class _Camera:
    """The fields of an ISD of a camera at rest, and its rays."""

    def __init__(self, isd: Table, source: str) -> None:
        self.isd, self.source = isd, source
        self.size: tuple[int, int] = (self.value(Count, "image_lines"), self.value(Count, "image_samples"))
        self.focal_length = self.value(Number, "focal_length_model", "focal_length")
        matrix = np.array([self.value(_Row, f"focal2pixel_{name}") for name in ("lines", "samples")])
        self.offset, self.matrix = matrix[:, 0], matrix[:, 1:]
        if abs(np.linalg.det(self.matrix)) < 1e-12 * np.abs(self.matrix).max() ** 2 or not self.focal_length > 0:
            problem = "focal2pixel_lines and focal2pixel_samples must be independent, and focal_length positive"
            raise ValueError(f"{source}: {problem}")
        self.summing = np.array([self.value(Number, f"detector_{n}_summing") for n in ("line", "sample")])
        self.start = np.array([self.value(Number, f"starting_detector_{n}") for n in ("line", "sample")])
        self.centre = np.array([self.value(Number, "detector_center", n) for n in ("line", "sample")])
        if self.isd.get("name_model") == _LINE_SCAN:  # the line of the scanner lies anywhere in its focal plane
            self.start[0], self.centre[0] = 0.0, 0.5 * self.size[0] * self.summing[0]
        lens = self.value(Mapping[str, Any], "optical_distortion")
        self.lens, coefficients = next(iter(lens.items())) if len(lens) == 1 else ("", {})
        self.distortion = coefficients.get("coefficients") if isinstance(coefficients, dict) else None

    @property
    def focal_length_px(self) -> float:
        """Focal length in px of the image, the geometric mean of both directions."""
        scale = abs(np.linalg.det(self.matrix)) / abs(np.prod(self.summing))
        return float(self.focal_length * np.sqrt(scale))

    def value(self, kind: Any, *names: str) -> Any:
        """The value at a key, if it is of a kind."""
        value: Any = self.isd
        for name in names:
            if not isinstance(value, Mapping) or name not in value:
                raise ValueError(f"{self.source}: {'.'.join(names)}: missing key of an ISD; camera_isd builds one")
            value = value[name]
        return validated(f"{self.source}: {'.'.join(names)}", value, TypeAdapter(kind, config={"strict": True}), kind)

    def state(self, name: str, values: str, count: int) -> Array:
        """The entry (count,) of a table of states nearest to the middle of the frame."""
        table, centre = self.value(Mapping[str, Any], name), self.value(Number, "center_ephemeris_time")
        try:
            states = np.array(table[values], dtype=float).reshape(-1, count)
            times = np.array(table.get("ephemeris_times", [0.0]), dtype=float)
            state: Array = states[np.argmin(np.abs(times - centre)) if len(times) == len(states) else 0]
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ValueError(f"{self.source}: {name}.{values}: expected a list of {count} numbers each") from error
        if not np.isfinite(state).all():
            raise ValueError(f"{self.source}: {name}.{values} must be finite")
        return state

    def rays(self, lines: Array, samples: Array) -> Array:
        """Rays (S, 3) of the camera at rest in axes of the sensor, for image positions S."""
        image = np.stack(np.broadcast_arrays(lines, samples), -1)
        plane = (image * self.summing + self.start - self.centre - self.offset) @ np.linalg.inv(self.matrix).T
        plane = self._undistorted(plane)
        return np.concatenate([plane, np.full_like(plane[..., :1], self.focal_length)], -1)

    def _undistorted(self, plane: Array) -> Array:
        count = {"radial": 3, "radtan": 5}.get(self.lens)
        if count is None or not isinstance(self.distortion, list) or len(self.distortion) != count:
            raise ValueError(
                f"{self.source}: optical_distortion {quoted(self.lens)} is not supported for a line scanner, only "
                "radial with three and radtan with five coefficients; model='frame' keeps it as it is"
            )
        if not any(self.distortion):
            return plane
        if self.lens == "radtan":  # OpenCV's formula in the unit of the focal plane
            lens = Camera(1.0, distortion=tuple(self.distortion))
            return torch.stack(lens.rays(*torch.from_numpy(plane).unbind(-1)), -1).numpy()
        squared = (plane**2).sum(-1, keepdims=True)
        k0, k1, k2 = self.distortion
        undistorted: Array = plane * (1 - (k0 + squared * (k1 + squared * k2)))
        return undistorted

    def pixels(self, rays: Array) -> Array:
        """Undistorted image positions (S, 2) of rays in px, from the optical axis."""
        image: Array = self.focal_length * rays[..., :2] / rays[..., 2:] @ self.matrix.T / self.summing
        return image


def _with_jitter(
    camera: _Camera, times: Array, displacement: Array, timing: SensorTiming, tolerance: float
) -> tuple[Table | None, str]:
    """The ISD with jitter polynomials, None if they are not accurate enough, and their error."""
    times, displacement = times[_PADDING:-_PADDING], displacement[_PADDING:-_PADDING]
    low, high = displacement.min(1), displacement.max(1)
    rows, target = len(times), 0.5 * (low + high)
    columns = 0.5 * float((high - low).max())  # error of one value for all columns
    step = float(np.abs(np.diff(target, axis=0)).max()) if rows > 1 else 0.0
    shown = times - 0.5 * timing.exposure_time + rows * timing.row_time
    power, rest = np.zeros((1, 2)), np.inf
    for degree in range(1, min(_MAX_DEGREE, rows) + 1):
        # the time times a Chebyshev series, which is zero at time 0, as powers of the time from the highest on
        fitted = [np.polynomial.Chebyshev.fit(shown, values / shown, degree - 1) for values in target.T]
        powers = (series.convert(kind=np.polynomial.Polynomial).coef[::-1] for series in fitted)
        power = np.stack([np.pad(values, (degree - len(values), 0)) for values in powers], -1)
        value = (shown[:, None] ** np.arange(degree, 0, -1)) @ power
        rest = float(np.maximum(np.abs(value - low), np.abs(value - high)).max())
        if rest - columns <= 0.1 * tolerance:
            break
    reason = (
        f"frame: {rest + step:.2g} px, of which {columns:.2g} px because columns are displaced differently, "
        f"{step:.2g} px by the step of the exposure time at each line, and {max(rest - columns, 0.0):.2g} px by "
        f"polynomials of degree {len(power)}"
    )
    if rest + step > tolerance:
        return None, reason
    found = dict(camera.isd)
    found["jitter"] = {
        "lineJitterCoefficients": power[:, 1].tolist(),
        "sampleJitterCoefficients": power[:, 0].tolist(),
        "lineExposureTimes": shown.tolist(),
    }
    return found, reason


def _as_line_scan(
    camera: _Camera, _: Array, displacement: Array, timing: SensorTiming, tolerance: float
) -> tuple[Table | None, str]:
    """The ISD of a line scanner with one quaternion per row, None if it is not accurate enough, and its error."""
    if timing.readout_direction == "reverse":
        return None, "line-scan: rows are read from bottom to top"
    rows = len(displacement)
    line = np.arange(rows)[:, None] - _PADDING + 0.5
    sample = np.linspace(0.5, camera.size[1] - 0.5, _COLUMNS)
    seen = camera.rays(line - displacement[..., 1], sample - displacement[..., 0])  # (rows, columns, 3)
    # the line of the scanner: through the optical axis
    axis = (camera.centre[0] + camera.offset[0] - camera.start[0]) / camera.summing[0]
    scanned = camera.rays(np.full_like(sample, axis), sample)  # (columns, 3)
    scanned, seen = (rays / np.linalg.norm(rays, axis=-1, keepdims=True) for rays in (scanned, seen))
    turned = Rotation.concatenate([Rotation.align_vectors(rays, scanned)[0] for rays in seen])
    pixels = camera.pixels(np.einsum("rij,cj->rci", turned.as_matrix(), scanned)) - camera.pixels(seen)
    error = float(np.abs(pixels[_PADDING:-_PADDING]).max())
    reason = f"line-scan: {error:.2g} px, since no rotation takes the line of the scanner to all pixels of a row"
    if error > tolerance:
        return None, reason
    still = Rotation.from_quat(camera.state("instrument_pointing", "quaternions", 4), scalar_first=True)
    if "constant_rotation" in camera.isd["instrument_pointing"]:
        still = Rotation.from_matrix(camera.state("instrument_pointing", "constant_rotation", 9).reshape(3, 3)) * still
    # a ray e of row r has the direction still^-1 turned e in the reference frame, and pointing^-1 e in the file
    pointing = (turned.inv() * still).as_quat(scalar_first=True)
    same_side = np.sign((pointing[1:] * pointing[:-1]).sum(1))
    pointing[1:] *= np.cumprod(same_side)[:, None]  # continuous: q and -q are the same rotation
    centre = camera.value(Number, "center_ephemeris_time")
    # whole multiples of the resolution of float64 at these times: equal distances for the interpolation
    resolution = np.spacing(max(abs(centre), 1e-3))
    duration = max(round(timing.row_time / resolution), 1) * resolution
    first = centre - round(0.5 * (rows - 1) * duration / resolution) * resolution
    times = first + duration * np.arange(rows)
    found = {name: value for name, value in camera.isd.items() if name != "jitter"}
    body = camera.state("body_rotation", "quaternions", 4)
    position = camera.state("instrument_position", "positions", 3)
    velocity = camera.state("instrument_position", "velocities", 3)
    sun, sun_velocity = (camera.state("sun_position", name, 3) for name in ("positions", "velocities"))
    if np.linalg.norm(np.cross(position, velocity)) == 0:  # usgscsm divides by it; the direction is not used
        velocity = np.cross(position, np.eye(3)[np.argmin(np.abs(position))]) * 1e-9

    def states(name: str, times: Array, **values: Array) -> Table:
        """A table of states with new values; what describes the old ones is left out."""
        kept = {key: value for key, value in camera.isd[name].items() if key in ("unit", "reference_frame")}
        new = {key: np.broadcast_to(value, (len(times), value.shape[-1])).tolist() for key, value in values.items()}
        return kept | new | {"ephemeris_times": times.tolist()}

    found |= dict.fromkeys(("t0_ephemeris", "t0_quaternion"), float(first - centre))
    found |= dict.fromkeys(("dt_ephemeris", "dt_quaternion"), float(duration))
    found |= {
        "name_model": _LINE_SCAN,
        "starting_ephemeris_time": float(times[_PADDING] - 0.5 * duration),
        "line_scan_rate": [[0.5, float(times[_PADDING] - centre - 0.5 * duration), float(duration)]],
        "starting_detector_line": 0,
        "detector_center": {"line": float(-camera.offset[0]), "sample": float(camera.centre[1])},
        "instrument_pointing": states("instrument_pointing", times, quaternions=pointing),
        "body_rotation": states("body_rotation", times, quaternions=body),
        "instrument_position": states("instrument_position", times, positions=position, velocities=velocity),
        "sun_position": states("sun_position", times[[0, -1]], positions=sun, velocities=sun_velocity),
    }
    return found, reason
