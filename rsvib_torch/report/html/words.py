"""Content of a report page, and its sentences and tables."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

from torch import Tensor

from rsvib_torch.detection import DetectionResult
from rsvib_torch.files.reading import Table
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, blind_frequencies, tone_head, tone_rows
from rsvib_torch.report.plots import motion_blur, tones_text
from rsvib_torch.restoration import RestorationVerdict
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason
from rsvib_torch.stacks import StackManifest
from rsvib_torch.text import measured_text

Mark = Literal["good", "doubt", "bad"]
_QUANTITIES = ("amplitude", "frequency", "period", "phase")

WINDOWS_RESTORED = (
    "Windows of the stack were restored before, see below; all frames together have no steady vibration that can be "
    "removed, and are unchanged on this page."
)
FOLLOWED = (
    "The vibration was followed from frame to frame, and removed, by rsvib run. The page shows two of its frames."
)


@dataclass(frozen=True, eq=False)
class Report:
    """Content of a report page."""

    title: str  # heading
    subtitle: str  # line below
    frames: Tensor  # (T, H, W) or (T, C, H, W) input frames, full scale 1
    # frames after restoration, or one frame restored jointly from all; on a finer grid with as many times the rows and
    # columns
    restored: Tensor
    was_restored: bool  # whether ``restored`` is restored, or the unchanged input
    timing: SensorTiming  # the sensor
    version: str  # version of the package
    # the detection (not a batch); None: the frames are those of a run that followed the vibration, with ``windows``
    detection: DetectionResult | None = None
    verdict: RestorationVerdict | None = None  # comparison of pairs of frames; None if they could not be compared
    left_alone: tuple[Reason, ...] = ()  # a reason for each axis that was not restored
    options: Table = field(default_factory=dict)  # options of ``restore``
    first: int = 0  # number of the first of the frames
    next_steps: tuple[str, ...] = ()  # what to do next: sentences, with the command that does it on a line of its own
    command: str | None = None  # the command line that wrote the page; None for a page written from Python
    windows: StackManifest | None = None  # windows of the stack that were processed separately; None if there are none
    created: datetime = field(default_factory=lambda: datetime.now().astimezone())  # time at which the page was made

    @property
    def num_rows(self) -> int:
        """Rows of a frame, along the scan axis."""
        return self.frames.shape[int(self.timing.scan_axis)]


def overall_result(report: Report, result: DetectionResult) -> tuple[Mark, str]:
    """Overall result, which selects the colour of the verdict, and its sentence."""
    if not report.was_restored and report.verdict is None:
        return "doubt", "No vibration was detected that can be removed; the frames are unchanged."
    if not report.was_restored:
        return "bad", "Restoration does not improve the frames; they are unchanged."
    outcome = "unknown" if report.verdict is None else report.verdict.overall
    if not bool(result.reliable.any()) or outcome == "worse":
        return "bad", "The detected vibration is not reliable; inspect the restored frames before you use them."
    if outcome == "unknown":
        what = "these frames are not sufficient to determine whether restoration helps"
        return "doubt", f"The vibration was measured; {what}."
    if bool(result.reliable.all()) and outcome == "helps":
        return "good", "The vibration of the camera was measured and removed; restoration improves the frames."
    return "doubt", "The vibration was measured and removed in part."


def verdict_sentences(report: Report, result: DetectionResult, removed: Vibration) -> list[str]:
    """The verdict: one sentence for the overall result, followed by the details.

    ``removed`` is the part of the detected vibration that was removed.
    """
    sentences = [overall_result(report, result)[1]]
    for axis, name in enumerate(AXIS_NAMES[: result.vibration.num_axes]):
        if bool(result.reliable[axis]):
            sentences.append(f"The vibration along {name} is {' and '.join(tones_text(result, axis)) or 'none'}.")
        else:
            why = "; ".join(str(reason) for reason in result.reasons[axis])
            sentences.append(f"The vibration along {name} is not reliable: {why}.")
        if axis < 2:
            speed, std = float(result.vibration.image_motion[axis]), float(result.std.image_motion[axis])
            if math.isfinite(std) and abs(speed) > max(4 * std, 1.0):  # px/s; significant, and not negligible
                text = measured_text(speed, std)
                sentences.append(f"Along {name} the image also moves uniformly, by {text} px/s.")
    removed = removed.translation()  # at the centre of the frame
    if bool(removed.moving_axes().any()):
        size = removed.amplitude.sum(-1)
        blur = motion_blur(removed, report.timing.row_starts(1, report.num_rows)[0], report.timing).amax(0)
        sentences.append(
            f"Rows are displaced by up to {float(size[0]):.2f} px along x and {float(size[1]):.2f} px along y, and "
            f"blurred by up to {float(blur[0]):.2f} px and {float(blur[1]):.2f} px during their exposure."
        )
    if bool(result.reliable.all()):  # otherwise the reasons are given above
        sentences += [_sentence(str(reason)) for reason in report.left_alone]
    if report.verdict is not None:
        sentences.append(_sentence(report.verdict.sentence))
    elif report.was_restored:
        sentences.append("No two frames have enough of the scene in common to judge the restoration.")
    return sentences


def about_rows(report: Report) -> list[list[str]]:
    """Lines of the table of the report itself: when and how it was made."""
    rows = {"created": report.created.isoformat(" ", "seconds"), "program": f"rsvib_torch {report.version}"}
    rows |= {"command": report.command or ""}
    if report.was_restored:
        rows |= {"restored with": ", ".join(f"{name} = {value}" for name, value in report.options.items())}
    return [[name, text] for name, text in rows.items() if text]


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def detected_tones(result: DetectionResult) -> tuple[tuple[str, ...], list[list[str]]]:
    """Heads of the columns, and lines, of the table of tones."""
    head = ("axis", *tone_head(_QUANTITIES, result.vibration.num_axes), "offset gain", "verdict")
    lines = [
        [*cells, f"{float(result.gain[at]):+.2f}", "reliable" if bool(result.reliable[at[0]]) else "not reliable"]
        for at, cells in tone_rows(result.vibration, result.std, _QUANTITIES, result.std_if_hidden_tone)
        if float(result.vibration.amplitude[at]) > 0
    ]
    return head, lines


def camera_rows(timing: SensorTiming, shape: Sequence[int]) -> list[list[str]]:
    """Lines of the table of the camera."""
    blind = ", ".join(f"{value:.1f}" for value in blind_frequencies(timing, 4.5 / timing.frame_period).tolist())
    uncertain = timing.row_time_std > 0
    return [
        ["shape of the stack", " x ".join(str(size) for size in shape)],
        ["row time", f"{1e6 * timing.row_time:g}{f' ± {1e6 * timing.row_time_std:.2g}' * uncertain} µs"],
        ["exposure time", f"{1e3 * timing.exposure_time:.4g} ms ({timing.exposure_rows:g} row times)"],
        ["frame period", f"{timing.frame_rows:g} row times ({timing.frame_rate:.2f} frames per second)"],
        ["scan axis", f"{'x' if timing.scan_axis == -1 else 'y'}, {timing.readout_direction}"],
        ["blind frequencies", f"{blind}, … Hz"],
    ]
