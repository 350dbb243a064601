"""Commands that detect and remove vibration: ``simulate``, ``detect``, ``restore`` and ``report``."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

import rsvib_torch
from rsvib_torch import detection, imaging, io, stacks, video
from rsvib_torch import frames as preparation
from rsvib_torch import report as reports
from rsvib_torch.checks.validation import options
from rsvib_torch.commands import answers
from rsvib_torch.commands import shared_options as shared
from rsvib_torch.commands.flat_command import Given, argument, option
from rsvib_torch.commands.terminal import Answer, current_output, note, working
from rsvib_torch.files.atomic import check_writable, whole_folder
from rsvib_torch.files.reading import Table, check_regular
from rsvib_torch.options import DetectStackOptions, RestorationOptions
from rsvib_torch.text import printable

if TYPE_CHECKING:
    from torch import Tensor

    from rsvib_torch.config import Config
    from rsvib_torch.motion.detected_vibration import DetectedVibration


Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]


def load(given: shared.StackCommand, restoration: Table | None = None) -> tuple[Tensor, rsvib_torch.SensorTiming]:
    """Read a stack that is processed as a whole, if the memory suffices for it and for the restoration that follows.

    The frames are (T, H, W) or (T, C, H, W), full scale 1; the timing has the frame times of the file.
    """
    stacks.check_stack_fits(given.info, restoration, on_gpu=given.torch_device.type != "cpu")
    with working(f"reading {given.stack}"):
        frames = io.read_stack(given.stack, full_scale=given.scale)
    print_notes(given.info, given.settings)
    return frames.to(given.torch_device), io.timing_from_first_frame(given.settings.timing, given.info)


def read_frame(path: Path, index: int, full_scale: float | None) -> Tensor:
    """A frame of a stack, with 0 for missing pixels."""
    with closing(io.open_stack(path)) as reader:
        scale, pixels = full_scale or reader.info.full_scale, reader.frame(index)[None]
    return io.counts_to_frames(pixels, scale, str(path), reader.info.nodata)[0].nan_to_num(0.0)


def print_notes(info: io.StackInfo, config: Config) -> None:
    """Print what the file states about orientation, dropped frames and unequal intervals."""
    for sentence in io.describe_stack(info, config.timing):
        note(sentence)


def _detect(frames: Tensor, timing: rsvib_torch.SensorTiming, config: Config) -> detection.DetectionResult:
    with working("detecting the vibration"):
        return detection.detect_vibration(frames, timing, **config.detection)


@options
class SimulateOptions(shared.CameraOptions, shared.DeviceOptions):
    """Options of ``simulate``."""

    scene: Path = argument()
    """Image of the scene at rest, larger than the frames."""
    frames: Path = argument()
    """Stack to write."""
    full_scale: float | None = None
    """Count of the scene's file that corresponds to full scale."""
    seed: Seed | None = option(None, show_default="from the configuration")
    """Seed of the noise."""


def simulate(given: SimulateOptions) -> Answer:
    """Simulate frames of a vibrating camera.

    The camera, its vibration and its noise are described in the configuration file.
    """
    import torch  # noqa: PLC0415

    settings, frames, scene = given.settings_for(None), given.frames, given.scene
    shared.check_new(io.stack_files(frames), given.overwrite, [*io.stack_files(scene), settings.path])
    if settings.simulation is None:
        raise ValueError(f"{settings.source}: simulation: missing key; expected a table with vibration, num_frames")
    simulation, target = settings.simulation, given.torch_device
    vibration = simulation.vibration.to_vibration()
    image = io.read_stack(scene, full_scale=given.full_scale)
    if len(image) != 1:
        raise ValueError(f"{scene}: the scene must be one image, this file has {len(image)} frames")
    scale = settings.full_scale
    dtype = "float32" if scale is None else "uint8" if scale <= 255 else "uint16"
    io.check_stack_target(frames, (simulation.num_frames, *image.shape[1:]), dtype=dtype, full_scale=scale)
    with working("simulating the frames"):
        generator = torch.Generator(target).manual_seed(simulation.seed if given.seed is None else given.seed)
        simulated = imaging.simulate_frames(
            image[0].to(target),
            settings.timing,
            vibration,
            simulation.num_frames,
            frame_size=simulation.frame_size,
            noise=simulation.noise,
            generator=generator,
        )
    with working(f"writing {frames}"):
        stated = io.StackInfo(tuple(simulated.shape), dtype, scale, frame_rate=settings.timing.frame_rate)
        io.write_stack(frames, simulated, dtype=dtype, full_scale=scale, like=stated)
    line = f"{len(simulated)} frames of {simulated.shape[-2]} x {simulated.shape[-1]} px, {dtype}"
    return Answer(
        {"Simulated frames": [line, f"vibration:\n{vibration}"]},
        {"shape": list(simulated.shape), "dtype": dtype, "vibration": vibration.to_dict()},
        [frames],
        [answers.run_step(frames, frames.with_name("results"), settings.arguments)],
    )


@options
class DetectOptions(shared.StackCommand, shared.PixelSizeOptions, shared.VerdictOptions):
    """Options of ``detect``."""

    out: Path = option(...)
    """Folder for vibration.json, tables (tones, offsets, spectrum) and figures."""
    windows: Annotated[
        Table,
        Given(
            DetectStackOptions,
            ("memory", "workers", "follow"),
            forms={
                "window": {
                    "text": "Detect separately in windows of at most this number of frames; writes manifest.json and "
                    "tones.csv.",
                    "show_default": "from the configuration, or all frames together if there are at most 256 and "
                    "their vibration is steady, else 8",
                }
            },
        ),
    ]


def detect(given: DetectOptions) -> Answer:
    """Detect the vibration in a stack of frames.

    The vibration is modelled as sinusoids of constant amplitude and frequency; if they change within the frames, they
    are followed from frame to frame. For other motion see rsvib motion.
    """
    settings, frames, out = given.settings, given.stack, given.out
    answers.check_folder(out, (*answers.OF_DETECTION, *answers.OF_WINDOWS), given.overwrite, given.inputs)
    windows = {name: value for name, value in settings.stack.items() if name in ("window", "follow")} | given.windows
    count = given.info.shape[0]
    result, many = None, "window" in windows or windows.get("follow") is True or count > _LONG
    with whole_folder(out) as folder:
        if many:
            print_notes(given.info, settings)
        else:
            pixels, timing = load(given)
            result = _detect(pixels, timing, settings)
            may_change = windows.get("follow") is not False and stacks.may_change(result, count)
        if many or may_change:
            stored = _detect_windows(given, folder / "manifest.json", windows)
            found = stored.detections()
            reliable = sum(0.0 if one is None else float(one.reliable.sum()) for one in found) / len(found)
            if result is not None and not reliable > float(result.reliable.sum()):
                (folder / "manifest.json").unlink()  # a steady vibration of all frames is known as well
            else:
                result = None
        if result is not None:
            names = answers.write_detection(folder, result, timing, given.pixel_size)
            answer = answers.stack_answer(frames, result, given.pixel_size)
            answer.next_steps += answers.steps_after_detection(result, frames, settings, out / "vibration.json")
        else:
            names = [*answers.write_windows(folder, stored, given.pixel_size), "manifest.json"]
            title = f"Vibration in {len(stored.windows)} windows of {frames.name}"
            answer = answers.windows_answer(title, stored)
            if any(record.followed is not None for record in stored.windows):
                run = ("run", frames, out / "restored", *settings.arguments)
                follow = ["--follow"] * (windows.get("follow") is True)
                answer.next_steps.append(answers.next_step("restore the frames", *run, *follow))
            else:
                answer.next_steps += answers.steps_after_detection(None, frames, settings, out / "manifest.json")
    answers.remove_old(out, (*answers.OF_DETECTION, *answers.OF_WINDOWS), names)
    answer.files += [out / name for name in names]
    return answer


# frames; longer stacks are detected in windows, shorter ones as a whole: 256 of 266 x 264 px take 21 s of a processor
_LONG = 256


def _detect_windows(given: DetectOptions, manifest: Path, windows: Table) -> stacks.StackManifest:
    """Detect the vibration in the windows of a stack, and write the manifest."""
    with working(f"detecting in {given.stack.name}", counts=True) as progress:
        stacks.detect_stack(
            given.stack,
            manifest,
            given.settings.timing,
            **windows,
            detection=None if windows.get("follow") is True else given.settings.detection,
            full_scale=given.scale,
            device=str(given.torch_device),
            progress=progress,
        )
    return stacks.read_manifest(manifest)


@options
class RestoreOptions(shared.RestoredStack, shared.RestorationCommand):
    """Options of ``restore``."""

    vibration: Path = option(...)
    """The vibration.json, or manifest.json of windows, written by detect or run."""
    report: Path | None = None
    """JSON file to write: whether restoration helped, with the measured values."""


def restore_frames(given: RestoreOptions) -> Answer:
    """Restore a stack of frames with a detected vibration.

    The result is judged. If the restored frames are judged no better than the input, the input is written
    unchanged, unless --force is given.
    """
    settings, frames, restored, report = given.settings, given.stack, given.restored, given.report
    outputs = [*io.stack_files(restored), given.manifest, *([] if report is None else [report])]
    shared.check_new(outputs, given.overwrite, [*given.inputs, given.vibration])
    check_regular(given.vibration)
    with given.vibration.open("rb") as file:
        of_windows = b'"rsvib stack"' in file.read(200)  # bytes; the format is the first key of either file
    info, scale, options = given.planned_stack(given.restoration)
    detected = None
    detections: list[DetectedVibration | None] = []
    if of_windows:
        if report is not None:
            raise ValueError("--report needs a vibration.json; the verdict on each window is in its manifest.json")
        window, detections = _detected_windows(given.vibration, settings.timing)
    else:
        timing = io.timing_from_first_frame(settings.timing, info)
        detected, window = reports.read_vibration(given.vibration, timing), max(2, info.shape[0])
        stacks.check_stack_fits(info, options, on_gpu=given.torch_device.type != "cpu")
    if report is not None:
        check_writable(report)
    print_notes(info, settings)
    common = given.of_stack(scale, options) | {"force": given.force, "window": window}
    common["given"] = detections or [detected]
    with working(f"restoring {frames.name}", counts=of_windows) as progress:
        common["progress"] = progress if of_windows else None
        run = stacks.process_stack(frames, restored, settings.timing, **common)
    lines, data = answers.restoration_of(run, restored)
    files, first = [restored, run.manifest], None if run.first is None else run.first.restoration
    if detected is None:
        answer = answers.windows_answer("Vibration", stacks.read_manifest(run.manifest))
    else:
        answer = Answer({"Vibration": [detected.summary()]}, {"detection": detected.to_dict()})
        answer.next_steps += [answers.page_step(frames, frames.with_name("report"), settings)] * run.restored
    answer.results["Restoration"], answer.data["restoration"] = lines, data
    if report is not None and first is not None:
        reports.write_restoration(report, first, options, run.not_kept)
        files.append(report)
    answer.files += files
    return answer


def _detected_windows(path: Path, timing: rsvib_torch.SensorTiming) -> tuple[int, list[DetectedVibration | None]]:
    """Number of frames of the windows of a manifest, and their detections, with the timing of the frames."""
    manifest = stacks.read_manifest(path)
    stored = manifest.timing
    if timing.frame_start_times is None:  # frame times of the file were stored with the detection
        timing = replace(timing, frame_start_times=stored.frame_start_times)
    reports.check_same_timing(str(path), stored, timing)
    window = manifest.settings.get("window")
    if not isinstance(window, int) or any(record.followed is not None for record in manifest.windows):
        followed = "its vibration was followed from frame to frame, and is not that of windows"
        raise ValueError(f"{path}: {followed}; repeat rsvib run, or detect the windows (rsvib detect --window 8)")
    return window, manifest.detections()


@options
class ReportOptions(shared.RestorationCommand, shared.VerdictOptions):
    """Options of ``report``."""

    out: Path = argument()
    """Folder for report.html and its figures."""
    edge: list[str] | None = option(None, metavar="EDGE", show_default="edges are searched for")
    """Slanted edge to measure: TOP,LEFT,HEIGHT,WIDTH in px; may be given several times."""
    manifest: Path | None = None
    """The manifest.json of rsvib run or detect with windows: draw amplitude and frequency over the windows. The page of
    a run that followed the vibration shows the frames of that run, and detects nothing anew."""
    force: bool = False
    """Show the restored frames even if they are judged no better than the input."""


def report(given: ReportOptions) -> Answer:
    """Detect, restore, and write an HTML page with all figures.

    Detection, restoration and verdict are those of rsvib run. The page needs no network; figures are also PNG files.
    """
    settings, frames, out = given.settings, given.stack, given.out
    list(map(_edge_box, given.edge or ()))  # errors before anything is computed
    windows = None if given.manifest is None else stacks.read_manifest(given.manifest)
    inputs = [*given.inputs, *([] if given.manifest is None else [given.manifest])]
    answers.check_folder(out, ["report.html"], given.overwrite, inputs)
    _, _, options = given.planned_restoration(given.restoration)
    if given.manifest is not None and windows is not None and windows.output is not None and windows.is_followed:
        made = given.manifest.with_name(windows.output["name"])
        if windows.totals()["restored"] and made.exists():
            return _report_of_run(given, windows, made)
    pixels, timing = load(given, options)
    detection = _detect(pixels, timing, settings)
    with working("restoring and judging"):
        chosen = RestorationOptions(**options)
        result = stacks.restore_trusted(pixels, timing, detection, chosen, force=given.force, most_pairs=8)
    answers.warn_of_restoration(result, "page")
    pattern = options.get("mosaic")
    steps = []
    if result.restored:
        steps = [answers.next_step("write the restored frames", "run", frames, out, *settings.arguments)]
    elif result.moves:
        forced = ("report", frames, out.with_name(f"{out.name}_forced"), *settings.arguments, "--force")
        steps = [answers.next_step("inspect the restored frames nevertheless", *forced)]
    steps += answers.steps_after_detection(detection, frames, settings)
    answer = answers.stack_answer(frames, detection, None, result, len(pixels))
    if windows is not None and windows.output is not None:  # restored by windows, here as a whole
        title = "Restoration of the page, of one vibration in all frames"
        answer.results[title] = answer.results.pop("Restoration")
        answer.results[f"Restoration according to {given.manifest}"] = windows.lines()[1]
    answer.next_steps += steps
    page = reports.Report(
        **_page_head(given, windows),
        frames=pixels if pattern is None else preparation.colour_frames(pixels, pattern),
        restored=result.frames,
        was_restored=result.restored,
        timing=timing,
        detection=detection,
        verdict=result.verdict,
        left_alone=result.left_alone,
        options=options,
        next_steps=tuple(steps),
    )
    return _write_page(given, page, answer)


def _report_of_run(given: ReportOptions, windows: stacks.StackManifest, made: Path) -> Answer:
    """The page of a run that followed the vibration: two frames in the middle, before and after it."""
    import torch  # noqa: PLC0415

    first, scale = max(windows.input["shape"][0] // 2 - 1, 0), windows.settings["full_scale"]
    of_both = ((given.stack, scale), (made, None if io.is_video(made) else scale))
    before, after = (torch.stack([read_frame(path, first + n, full) for n in (0, 1)]) for path, full in of_both)
    answer = answers.windows_answer(f"Vibration in {given.stack.name}", windows)
    answer.results[f"Restoration according to {given.manifest}"] = windows.lines()[1]
    page = reports.Report(
        **_page_head(given, windows),
        frames=before if windows.margins is None else video.Margins(**windows.margins).cut(before),
        restored=after,
        was_restored=True,
        timing=given.settings.timing,
        first=first,
    )
    return _write_page(given, page, answer)


def _page_head(given: ReportOptions, windows: stacks.StackManifest | None) -> Table:
    """Content of a page apart from the frames."""
    return {
        "title": printable(f"Vibration in {given.stack.name}"),
        "subtitle": printable(f"{given.stack}, camera of {given.settings.source}"),
        "version": rsvib_torch.__version__,
        "command": current_output().command,
        "windows": windows,
    }


def _write_page(given: ReportOptions, page: reports.Report, answer: Answer) -> Answer:
    """Write a page, and add its files to the answer."""
    inputs = [*given.inputs, *([] if given.manifest is None else [given.manifest])]
    with whole_folder(given.out) as folder, working("writing the page"):
        files = reports.write_report_page(folder, page, list(map(_edge_box, given.edge or ())) or None)
        shared.check_new([given.out / name for name in files], overwrite=True, inputs=inputs)
    answer.files += [given.out / name for name in files]
    return answer


def _edge_box(text: str) -> reports.Box:
    """Position of a slanted edge (top, left, height, width) in px."""
    numbers = [int(part) for part in text.split(",") if part.strip().isdecimal()]
    if len(numbers) != 4 or text.count(",") != 3:
        raise ValueError(f"--edge must be TOP,LEFT,HEIGHT,WIDTH in px, got {text!r}")
    top, left, height, width = numbers
    return top, left, height, width
