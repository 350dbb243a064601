"""``rsvib run``: a stack in windows, or a video from frame to frame."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import rsvib_torch
from rsvib_torch import detection, io, stacks, video
from rsvib_torch import frames as preparation
from rsvib_torch import report as reports
from rsvib_torch.checks.values import fields_of, options
from rsvib_torch.commands import answers
from rsvib_torch.commands.flat_command import Given, argument
from rsvib_torch.commands.shared_options import PixelSizeOptions, RestoringCommand, VerdictOptions
from rsvib_torch.commands.terminal import Answer, current_output, warn, working
from rsvib_torch.files.atomic import whole
from rsvib_torch.files.reading import Table
from rsvib_torch.options import ProcessVideoOptions, StackOptions
from rsvib_torch.text import number_of, printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_RESULTS = (*answers.OF_DETECTION, *answers.OF_WINDOWS, "before_after.png", "report.html")


@options
class RunCommand(RestoringCommand, PixelSizeOptions, VerdictOptions):
    """Options of ``run``."""

    out: Path = argument()
    """Folder for the restored frames, the vibration and the figures."""
    output: str = "restored.tif"
    """Name of the restored stack in that folder; its extension selects the format, e.g. .mp4 or .mkv for a video with
    the time stamps and the sound of the input. restored/ is a folder with a file for each frame: from a folder of TIFF
    files, TIFF files of the same names and georeference."""
    video: bool = False
    """Write a video: restored.mp4 (H.264) from .mp4, restored.mov from .mov, else restored.mkv (FFV1, without loss).
    Videos are followed frame by frame instead of in windows."""
    report: bool = False
    """Write report.html as well: a page with all figures, of the first window."""
    moved: Annotated[
        Table,
        Given(
            ProcessVideoOptions,
            ("border", "steady", "crop_limit", "gyroscope", "lens_profile"),
            context="With --video, ",
            forms={
                "steady": {"metavar": "SECONDS", "show_default": "the image stays where it is"},
                "gyroscope": {"metavar": "FILE"},
                "lens_profile": {"metavar": "FILE"},
            },
        ),
    ]

    @cached_property
    def restored(self) -> Path:
        """The restored stack."""
        output = self.output.removesuffix("/")
        if self.moved and not self.video:
            raise ValueError(f"--{next(iter(self.moved)).replace('_', '-')} goes with --video")
        if self.video:
            if output != "restored.tif":
                raise ValueError(
                    f"--video and --output {output} are two names for the restored stack; give one of them"
                )
            ending = io.split_range(self.frames)[0].suffix.lower()
            output = f"restored{ending if ending in io.H264 else '.mkv'}"
        if Path(output).name != output or output in ("", ".", ".."):
            raise ValueError(f"--output must be a file name without a folder, got {output!r}")
        return self.out / output

    @property
    def is_followed(self) -> bool:
        """Whether a video of more than one window is processed from frame to frame."""
        is_long_video = self.video and io.is_video(self.frames) and self.info.shape[0] > self.window
        return bool(self.moved) or is_long_video


def run(given: RunCommand) -> Answer:
    """Detect the vibration, restore the frames, judge the result.

    Figures and, with --report, a page show both. Stacks of any length are processed in windows. If the restored frames
    are judged no better than the input, the input is written unchanged, unless --force is given. Ctrl-C stops after the
    current windows; --resume continues. With --video, the vibration of a video is followed frame by frame: --steady 1
    --border crop makes a shaky video steady.
    """
    settings, out, restored = given.settings, given.out, given.restored  # a mistake in settings needs no torch
    answers.check_folder(out, _RESULTS, given.replaces, given.inputs, restored)
    current_output().work = stacks.work_folder(restored)
    given.print_notes()
    # 1. The restored frames and their manifest.
    result = _process_video(given) if given.is_followed else _process(given)
    stored, first = stacks.read_manifest(result.manifest), result.first
    # 2. Figure, tables and page.
    page = _video_page(given, stored) if first is None else _window_page(given, first, stored)
    with whole(out, "folder") as folder:
        drawn = []
        if len(page.frames):
            with working("drawing the frames"):
                reports.save_figure(_comparison(page), folder / "before_after.png")
            drawn = ["before_after.png"]
        names = [restored.name, *drawn] if given.is_followed else [*drawn, restored.name]
        answer, tables = _describe(folder, given, result, page, stored)
        names += ["manifest.json", *tables]
        if not given.video and io.is_video(given.frames) and result.restored < result.windows:
            answer.next_steps.insert(0, answers.run_step(given.frames, out / "followed", settings.arguments))
        if given.report:
            pages = _write_page(folder, page, stored, answer)
            answers.check_folder(out, pages, overwrite=True, inputs=given.inputs)
            names = list(dict.fromkeys(pages + names))  # the page shows the curves of offsets.png as well
        elif result.restored:
            command = (current_output().command or "").replace(" --resume", "")
            answer.next_steps.insert(0, f"write a page with all figures:\n  {command} --resume --report")
    if given.is_followed:
        _describe_video(answer, stored, result)
    if given.overwrite:
        answers.remove_old(out, _RESULTS, names)
    answer.files += [out / name for name in names]
    return answer


def _process(given: RunCommand) -> stacks.StackReport:
    """Process a stack in windows; the first one is computed again if it was complete before."""
    of_run = given.of_stack | {"detection": given.settings.detection}
    report = given.process(given.restored, of_run | {"manifest": given.out / "manifest.json"})
    if report.bad_frames:
        warn(f"{number_of(report.bad_frames, 'frame')} could not be used: see manifest.json")
    if report.first is not None:
        return report
    of_run |= {"window": given.window, "force": given.force}
    of_windows = {name: value for name, value in of_run.items() if name in fields_of(StackOptions)}
    first = next(iter(stacks.iterate_stack(given.frames, given.settings.timing, **of_windows)))
    return replace(report, first=first)


def _process_video(given: RunCommand) -> stacks.StackReport:
    """Process a video from frame to frame."""
    of_run = given.of_stack | given.moved | {"manifest": given.out / "manifest.json"}
    with working(f"restoring {given.frames.name}", counts=True) as progress:
        return video.process_video(given.frames, given.restored, given.settings.timing, **of_run, progress=progress)


def _page(given: RunCommand, stored: stacks.StackManifest, **shown: Any) -> reports.Report:
    """The page of a run that shows some frames."""
    return reports.Report(
        title=printable(f"Vibration in {given.frames.name}"),
        subtitle=printable(f"{given.frames}, camera of {given.settings.source}"),
        made_with=f"rsvib_torch {rsvib_torch.__version__}: {current_output().command}",
        **{"windows": stored, "timing": io.timing_from_first_frame(given.settings.timing, given.info), **shown},
    )


def _window_page(given: RunCommand, first: stacks.WindowResult, stored: stacks.StackManifest) -> reports.Report:
    """The page of the first window: all of its frames, or without a page one of them: of a joint image, the middle."""
    after, mosaic = first.frames.cpu(), given.of_stack["restoration"].get("mosaic")
    indices = first.indices or [index for index in first.window.written if index not in first.bad_frames]
    if not given.report:
        middle = 0 if first.indices else len(indices) // 2
        indices, after = indices[middle : middle + 1], after[:1]
    before = io.read_frames(given.frames, indices, given.scale).nan_to_num(0.0) if len(after) else after
    if len(before) and mosaic is not None:
        before = preparation.colour_frames(before, mosaic)
    restored = after if first.restored else None
    shown: Table = {"frames": before, "restored": restored, "first": next(iter(indices), 0)}
    if first.restoration is not None:
        shown["verdict"] = first.restoration.verdict
    if isinstance(first.detection, detection.DetectionResult):  # of a steady vibration
        shown["detection"] = first.detection
        if len(stored.windows) == 1:
            shown["windows"] = None
        elif first.detection.timing is not None:
            shown["timing"] = first.detection.timing
    return _page(given, stored, **shown)


def _video_page(given: RunCommand, stored: stacks.StackManifest) -> reports.Report:
    """The page of two frames near the begin of a video."""
    bad = stored.bad_frames
    usable = (number for number in range(given.info.shape[0] - 1) if not {str(number), str(number + 1)} & bad.keys())
    first = min(usable, key=lambda number: abs(number - 8), default=None)  # earlier frames must be decoded as well
    indices = () if first is None else (first, first + 1)  # no two neighbours could be used
    before, after = io.read_frames(given.frames, indices, stored.settings["full_scale"]), None
    if stored.margins is not None:
        before = video.Margins(**stored.margins).cut(before)
    if any(record.frames == "restored" for record in stored.windows):
        after = io.read_frames(given.restored, indices)
    return _page(given, stored, frames=before, restored=after, first=first or 0, timing=given.settings.timing)


def _describe(
    folder: Path, given: RunCommand, result: stacks.StackReport, page: reports.Report, stored: stacks.StackManifest
) -> tuple[Answer, list[str]]:
    """The answer, and the names of the tables and figures of one vibration of all frames, or of the windows."""
    frames, found, title = given.frames, page.detection, f"Vibration in {given.frames.name}"
    if page.windows is None and found is not None and result.first is not None and result.first.error is None:
        names = answers.write_detection(folder, found, page.timing, given.pixel_size)
        answer = answers.stack_answer(frames, found, given.pixel_size)
        answer.results["Restoration"], answer.data["restoration"] = answers.restoration_of(result)
        answer.next_steps = answers.steps_after_detection(found, frames, given.settings)
    else:
        names = answers.write_windows(folder, stored, given.pixel_size)
        answer = Answer({title: stored.lines()[0]}, {"windows": stored.totals()})
        answer.reliable = answers.verdicts([record.detection for record in stored.windows])
        answer.results["Restoration"] = [result.summary(), *stored.lines()[1][1:]]
    return answer, names


def _describe_video(answer: Answer, stored: stacks.StackManifest, result: stacks.StackReport) -> None:
    """Add what was found in a video to the answer, and warn of frames that are not better."""
    if result.bad_frames:
        bad = number_of(result.bad_frames, "frame")
        warn(f"{bad} could not be used; the frame before is shown instead: see manifest.json")
    if not result.restored:
        warn("no vibration was found that can be removed: the frames are written unchanged")
    if stored.settings["video"].get("stabilised"):
        warn(
            "the camera has stabilised the frames (IORI in the track of the video): they are moved as a whole, and "
            "vibration within them is not measured"
        )
    worse = [record for record in stored.windows if record.outcome == "worse"]
    if worse:
        where = f"{len(worse)} of {number_of(result.windows, 'part')} of the video"
        warn(f"restored frames would shake more than the input in {where}, whose rows are left as taken")
    for name, where in (("frame_to_frame", "from frame to frame"), ("rows", "between the rows of a frame")):
        if stored.shaking is not None:
            before, after = stored.shaking[name]
            answer.results["Restoration"].append(f"shaking {where}: {before:.2g} px rms, {after:.2g} px afterwards")
    answer.data["shaking"] = stored.shaking


def _comparison(page: reports.Report) -> Figure:
    """Draw a frame before and after restoration."""
    frames, after = page.frames, page.restored
    if after is None:
        return reports.comparison_figure(frames[0], frames[0], names=("input", "unchanged"))
    before = frames[0 if len(after) == len(frames) else len(frames) // 2]
    raw = preparation.enlarged(before, after.shape[-1] // before.shape[-1])
    return reports.comparison_figure(raw, after[0].nan_to_num(0.0))


def _write_page(folder: Path, page: reports.Report, stored: stacks.StackManifest, answer: Answer) -> list[str]:
    """Write the page, and return the names of its files."""
    if not len(page.frames) or (page.detection is None and not stored.is_removed):
        warn("report.html is not written: the vibration of the first window is not known")
        return []
    texts = {title: "\n".join(lines) for title, lines in answer.results.items()}
    with working("writing the page"):
        return reports.write_report_page(folder, replace(page, texts=texts, next_steps=answer.next_steps))
