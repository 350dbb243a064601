"""``rsvib run``: a stack in windows, or a video from frame to frame."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rsvib_torch
from rsvib_torch import detection, io, stacks, video
from rsvib_torch import frames as preparation
from rsvib_torch import report as reports
from rsvib_torch.checks.values import fields_of, options
from rsvib_torch.commands import answers
from rsvib_torch.commands.flat_command import Given, argument, option
from rsvib_torch.commands.shared_options import TIME, PixelSizeOptions, RestoringCommand, VerdictOptions
from rsvib_torch.commands.terminal import Answer, current_output, warn, working
from rsvib_torch.files.atomic import whole
from rsvib_torch.files.reading import Table
from rsvib_torch.options import ProcessVideoOptions, StackOptions, WindowOptions
from rsvib_torch.text import printable

if TYPE_CHECKING:
    from rsvib_torch.motion.detected_vibration import DetectedVibration

_RESULTS = (*answers.OF_DETECTION, *answers.OF_WINDOWS, "before_after.png", "report.html")


@options
class RunCommand(RestoringCommand, PixelSizeOptions, VerdictOptions):
    """Options of ``run``."""

    out: Path = argument()
    """Folder for the restored frames, the vibration and the figures."""
    output: str | None = option(None, show_default="restored.tif, or a video")
    """Name of the restored stack in that folder; its extension selects the format, e.g. .mp4 or .mkv for a video with
    the time stamps and the sound of the input. restored/ is a folder with a file for each frame: from a folder of TIFF
    files, TIFF files of the same names and georeference."""
    video: bool = False
    """Write a video: restored.mp4 (H.264) from .mp4, restored.mov from .mov, else restored.mkv (FFV1, without loss).
    Videos of more than 8 frames are followed frame by frame instead of in windows."""
    report: bool = False
    """Write report.html as well: a page with all figures, of the first window."""
    steadying: Annotated[
        Table,
        Given(
            ProcessVideoOptions,
            ("border", "steady", "crop_limit", "gyroscope", "lens_profile"),
            context="With --video, ",
            forms={
                "steady": {**TIME, "metavar": "SECONDS", "show_default": "the image stays where it is"},
                "gyroscope": {"metavar": "FILE"},
                "lens_profile": {"metavar": "FILE"},
            },
        ),
    ]

    @cached_property
    def restored(self) -> Path:
        """The restored stack."""
        if self.steadying and not self.video:
            raise ValueError(f"--{next(iter(self.steadying)).replace('_', '-')} goes with --video")
        ending = io.split_range(self.frames)[0].suffix.lower()
        usual = f"restored{ending if ending in io.H264 else '.mkv'}" if self.video else "restored.tif"
        output = (self.output or usual).removesuffix("/")
        if self.video and not output.lower().endswith((*io.H264, ".mkv")):
            raise ValueError(f"--video writes .mp4, .mov, .m4v or .mkv, got --output {output}")
        if Path(output).name != output or output in ("", ".", ".."):
            raise ValueError(f"--output must be a file name without a folder, got {output!r}")
        return self.out / output

    @property
    def is_followed(self) -> bool:
        """Whether frames are followed one by one: those to be moved, and videos of more frames than a usual window."""
        is_long_video = self.video and io.is_video(self.frames) and self.info.shape[0] > WindowOptions().window
        return bool(self.steadying) or is_long_video


def run(command: RunCommand) -> Answer:
    """Detect the vibration, restore the frames, judge the result.

    Figures and, with --report, a page show both. Stacks of any length are processed in windows. If the restored frames
    are judged no better than the input, the input is written unchanged, unless --force is given. Ctrl-C stops after the
    current windows; --resume continues. With --video, the vibration of a video is followed frame by frame: --steady 1
    --border crop makes a shaky video steady.
    """
    settings, out, restored = command.settings, command.out, command.restored  # a mistake in settings needs no torch
    answers.check_folder(out, _RESULTS, command.replaces, command.inputs, restored)
    if command.is_followed and (command.force or "window" in command.processing):
        raise ValueError(f"--{'force' if command.force else 'window'} has no effect on frames that --video follows")
    if command.is_followed and settings.detection:
        warn(f"{command.config}: [detection] has no effect on frames that --video follows")
    current_output().work = stacks.work_folder(restored)
    command.print_notes()
    # 1. The restored frames and their manifest.
    of_run = command.steadying if command.is_followed else {"detection": settings.detection}
    result = command.process(restored, of_run | {"manifest": out / "manifest.json"}, followed=command.is_followed)
    stored = stacks.read_manifest(result.manifest)
    # 2. Tables and figures of one vibration of all frames, or of the windows; the page.
    page = _page(command, stored, result.detection or _first_detection(command, stored))
    detected = page.detection if page.windows is None else None
    answer = _answer(command, detected, stored)
    answer.results["Restoration"] = answers.restoration_lines(result, stored)
    with whole(out, "folder") as folder:
        names = [restored.name] if command.is_followed else []
        if len(page.frames):
            with working("drawing the frames"):
                reports.save_figure(reports.frames_figure(page), folder / "before_after.png")
            names.append("before_after.png")
        names += [*([] if command.is_followed else [restored.name]), "manifest.json"]
        if detected is not None:
            names += answers.write_detection(folder, detected, page.timing, command.pixel_size)
        else:
            names += answers.write_windows(folder, stored, command.pixel_size)
        if command.report:
            pages = _write_page(folder, page, stored, answer)
            answers.check_folder(out, pages, overwrite=True, inputs=command.inputs)
            names = list(dict.fromkeys(pages + names))  # the page shows other figures as well
        elif result.restored:
            typed = (current_output().command or "").replace(" --resume", "")
            answer.next_steps.insert(0, f"write a page with all figures:\n  {typed} --resume --report")
    if command.overwrite:
        answers.remove_old(out, _RESULTS, names)
    answer.files += [out / name for name in names]
    return answer


def _first_detection(command: RunCommand, stored: stacks.StackManifest) -> DetectedVibration | None:
    """The detection in the first window of a run that was complete before, if it is shown."""
    if stored.is_removed or stored.windows[0].detection is None or not (command.report or len(stored.windows) == 1):
        return None
    of_run = command.of_stack | {"detection": command.settings.detection}
    of_run |= {"window": command.window, "force": command.force}
    of_windows = {name: value for name, value in of_run.items() if name in fields_of(StackOptions)}
    return stacks.first_detection(command.frames, command.settings.timing, StackOptions(**of_windows))


def _page(command: RunCommand, stored: stacks.StackManifest, first: DetectedVibration | None) -> reports.Report:
    """The page of a run: usable frames of the first window, of a video two neighbours; without a page, one frame."""
    # 1. The frames that are shown; of an image that was restored jointly from all, the middle one of the input.
    record, bad, restoration = stored.windows[0], stored.bad_frames, command.of_stack["restoration"]
    joint, mosaic = restoration.get("joint") is True, restoration.get("mosaic")
    is_restored = any(one.frames == "restored" for one in (stored.windows if command.is_followed else (record,)))
    shown = [number for number in range(record.last + 1) if str(number) not in bad]
    if command.is_followed:  # earlier frames must be decoded as well
        start = min((n for n in shown if n + 1 in shown), key=lambda number: abs(number - 8), default=record.last + 1)
        shown = [number for number in shown if start <= number <= start + 1]
    elif not joint:
        shown = [number for number in shown if number < record.written]
    if not command.is_followed and not command.report:
        middle = len(shown) // 2 if joint else 0
        shown = shown[middle : middle + 1]
    # 2. Their pixels as taken and as written.
    before, after = io.read_frames(command.frames, shown, command.scale), None
    if stored.margins is not None:
        before = video.Margins(**stored.margins).cut(before)
    if mosaic is not None:
        before = preparation.colour_frames(before, mosaic)
    if len(shown) and is_restored:
        scale = None if io.is_video(command.restored) else command.scale
        after = io.read_frames(command.restored, [0] if joint else shown, scale)
    # 3. What was found in them.
    detected = first if isinstance(first, detection.DetectionResult) else None  # of a steady vibration
    only_window = detected is not None and len(stored.windows) == 1
    timing = io.timing_from_first_frame(command.settings.timing, command.info)
    return reports.Report(
        title=printable(f"Vibration in {command.frames.name}"),
        subtitle=printable(f"{command.frames}, camera of {command.settings.source}"),
        made_with=f"rsvib_torch {rsvib_torch.__version__}: {current_output().command}",
        frames=before.nan_to_num(0.0),
        restored=after,
        first=next(iter(shown), 0),
        timing=detected.timing if detected is not None and not only_window and detected.timing is not None else timing,
        detection=detected,
        outcome=record.outcome,
        windows=None if only_window else stored,
    )


def _answer(command: RunCommand, detected: detection.DetectionResult | None, stored: stacks.StackManifest) -> Answer:
    """The answer about one vibration of all frames, or about the windows, with steps and warnings about a video."""
    if detected is not None:
        answer = answers.stack_answer(command.frames, detected, command.pixel_size)
        answer.data["restoration"] = stored.totals()
        answer.next_steps = answers.steps_after_detection(detected, command.frames, command.settings)
    else:
        answer = Answer({f"Vibration in {command.frames.name}": stored.lines()[0]}, {"windows": stored.totals()})
        answer.reliable = answers.verdicts([record.detection for record in stored.windows])
    if command.is_followed:
        answer.data["shaking"] = stored.shaking
        if stored.settings["video"].get("stabilised"):
            warn(
                "the camera has stabilised the frames (IORI in the track of the video): they are moved as a whole, and "
                "vibration within them is not measured"
            )
    elif io.is_video(command.frames) and not command.video and any(one.frames == "as taken" for one in stored.windows):
        followed = answers.run_step(command.frames, command.out / "followed", command.settings.arguments)
        answer.next_steps.insert(0, followed)
    return answer


def _write_page(folder: Path, page: reports.Report, stored: stacks.StackManifest, answer: Answer) -> list[str]:
    """Write the page, and return the names of its files."""
    if not len(page.frames) or (page.detection is None and not stored.is_removed):
        warn("report.html is not written: the vibration of the first window is not known")
        return []
    texts = {title: "\n".join(lines) for title, lines in answer.results.items()}
    with working("writing the page"):
        return reports.write_report_page(folder, replace(page, texts=texts, next_steps=answer.next_steps))
