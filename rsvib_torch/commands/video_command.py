"""``rsvib run --video`` of a video: it is followed from frame to frame, restored and steadied."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsvib_torch import io, stacks
from rsvib_torch import report as reports
from rsvib_torch.commands.answers import page_step
from rsvib_torch.commands.terminal import Answer, counting, error_line
from rsvib_torch.commands.written_results import draw_safely, write_windows
from rsvib_torch.core.atomic import whole_folder
from rsvib_torch.core.text import number_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rsvib_torch.config import Config


def is_followed(frames: Path, count: int, window: int, *, requested: bool) -> bool:
    """Whether ``--video`` follows a stack from frame to frame: videos of more than one window, or if requested."""
    from rsvib_torch.io.stack_format import split_range  # noqa: PLC0415 - loads PyTorch, which others do not need
    from rsvib_torch.io.video import ENDINGS  # noqa: PLC0415

    return requested or (split_range(frames)[0].suffix.lower() in ENDINGS and count > window)


def check_followed(given: Mapping[str, Any], options: Mapping[str, Any]) -> None:
    """Refuse options that only windows have: those ``given`` on the command line, and those of ``restore``."""
    others = {"--joint": options.get("joint"), "--scale": options.get("scale", 1) != 1}
    others |= {"--mosaic": options.get("mosaic"), "--optics-sigma": options.get("optics")}
    names = [name for name, value in {**given, **others}.items() if value]
    if names:
        raise ValueError(
            f"{', '.join(names)} cannot be used with --video, which follows the frames one by one; give --output "
            "restored.mp4 instead of --video, which processes windows"
        )


def run_followed(
    frames: Path,
    out: Path,
    output: str,
    settings: Config,
    options: dict[str, Any],
    pixel_size: float | None,
    **others: Any,
) -> Answer:
    """Process a video; ``others`` are options of ``process_video``."""
    with counting(f"restoring {frames.name}") as progress:
        result = stacks.process_video(
            frames,
            out / output,
            settings.timing,
            restoration=options,
            manifest=out / "manifest.json",
            progress=progress,
            **others,
        )
    stored = stacks.read_manifest(out / "manifest.json")
    drawn = draw_safely(out / "before_after.png", lambda: _followed_figure(frames, out / output, stored))
    with whole_folder(out) as folder:
        names = [output, *drawn, "manifest.json", *write_windows(folder, out / "manifest.json", pixel_size)]
    if result.bad_frames:
        bad = number_of(result.bad_frames, "frame")
        error_line(f"{bad} could not be used and repeat the frame before: see manifest.json", "warning")
    if not result.restored:
        error_line("no vibration to remove: the frames are written unchanged", "warning")
    worse = [record for record in stored.windows if record.outcome == "worse"]
    if worse:
        where = f"{len(worse)} of {number_of(result.windows, 'part')} of the video"
        error_line(f"the restored frames are judged worse than the input in {where}: {worse[0].summary}", "warning")
    vibration, lines = stored.lines(pixel_size)
    for name, where in (("frame_to_frame", "from frame to frame"), ("rows", "between the rows of a frame")):
        if stored.shaking is not None:
            before, after = stored.shaking[name]
            lines.append(f"shaking {where}: {before:.2g} px rms, {after:.2g} px afterwards")
    return Answer(
        {f"Vibration in {frames.name}": vibration, "Restoration": [result.summary(), *lines[1:]]},
        {"windows": stored.totals(), "shaking": stored.shaking},
        [out / name for name in names],
        [page_step(frames, out / "report", settings, "--manifest", out / "manifest.json")],
    )


def _followed_figure(frames: Path, restored: Path, manifest: stacks.StackManifest) -> Figure:
    """Draw one of the first frames of a video beside the restored one."""
    from rsvib_torch.io.full_scale import counts_to_frames  # noqa: PLC0415
    from rsvib_torch.tracking import Margins  # noqa: PLC0415

    images = []
    for path in (frames, restored):
        reader = io.open_stack(path)
        pixels = reader.frame(min(8, reader.info.shape[0] // 2))[None]  # earlier ones must be decoded as well
        scale = manifest.settings["full_scale"] if path == frames else reader.info.full_scale
        images.append(counts_to_frames(pixels, scale, str(path))[0].nan_to_num(0.0))
        reader.close()
    margins = manifest.margins
    if margins is not None:
        images[0] = Margins(**margins).cut(images[0])
    return reports.comparison_figure(*images)
