"""``manifest.json``: the input, settings and versions of a run, and the result of every window."""

import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from statistics import median, stdev

import numpy as np

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import fields_of
from rsvib_torch.files.reading import Table
from rsvib_torch.frames.prepare import text_of_lost_rows
from rsvib_torch.io.stack_info import split_range
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import StackOptions
from rsvib_torch.results.presentation import (
    AXIS_NAMES,
    Result,
    decode,
    joined_columns,
    plain_values,
)
from rsvib_torch.stacks.job import StackJob
from rsvib_torch.stacks.windows import WindowRecord
from rsvib_torch.text import measured_text, number_of, text_table, wrapped


def rms_shaking(parts: Iterable[dict[str, tuple[float, ...]] | None]) -> dict[str, tuple[float, ...]]:
    """Rms of ``WindowRecord.shaking`` over the parts of a video; empty if it was measured in none of them."""
    measured = [part for part in parts if part is not None]
    names = measured[0] if measured else ()
    return {name: tuple(np.sqrt(np.square([part[name] for part in measured]).mean(0)).tolist()) for name in names}


_UNITS = {
    "start_time": "s, of the first row of the first frame of a window, the time origin of its detection",
    "amplitude": "px",
    "frequency": "Hz",
    "period": "s",
    "phase": "rad at start_time",
    "image_motion": "px/s",
    "image_acceleration": "px/s^2",
    "residual": "px",
}


@dataclass(frozen=True, eq=False, repr=False)
class StackManifest(Result, file_format="rsvib stack", units=_UNITS):
    """Content of ``manifest.json``."""

    input: Table  # name, size and hash of the stack
    settings: Table  # sensor and options
    versions: Table  # of the packages that computed it
    output: str  # name of the output
    windows: tuple[WindowRecord, ...]
    not_kept: tuple[str, ...] = ()  # metadata of the input that the output does not contain
    margins: dict[str, int] | None = None  # px that were cut off the sides of the frames of a video
    # of a video with the path of a gyroscope: its axes, clock and bias (rad/s), and the focal length (px)
    gyroscope: Table | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for number, record in enumerate(self.windows):
            if record.window != number:
                raise ValueError(f"windows[{number}].window: expected {number}, got {record.window}")

    @cached_property
    def timing(self) -> SensorTiming:
        """The sensor."""
        return decode(SensorTiming, self.settings.get("sensor"), "settings.sensor")

    def summary(self) -> str:
        """Tones over the windows, what was restored, and what failed."""
        restored = sum(record.frames == "restored" for record in self.windows)
        vibration, restoration = self.lines()
        return "\n".join([*vibration, f"{restored} of {number_of(len(self.windows), 'window')} restored", *restoration])

    def table(self, *, pixel_size: float | None = None) -> dict[str, list[object]]:
        """One row per tone, axis and window, as in ``DetectedVibration.table``; a failed window has one row.

        Phases refer to ``start_s``, the exposure start of the first row of the window.
        """
        lines, half_frame = [], self.timing.time_to_middle(self.input["shape"][self.timing.scan_axis])
        starts = self.timing.frame_starts(self.windows[-1].last + 1).tolist()
        for record in self.windows:
            middle = 0.5 * (starts[record.first] + starts[record.last]) + half_frame  # of its frames
            first: Table = {"window": record.window, "first_frame": record.first, "last_frame": record.last}
            first |= {"start_s": record.start_time, "middle_time_s": middle}
            last: Table = {"equivalent": record.motion is not None, "frames": record.frames, "outcome": record.outcome}
            last["bad_frames"] = len(record.bad_frames)
            last["note"] = record.error or "; ".join(map(str, record.left_alone))
            tones = [{}] if record.detection is None else record.detection.tone_lines(pixel_size)
            lines += [{**first, **tone, **last} for tone in tones]
        return joined_columns(lines)

    @property
    def bad_frames(self) -> dict[str, str]:
        """Index of each frame that could not be used, with the reason."""
        return {index: reason for record in self.windows for index, reason in record.bad_frames.items()}

    @property
    def shaking(self) -> dict[str, tuple[float, ...]] | None:
        """``rms_shaking`` of a video; None of a stack that was processed in windows."""
        return rms_shaking(record.shaking for record in self.windows) or None

    def totals(self) -> Table:
        """Summary of the windows of a stack: numbers of windows, gain, tones of each axis, and axes left unchanged.

        Tones are medians over the reliable windows, with the standard deviation over the windows.
        """
        windows, detections = self.windows, [record.detection for record in self.windows]
        gains = [record.predicted_gain for record in windows if record.predicted_gain is not None]
        names = AXIS_NAMES[: max((one.vibration.num_axes for one in detections if one is not None), default=2)]
        unchanged = [(reason.axis, record.window, reason) for record in windows for reason in record.left_alone]
        return {
            "windows": len(windows),
            "restored": sum(record.frames == "restored" for record in windows),
            "outcomes": dict(Counter(record.outcome for record in windows if record.outcome is not None)),
            "predicted_gain_db": {"lowest": min(gains), "highest": max(gains)} if gains else None,
            "tones": {name: _tones_over_windows(detections, axis) for axis, name in enumerate(names)},
            "left_alone": {
                name: {str(window): reason.to_dict() for axis, window, reason in unchanged if axis == name}
                for name in names
            },
            "errors": {str(record.window): record.error for record in windows if record.error is not None},
            "bad_frames": self.bad_frames,
        }

    def lines(self) -> tuple[list[str], list[str]]:
        """The windows in lines of text: their vibration, and how well and where it was removed."""
        data, records = self.totals(), self.windows
        # 1. The vibration: the detection of the only window, or its tones over the windows.
        is_video = "video" in self.settings  # a hand may move its camera
        only_detection = records[0].detection if len(records) == 1 and not self.is_removed else None
        # all windows were measured, and nothing else than missing tones is stated against any axis
        is_still = not is_video and all(
            record.detection is not None
            and {reason.code for of_axis in record.detection.findings for reason in of_axis} == {"no_tone"}
            for record in records
        )
        if only_detection is not None:
            vibration = [only_detection.summary()]
        elif is_still:
            text = "the camera stands still, or moves uniformly or by less than the noise"
            vibration = [wrapped(f"no window has a significant tone: {text}")]
        else:
            vibration = self._tone_lines(data["tones"]) if self.gyroscope is None else _gyroscope_lines(self.gyroscope)
        vibration += self._lines_of_video() if is_video else []
        # 2. Its removal: the gain, windows and axes that were left unchanged, and what was lost.
        restoration = []
        if data["predicted_gain_db"] is not None:
            gains = dict.fromkeys(f"{gain:+.1f}" for gain in data["predicted_gain_db"].values())
            restoration.append(f"estimated improvement {' … '.join(gains)} dB")
        restoration += self.doubts
        for name, notes in data["left_alone"].items() if only_detection is not None or not is_still else ():
            why = {window: note["text"] for window, note in notes.items()}
            if only_detection is not None and any(note["code"] == "axis_not_reliable" for note in notes.values()):
                why = dict.fromkeys(notes, "its vibration is not reliable, see the reasons above")
            restoration += self._noted(f"{name} unchanged", why)
        for (before, after), where in zip(
            (self.shaking or {}).values(), ("from frame to frame", "between the rows of a frame"), strict=False
        ):
            restoration.append(f"shaking {where}: {before:.2g} px rms, {after:.2g} px afterwards")
        return vibration, restoration + self.losses

    def _noted(self, what: str, notes: Mapping[int, str] | Mapping[str, str]) -> list[str]:
        """A line about the windows that have a note, with the first note; none without notes."""
        several = number_of(len(notes), "window")
        return [
            wrapped(f"{what}: {text}" if len(self.windows) == 1 else f"{what} in {several}; in window {window}: {text}")
            for window, text in notes.items()
        ][:1]

    @property
    def doubts(self) -> list[str]:
        """A sentence about the windows whose restoration is not known to help."""
        texts = {one.window: one.verdict for one in self.windows if one.verdict is not None and one.outcome != "helps"}
        return self._noted("improvement not certain", texts)

    def _tone_lines(self, tones: Table) -> list[str]:
        """A table of the tones of each axis over the windows, and what its columns mean."""
        rows, count = [], len(self.windows)
        for axis, of_axis in tones.items():
            for tone in of_axis["tones"]:
                quantities = ((tone[name], tone[f"{name}_spread"] or None) for name in ("amplitude", "frequency"))
                rows.append([axis, f"{tone['windows']} of {count}", *(measured_text(*one) for one in quantities)])
            rows += [] if of_axis["tones"] else [[axis, f"0 of {count}", "", ""]]
        lines = [text_table(["axis", "reliable windows", "amplitude (px)", "frequency (Hz)"], rows)]
        if any(of_axis["tones"] for of_axis in tones.values()):
            lines.append("median ± standard deviation over the windows")
        changing = sum(record.motion is not None for record in self.windows)
        if changing:
            which = "all" if changing == count else f"{changing} of {count}"
            measured = f"no steady tones explain {which} windows, whose motion was therefore measured without tones"
            lines.append(wrapped(f"{measured}; amplitudes are those of a tone of the same rms displacement"))
        return lines

    @property
    def losses(self) -> list[str]:
        """Sentences about frames and rows that were lost."""
        lines, lost = [], [f"{one.lost_before} (window {one.window})" for one in self.windows if one.lost_before]
        if lost:
            text = "of their windows are taken a frame period later; state the times of all frames if they are known"
            lines.append(wrapped(f"a frame is lost before frame {', '.join(lost)}: the later frames {text}"))
        if rows := {int(index): count for one in self.windows for index, count in one.lost_rows.items()}:
            lines.append(wrapped(text_of_lost_rows(rows)))
        return lines

    def _lines_of_video(self) -> list[str]:
        """Axes of a video that were restored although they are not reliable, and the first assumption."""
        detections = [(record.window, record.detection) for record in self.windows if record.detection is not None]
        lines = []
        for axis, name in enumerate(AXIS_NAMES[:2]):
            against = {window: [one for one in of.findings[axis] if one.code != "no_tone"] for window, of in detections}
            why = {window: "; ".join(map(str, of_axis)) for window, of_axis in against.items() if of_axis}
            lines += self._noted(f"{name} restored as measured, but not reliable", why)
        return lines + [wrapped(f"assumed: {one}") for _, of in detections for one in of.assumptions][:1]

    @property
    def is_removed(self) -> bool:
        """Whether another motion than a steady vibration was removed: that of a video, or one that changes."""
        return "video" in self.settings or any(record.motion is not None for record in self.windows)

    def detections(self) -> list[DetectedVibration | FreeMotion | None]:
        """The detection of every window, or its motion if the vibration changes; None where it failed.

        They are the ``given`` of ``process_stack``, which takes frames at their stated times: None also after a lost
        frame.
        """
        return [
            None if one.lost_before is not None else one.detection if one.motion is None else one.motion
            for one in self.windows
        ]


def _gyroscope_lines(alignment: Table) -> list[str]:
    """Axes, clock and focal length by the gyroscope of a video."""
    axes = ", ".join(letter.lower() if letter.isupper() else f"-{letter}" for letter in alignment["orientation"])
    return [
        f"rotation by the gyroscope, whose axes {axes} are x, y, z of the camera",
        f"time 0 of the frames is {measured_text(alignment['offset'], alignment['offset_std'])} s of the gyroscope",
        f"focal length {measured_text(alignment['focal_length'], alignment['focal_length_std'])} px",
    ]


_SAME_TONE = 0.03  # of the frequency, or 4 std: a tone of the next window closer than this is the same one


def _tones_over_windows(detected: Sequence[DetectedVibration | None], axis: int) -> Table:
    """Number of windows in which an axis is reliable, and median and spread of its tones over them, strongest first.

    The tones of a window, the strongest first, continue those of nearly the same frequency in the windows before.
    """
    reliable = [one for one in detected if one is not None and axis < one.vibration.num_axes and one.reliable[axis]]
    tones: list[list[tuple[float, float]]] = []  # (amplitude, frequency) in the windows of each tone
    for one in reliable:
        columns = (one.vibration.amplitude, one.vibration.frequency, one.std.frequency)
        earlier = list(tones)
        for amplitude, frequency, std in zip(*(values[axis].tolist() for values in columns), strict=True):
            distances = [abs(frequency - tone[-1][1]) for tone in earlier]
            if amplitude > 0 and distances and min(distances) <= max(_SAME_TONE * frequency, 4 * std):
                earlier.pop(distances.index(min(distances))).append((amplitude, frequency))
            elif amplitude > 0:
                tones.append([(amplitude, frequency)])
    described: list[Table] = []
    for tone in tones:
        described.append({"windows": len(tone)})
        for name, values in zip(("amplitude", "frequency"), zip(*tone, strict=True), strict=True):
            described[-1] |= {name: median(values), f"{name}_spread": stdev(values) if len(values) > 1 else None}
    return {"reliable_windows": len(reliable), "tones": sorted(described, key=lambda tone: -tone["amplitude"])}


def fingerprint(path: Path) -> Table:
    """Name, size and hash of a file or folder.

    The hash covers the names and sizes of all files, and about 32 evenly spaced blocks of 64 KiB of about 32 of them:
    files of up to 2 MiB completely.
    """
    name, (path, _) = path.name, split_range(path)
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    sizes = [file.stat().st_size for file in files]
    digest, block = hashlib.sha256(), 1 << 16
    for number, (file, size) in enumerate(zip(files, sizes, strict=True)):
        digest.update(os.fsencode(file.relative_to(path.parent)) + f"\0{size}\0".encode())
        if number % -(-len(files) // 32) == 0:
            with file.open("rb") as opened:
                for begin in range(0, size, max(block, size // 32)):
                    opened.seek(begin)
                    digest.update(opened.read(block))
    return {"name": name, "bytes": sum(sizes), "sha256_of_samples": digest.hexdigest()}


# options on which the result depends
_SETTINGS = tuple(name for name in fields_of(StackOptions) if name not in ("memory", "workers", "given", "motion"))


def manifest_header(job: StackJob, output: str) -> Table:
    """Everything on which the result depends, for JSON: a run is resumed only if it is unchanged."""
    digest = None
    if job.given is not None:
        plain = [DetectedVibration.of(one) if isinstance(one, DetectedVibration) else one for one in job.given]
        digest = hashlib.sha256(json.dumps(plain_values(plain)).encode()).hexdigest()
    options = {name: getattr(job.options, name) for name in _SETTINGS}
    options["device"] = job.options.device.partition(":")[0]
    return {
        "input": {**fingerprint(job.source), "shape": list(job.info.shape), "dtype": job.info.dtype},
        "settings": {"sensor": job.timing.to_dict(), "given": digest, **options},
        "versions": {name: version(name) for name in ("rsvib_torch", "torch", "numpy")},
        "output": output,
    }


@checks_arguments
def read_manifest(path: str | os.PathLike[str]) -> StackManifest:
    """Read the manifest of a complete run.

    Args:
        path: The ``manifest.json``.

    Raises:
        ValueError: If it is not a complete manifest.

    Example:
        >>> manifest = read_manifest("restored.tif.manifest.json")  # doctest: +SKIP
        >>> manifest.detections()[0].vibration.frequency[:, 0].tolist()  # Hz, first window  # doctest: +SKIP
        [110.0, 90.0]
    """
    return StackManifest.load(path)
