"""``rsvib run``: a stack in windows, or a video from frame to frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rsvib_torch import detection, io, stacks, video
from rsvib_torch import frames as preparation
from rsvib_torch import report as reports
from rsvib_torch.checks.validation import options
from rsvib_torch.commands import answers
from rsvib_torch.commands.flat_command import Given, argument
from rsvib_torch.commands.shared_options import PixelSizeOptions, RestorationCommand, VerdictOptions
from rsvib_torch.commands.stack_commands import print_notes, read_frame
from rsvib_torch.commands.terminal import Answer, warn, working
from rsvib_torch.files.atomic import whole_folder
from rsvib_torch.files.reading import Table
from rsvib_torch.options import ProcessStackOptions, ProcessVideoOptions, WindowOptions
from rsvib_torch.text import number_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_RESULTS = (*answers.OF_DETECTION, *answers.OF_WINDOWS, "restoration.json", "before_after.png")
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

    Figures show both. Stacks of any length are processed in windows. If the restored frames are judged no better
    than the input, the input is written unchanged, unless --force is given. Ctrl-C stops after the current windows;
    --resume continues. With --video, the vibration of a video is followed frame by frame: --steady 1 --border crop
    makes a shaky video steady.
    """
    settings, frames, out, output = given.settings, given.stack, given.out, given.output.removesuffix("/")
    if given.moved and not given.video:
        raise ValueError(f"--{next(iter(given.moved)).replace('_', '-')} goes with --video")
    if "lens_profile" in given.moved and "gyroscope" not in given.moved:
        raise ValueError("--lens-profile goes with --gyroscope")
    if given.require_reliable and "gyroscope" in given.moved:
        problem = "does not go with --gyroscope, which searches for no tones; leave one of them out"
        raise ValueError(f"--require-reliable {problem}")
    if given.video:
        if output != "restored.tif":
            raise ValueError(f"--video and --output {output} are two names for the restored stack; give one of them")
        ending = io.split_range(frames)[0].suffix.lower()
        output = f"restored{ending if ending in io.H264 else '.mkv'}"
    if Path(output).name != output or output in ("", ".", ".."):
        raise ValueError(f"--output must be a file name without a folder, got {output!r}")
    answers.check_folder(out, _RESULTS, given.overwrite or "resume" in given.processing, given.inputs, out / output)
    info, scale, restoration = given.planned_restoration(given.restoration)
    print_notes(info, settings)
    chosen = WindowOptions(**{**settings.stack, **given.windows})
    common = given.of_stack(scale, restoration)
    # videos of more than one window are followed from frame to frame
    if given.moved or (given.video and io.is_video(frames) and info.shape[0] > chosen.window):
        answer = _run_followed(given, out / output, common)
    else:
        answer = _run_windows(given, out / output, info, common, chosen)
    if given.overwrite:
        answers.remove_old(out, _RESULTS, [path.name for path in answer.files])
    return answer


def _run_windows(given: RunOptions, restored: Path, info: io.StackInfo, common: Table, chosen: WindowOptions) -> Answer:
    settings, frames, out = given.settings, given.stack, given.out
    common |= {"window": chosen.window, "follow": chosen.follow, "force": given.force}
    common["detection"] = None if chosen.follow is True else settings.detection  # a tracker has none
    resources = {name: value for name, value in given.processing.items() if name in ("memory", "workers")}
    counts = info.shape[0] > chosen.window
    of_run = common | given.processing | {"manifest": out / "manifest.json"}
    with working(f"restoring {frames.name}", counts=counts) as progress:
        of_run["progress"] = progress if counts else None
        result = stacks.process_stack(frames, restored, settings.timing, **of_run)
    first = result.first
    if first is None:  # the run was complete before, or its first window was
        first = next(iter(stacks.iterate_stack(frames, settings.timing, **common, **resources)))
    if result.bad_frames:
        warn(f"{number_of(result.bad_frames, 'frame')} could not be used: see manifest.json")
    answers.note_lost(restored, result.not_kept)
    found, restoration = first.detection, first.restoration
    names, more, steps = [restored.name, "manifest.json"], ["--manifest", str(out / "manifest.json")], []
    with whole_folder(out) as folder:
        if len(first.frames):
            with working("drawing the frames"):
                picture = folder / "before_after.png"
                names = answers.draw_safely(picture, lambda: _comparison(given, common, first)) + names
        # one vibration of all frames, which was not followed
        if result.windows == 1 and restoration is not None and isinstance(found, detection.DetectionResult):
            target, chosen_options = folder / "restoration.json", common["restoration"]
            reports.write_restoration(target, restoration, chosen_options, result.not_kept)
            timing = io.timing_from_first_frame(settings.timing, info)
            names += [*answers.write_detection(folder, found, timing, given.pixel_size), "restoration.json"]
            answers.warn_of_restoration(restoration)
            answer = answers.stack_answer(frames, found, given.pixel_size, restoration, info.shape[0])
            more, steps = [], answers.steps_after_detection(found, frames, settings)
        else:
            stored = stacks.read_manifest(out / "manifest.json")
            names += answers.write_windows(folder, stored, given.pixel_size)
            answer = answers.windows_answer(f"Vibration in {frames.name}", stored, result)
    if result.restored:
        steps.insert(0, answers.page_step(frames, out / "report", settings, *more))
    if not given.video and io.is_video(frames) and result.restored < result.windows:
        steps.insert(0, answers.run_step(frames, out / "followed", settings.arguments))
    answer.next_steps += steps
    answer.files += [out / name for name in names]
    return answer


def _comparison(given: RunOptions, common: Table, first: stacks.WindowResult) -> Figure:
    """Draw the first restored frame of a stack beside the frame of the input."""
    index = first.indices[0] if first.indices else (first.window.first + first.window.last + 1) // 2
    raw = read_frame(given.stack, index, common["full_scale"])
    pattern = common["restoration"].get("mosaic")
    if pattern is not None:
        raw = preparation.colour_frames(raw[None], pattern)[0]
    raw = preparation.enlarged(raw, first.frames.shape[-1] // raw.shape[-1])
    names = ("input", "restored" if first.restored else "unchanged")
    return reports.comparison_figure(raw, first.frames[0].cpu().nan_to_num(0.0), names=names)


def _run_followed(given: RunOptions, restored: Path, common: Table) -> Answer:
    """Process a video from frame to frame."""
    settings, frames, out, restoration = given.settings, given.stack, given.out, common["restoration"]
    changed = [name for name, value in given.windows.items() if value is not False]
    changed += ["compression"] if "compression" in given.processing else []
    changed += ["optics_sigma" if name == "optics" else name for name in stacks.options_of_windows(restoration)]
    refused = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
    if refused:
        remedy = "give --output restored.mp4 instead of --video, which processes windows"
        raise ValueError(f"{refused} cannot be used with --video, which follows the frames one by one; {remedy}")
    if {**settings.restoration, **given.restoration}.get("saturation") is None:
        restoration.pop("saturation", None)  # that of integer formats
    manifest = out / "manifest.json"
    of_run = common | given.moved | given.processing | {"manifest": manifest}
    with working(f"restoring {frames.name}", counts=True) as progress:
        result = video.process_video(frames, restored, settings.timing, **of_run, progress=progress)
    stored = stacks.read_manifest(manifest)
    index = min(8, io.read_stack_info(frames).shape[0] // 2)  # earlier ones must be decoded as well

    def comparison() -> Figure:
        raw = read_frame(frames, index, stored.settings["full_scale"])
        raw = raw if stored.margins is None else video.Margins(**stored.margins).cut(raw)
        return reports.comparison_figure(raw, read_frame(restored, index, None))

    drawn = answers.draw_safely(out / "before_after.png", comparison)
    with whole_folder(out) as folder:
        names = [restored.name, *drawn, "manifest.json", *answers.write_windows(folder, stored, given.pixel_size)]
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
    answer = answers.windows_answer(f"Vibration in {frames.name}", stored, result)
    for name, where in (("frame_to_frame", "from frame to frame"), ("rows", "between the rows of a frame")):
        if stored.shaking is not None:
            before, after = stored.shaking[name]
            answer.results["Restoration"].append(f"shaking {where}: {before:.2g} px rms, {after:.2g} px afterwards")
    answer.data["shaking"] = stored.shaking
    answer.files += [out / name for name in names]
    answer.next_steps.append(answers.page_step(frames, out / "report", settings, "--manifest", manifest))
    return answer
