"""``rsvib run``: a stack in windows, or a video from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rsvib_torch
from rsvib_torch import detection, io, stacks, video
from rsvib_torch import frames as preparation
from rsvib_torch import report as reports
from rsvib_torch.checks.values import options
from rsvib_torch.commands import answers
from rsvib_torch.commands.flat_command import Given, argument
from rsvib_torch.commands.shared_options import PixelSizeOptions, RestorationCommand, VerdictOptions
from rsvib_torch.commands.stack_commands import print_notes, read_frames
from rsvib_torch.commands.terminal import Answer, current_output, warn, working
from rsvib_torch.files.atomic import whole_folder
from rsvib_torch.files.reading import Table
from rsvib_torch.options import ProcessStackOptions, ProcessVideoOptions, WindowOptions
from rsvib_torch.text import number_of, printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from torch import Tensor

    from rsvib_torch.detection import DetectionResult


_RESULTS = (*answers.OF_DETECTION, *answers.OF_WINDOWS, "before_after.png", "report.html")
_PROCESSING = ("resume", "compression", "memory", "workers")


@options
class RunOptions(RestorationCommand, PixelSizeOptions, VerdictOptions):
    """Options of ``run``."""

    out: Path = argument()
    """Folder for the restored frames, the vibration and the figures."""
    output: str = "restored.tif"
    """Name of the restored stack in that folder; its extension selects the format, e.g. .mp4 or .mkv for a video with
    the time stamps and the sound of the input. restored/ is a folder with a file for each frame: from a folder of TIFF
    files, TIFF files of the same names, georeference, tiles and compression."""
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
    windows: Annotated[Table, Given(WindowOptions, default="from the configuration")]
    processing: Annotated[Table, Given(ProcessStackOptions, _PROCESSING)]


def run(given: RunOptions) -> Answer:
    """Detect the vibration, restore the frames, judge the result.

    Figures and, with --report, a page show both. Stacks of any length are processed in windows. If the restored frames
    are judged no better than the input, the input is written unchanged, unless --force is given. Ctrl-C stops after the
    current windows; --resume continues. With --video, the vibration of a video is followed frame by frame: --steady 1
    --border crop makes a shaky video steady.
    """
    settings, frames, out, output = given.settings, given.frames, given.out, _name_of_output(given)
    replaces = given.overwrite or "resume" in given.processing
    answers.check_folder(out, _RESULTS, replaces, given.inputs, out / output)
    current_output().work = stacks.work_folder(out / output)
    info, common = given.info, given.of_stack
    print_notes(info, settings)
    chosen = WindowOptions(**{**settings.stack, **given.windows})
    # 1. Process windows, or a video of more than one window from frame to frame.
    followed = bool(given.moved) or (given.video and io.is_video(frames) and info.shape[0] > chosen.window)
    result = _process_video(given, out / output, common) if followed else _process(given, out / output, common, chosen)
    manifest = stacks.read_manifest(result.manifest)
    complete = result.resumed == result.windows and not given.report and given.pixel_size is None
    if complete and _is_newer(out / "tones.csv", result.manifest):  # else it is of a run that was replaced
        answer = answers.windows_answer(f"Vibration in {frames.name}", manifest, result)
        answer.files += [out / name for name in dict.fromkeys((output, *_RESULTS)) if (out / name).exists()]
        return answer
    if followed:
        shown = _show_video(given, out / output, info, manifest)
    else:
        shown = _show_window(given, result, info, common | _windows(given, chosen), manifest)
    answers.note_lost(out / output, () if followed else result.not_kept)
    # 2. Figure, tables and page.
    with whole_folder(out) as folder:
        drawn = []
        if len(shown.after):
            with working("drawing the frames"):
                reports.save_figure(_comparison(shown), folder / "before_after.png")
            drawn = ["before_after.png"]
        names = [output, *drawn, "manifest.json"] if followed else [*drawn, output, "manifest.json"]
        answer = _describe(folder, given, result, shown, names)
        if given.report:
            pages = _write_page(folder, given, shown, answer)
            answers.check_folder(out, pages, overwrite=True, inputs=given.inputs)
            names = list(dict.fromkeys(pages + names))  # the page shows the curves of offsets.png as well
        elif result.restored:
            command = (current_output().command or "").replace(" --resume", "")
            step = f"write a page with all figures:\n  {command} --resume --report"
            answer.next_steps.insert(0, step)
    if followed:
        _describe_video(answer, shown.stored, result)
    if given.overwrite:
        answers.remove_old(out, _RESULTS, names)
    answer.files += [out / name for name in names]
    return answer


def _is_newer(table: Path, manifest: Path) -> bool:
    """Whether a table exists and was written after the manifest, so that both are of the same run."""
    return table.exists() and table.stat().st_mtime_ns >= manifest.stat().st_mtime_ns


def _name_of_output(given: RunOptions) -> str:
    """Name of the restored stack."""
    output = given.output.removesuffix("/")
    if given.moved and not given.video:
        raise ValueError(f"--{next(iter(given.moved)).replace('_', '-')} goes with --video")
    if given.video:
        if output != "restored.tif":
            raise ValueError(f"--video and --output {output} are two names for the restored stack; give one of them")
        ending = io.split_range(given.frames)[0].suffix.lower()
        output = f"restored{ending if ending in io.H264 else '.mkv'}"
    if Path(output).name != output or output in ("", ".", ".."):
        raise ValueError(f"--output must be a file name without a folder, got {output!r}")
    return output


@dataclass(frozen=True)
class _Shown:
    """Frames before and after restoration, for the figure and the page, and what is known of them."""

    before: Tensor  # (T, H, W) or (T, C, H, W), full scale 1; of a mosaic in colour
    after: Tensor  # the same frames restored or as taken, or one image of them; empty if none could be used
    first: int  # number of the first one in the stack
    was_restored: bool  # whether ``after`` is restored
    timing: rsvib_torch.SensorTiming
    stored: stacks.StackManifest  # all windows
    detection: DetectionResult | None = None  # of a steady vibration
    restoration: stacks.RestoredFrames | None = None  # its verdict

    @property
    def windows(self) -> stacks.StackManifest | None:
        """The windows, unless one vibration of all frames is shown."""
        return None if len(self.stored.windows) == 1 and self.detection is not None else self.stored


def _windows(given: RunOptions, chosen: WindowOptions) -> Table:
    """Options of a run in windows."""
    return {"window": chosen.window, "force": given.force, "detection": given.settings.detection}


def _process(given: RunOptions, restored: Path, common: Table, chosen: WindowOptions) -> stacks.StackReport:
    """Process a stack in windows."""
    of_run = common | _windows(given, chosen) | given.processing | {"manifest": given.out / "manifest.json"}
    counts = given.info.shape[0] > chosen.window
    with working(f"restoring {given.frames.name}", counts=counts) as progress:
        of_run["progress"] = progress if counts else None
        return stacks.process_stack(given.frames, restored, given.settings.timing, **of_run)


def _process_video(given: RunOptions, restored: Path, common: Table) -> stacks.StackReport:
    """Process a video from frame to frame."""
    restoration = dict(common["restoration"])
    if {**given.settings.restoration, **given.restoration}.get("saturation") is None:
        restoration.pop("saturation", None)  # that of integer formats
    of_run = common | {"restoration": restoration} | given.moved | given.windows | given.processing
    of_run["manifest"] = given.out / "manifest.json"
    with working(f"restoring {given.frames.name}", counts=True) as progress:
        return video.process_video(given.frames, restored, given.settings.timing, **of_run, progress=progress)


def _show_window(
    given: RunOptions, result: stacks.StackReport, info: io.StackInfo, options: Table, stored: stacks.StackManifest
) -> _Shown:
    """Frames of the first window, which is computed with these options if it was complete before."""
    settings, frames, first = given.settings, given.frames, result.first
    if first is None:
        resources = {name: value for name, value in given.processing.items() if name in ("memory", "workers")}
        first = next(iter(stacks.iterate_stack(frames, settings.timing, **options, **resources)))
    if result.bad_frames:
        warn(f"{number_of(result.bad_frames, 'frame')} could not be used: see manifest.json")
    after, restoration = first.frames.cpu(), options["restoration"]
    # the page shows all frames of the window, the figure one of them: of a joint image, that in the middle
    indices = first.indices or [index for index in first.window.written if index not in first.bad_frames]
    if not given.report:
        middle = 0 if first.indices else len(indices) // 2
        indices, after = indices[middle : middle + 1], after[:1]
    before = read_frames(frames, indices, options["full_scale"]) if len(after) else after
    if len(before) and restoration.get("mosaic") is not None:
        before = preparation.colour_frames(before, restoration["mosaic"])
    found = first.detection if isinstance(first.detection, detection.DetectionResult) else None
    timing = io.timing_from_first_frame(settings.timing, info)
    if found is not None and found.timing is not None and result.windows > 1:
        timing = found.timing
    shown = (before, after, next(iter(indices), 0), first.restored, timing, stored)
    return _Shown(*shown, detection=found, restoration=first.restoration)


def _show_video(given: RunOptions, restored: Path, info: io.StackInfo, stored: stacks.StackManifest) -> _Shown:
    """Two frames near the begin of a video."""
    bad = stored.bad_frames
    pairs = (number for number in range(info.shape[0] - 1) if str(number) not in bad and str(number + 1) not in bad)
    first = min(pairs, key=lambda number: abs(number - 8), default=None)  # earlier frames must be decoded as well
    indices = () if first is None else (first, first + 1)  # no two neighbours could be used
    before = read_frames(given.frames, indices, stored.settings["full_scale"])
    if stored.margins is not None:
        before = video.Margins(**stored.margins).cut(before)
    after = read_frames(restored, indices, None)
    is_restored = any(record.frames == "restored" for record in stored.windows)
    return _Shown(before, after, first or 0, is_restored, given.settings.timing, stored)


def _describe(folder: Path, given: RunOptions, result: stacks.StackReport, shown: _Shown, names: list[str]) -> Answer:
    """Write the tables and figures of one vibration of all frames, or of the windows; their names are added."""
    frames, found, judged = given.frames, shown.detection, shown.restoration
    if shown.windows is None and found is not None and judged is not None:
        names += answers.write_detection(folder, found, shown.timing, given.pixel_size)
        answers.warn_of_restoration(judged)
        answer = answers.stack_answer(frames, found, given.pixel_size, judged, given.info.shape[0])
        answer.next_steps = answers.steps_after_detection(found, frames, given.settings)
    else:
        names += answers.write_windows(folder, shown.stored, given.pixel_size)
        answer = answers.windows_answer(f"Vibration in {frames.name}", shown.stored, result)
    if not given.video and io.is_video(frames) and result.restored < result.windows:
        answer.next_steps.insert(0, answers.run_step(frames, given.out / "followed", given.settings.arguments))
    return answer


def _describe_video(answer: Answer, stored: stacks.StackManifest, result: stacks.StackReport) -> None:
    """Add what was found in a video to the answer, and warn of frames that are not better."""
    if result.bad_frames:
        bad = number_of(result.bad_frames, "frame")
        warn(f"{bad} could not be used and repeat the frame before: see manifest.json")
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


def _comparison(shown: _Shown) -> Figure:
    """Draw a frame before and after restoration."""
    before = shown.before[0 if len(shown.after) == len(shown.before) else len(shown.before) // 2]
    raw = preparation.enlarged(before, shown.after.shape[-1] // before.shape[-1])
    names = ("input", "restored" if shown.was_restored else "unchanged")
    return reports.comparison_figure(raw, shown.after[0].nan_to_num(0.0), names=names)


def _write_page(folder: Path, given: RunOptions, shown: _Shown, answer: Answer) -> list[str]:
    """Write the page, and return the names of its files."""
    if not len(shown.after) or (shown.detection is None and not shown.stored.is_removed):
        warn("report.html is not written: the vibration of the first window is not known")
        return []
    judged = shown.restoration
    page = reports.Report(
        title=printable(f"Vibration in {given.frames.name}"),
        subtitle=printable(f"{given.frames}, camera of {given.settings.source}"),
        made_with=f"rsvib_torch {rsvib_torch.__version__}: {current_output().command}",
        windows=shown.windows,
        frames=shown.before,
        restored=shown.after if shown.was_restored else None,
        timing=shown.timing,
        detection=shown.detection,
        verdict=None if judged is None else judged.verdict,
        first=shown.first,
        next_steps=answer.next_steps,
        texts={title: "\n".join(lines) for title, lines in answer.results.items()},
    )
    with working("writing the page"):
        return reports.write_report_page(folder, page)
