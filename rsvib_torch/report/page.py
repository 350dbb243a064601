"""The page of ``rsvib run --report``: verdict, frames before and after, figures and texts, in one file."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path

import cv2
import jinja2
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from rsvib_torch.detection import DetectionResult
from rsvib_torch.files.atomic import whole
from rsvib_torch.files.reading import Table
from rsvib_torch.frames.pixels import enlarged
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, blind_frequencies
from rsvib_torch.report import plots
from rsvib_torch.restoration import trusted_vibration
from rsvib_torch.stacks import StackManifest
from rsvib_torch.text import data_uri

# Compression of frames. Size of a frame of 2048² px (noise 0.003) on the page, rms error in grey levels: grey 2.2 MB,
# 1.4; colour 2.7 MB, 1.7. With quality 85: 1.2 MB, 2.4 and 2.9. As PNG: 3.7 MB, 11 MB.
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
_LARGEST = 4096  # px; longer sides of a frame are reduced
_PERCENTILES = (0.2, 99.8)  # drawn black and white; few saturated or dead pixels do not reduce the contrast
_PART = 480  # px; side of the part of two consecutive frames that is shown in turn
_RIM = 16  # px at the border of restored frames, which the extension of the frames changes


@dataclass(frozen=True, eq=False)
class Report:
    """Content of a page."""

    title: str  # heading
    subtitle: str  # line below
    frames: Tensor  # (T, H, W) or (T, C, H, W) input frames, full scale 1
    timing: SensorTiming  # the sensor
    # frames after restoration, or one frame restored jointly from all, on a finer grid with as many times the rows and
    # columns; None if they were left unchanged
    restored: Tensor | None = None
    # the detection (not a batch); None: the frames are those of a run that measured another motion, with ``windows``
    detection: DetectionResult | None = None
    outcome: str | None = None  # ``RestorationVerdict.overall``; None if the frames could not be compared
    windows: StackManifest | None = None  # windows of the stack that were processed separately; None if there are none
    texts: Mapping[str, str] = field(default_factory=dict)  # summaries of results, by their headings
    next_steps: Sequence[str] = ()  # what to do next: sentences, with the command that does it on a line of its own
    first: int = 0  # number of the first of the frames
    made_with: str = ""  # program and command line


def headline(report: Report) -> tuple[str, str]:
    """Overall result: ``"good"``, ``"doubt"`` or ``"bad"``, which selects its colour, and its sentence."""
    result, windows = report.detection, report.windows
    totals: Table = {} if windows is None else windows.totals()
    mark = "doubt"
    if report.restored is None and totals.get("restored"):
        text = "These frames are unchanged; other windows of the stack were restored, see below."
    elif report.restored is None and report.outcome is None:
        text = "No vibration was found that can be removed; the frames are unchanged."
    elif report.restored is None:
        mark, text = "bad", "Restoration does not improve the frames; they are unchanged."
    elif result is None:
        mark = "good" if totals["outcomes"].get("helps") == totals["windows"] else "doubt"
        is_video = windows is not None and "video" in windows.settings
        what = "The camera was followed from frame to frame; its motion" if is_video else "The vibration changes; it"
        text = f"{what} was measured and removed by rsvib run."
    elif report.outcome == "worse" or not bool(result.reliable.any()):
        mark = "bad"
        text = "The detected vibration is not reliable; inspect the restored frames before you use them."
    elif report.outcome in ("unknown", None):
        text = "The vibration was measured; these frames are not sufficient to determine whether restoration helps."
    elif report.outcome == "helps" and bool(result.reliable.all()):
        mark = "good"
        text = "The vibration of the camera was measured and removed; restoration improves the frames."
    else:
        text = "The vibration was measured and removed in part."
    return mark, text


# --- Frames ---


def encoded(images: Sequence[Tensor]) -> tuple[list[str], str]:
    """Images (H, W) or (C, H, W) of one shape as data URIs with the same grey scale, and a sentence that states it."""
    pixels = [plots.picture(image).flip(-1).numpy() for image in images]  # OpenCV: blue, green, red
    scale = _LARGEST / max(pixels[0].shape[:2])
    note = ""
    if scale < 1:
        pixels = [cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for image in pixels]
        note = f" reduced to {100 * scale:.2g} %,"
    values = np.concatenate([image[np.isfinite(image)] for image in pixels])
    low, high = np.percentile(values, _PERCENTILES) if len(values) else (0.0, 1.0)
    uris = []
    for image in pixels:
        levels = np.nan_to_num((image - low) / max(high - low, 1e-6)).clip(0, 1) * 255
        _, content = cv2.imencode(".jpeg", levels.round().astype(np.uint8), _JPEG)
        uris.append(data_uri(content.tobytes(), "image/jpeg"))
    return uris, f"Grey levels are stretched,{note} black is {low:.3f} and white {high:.3f} of full scale."


def whole_frame(report: Report, index: int) -> Table:
    """An input frame, and the restored one in its place."""
    images, joint = [report.frames[index]], False
    if report.restored is not None:
        joint = len(report.restored) == 1
        images.append(report.restored[min(index, len(report.restored) - 1)])
    uris, note = encoded(images)
    which = f"Frame {report.first + index}{', and one image restored jointly from all frames' * joint}."
    return {"panels": [("", uris)], "label": "Show the restored frame", "caption": f"{which} {note}"}


def frames_in_turn(report: Report, index: int, image_motion: Tensor) -> Table | None:
    """Two consecutive frames before and after restoration, at full resolution where detail is strongest.

    Uniform motion along the image is compensated by whole px, the same for input and restored frames, so that the
    displacement by the vibration remains.
    """
    count = len(report.frames)
    if count < 2:
        return None
    first, starts = min(index, count - 2), report.timing.frame_starts(count)
    right, down = (image_motion[:2] * float(starts[first + 1] - starts[first])).round().int().tolist()
    height, width = report.frames.shape[-2:]
    if min(height - abs(down), width - abs(right)) < 32:  # px; the frames have too little in common
        return None
    # the part of the first frame that both contain, and what the second one shows of it
    inner = (..., slice(max(0, -down), height - max(0, down)), slice(max(0, -right), width - max(0, right)))
    stacks = {"input": report.frames}
    if report.restored is not None and len(report.restored) == count:
        stacks["restored"] = report.restored
    pairs = [
        (stack[first][inner], stack[first + 1].roll((-down, -right), (-2, -1))[inner]) for stack in stacks.values()
    ]
    grey = plots.picture(pairs[-1][0]).mean(-1)
    size = min(_PART, *grey.shape)
    ((row, column),) = plots.detailed_places(grey, size, count=1, rim=_RIM)
    part = (..., slice(row, row + size), slice(column, column + size))
    uris, _ = encoded([image[part] for pair in pairs for image in pair])
    numbers = f"Frames {report.first + first} and {report.first + first + 1}"
    top, left = row + max(0, -down), column + max(0, -right)
    caption = f"{numbers}, rows {top} … {top + size - 1}, columns {left} … {left + size - 1}."
    if right or down:
        shift = f"{-right} px along x and {-down} px along y"
        caption += f" Frame {report.first + first + 1} is moved by {shift}, the uniform motion."
    caption += " The motion between the input frames is the vibration"
    caption += "; restored frames do not move where it was removed." if len(stacks) > 1 else "."
    panels = [(name, uris[2 * number : 2 * number + 2]) for number, name in enumerate(stacks)]
    return {"panels": panels, "label": f"Show frame {report.first + first + 1}", "caption": caption}


# --- Figures ---


def _shown_index(report: Report) -> int:
    """Place of the frame that is compared: an image that was restored jointly from all frames with the middle one."""
    count, restored = len(report.frames), report.restored
    return count // 2 if restored is not None and len(restored) < count else 0


def frames_figure(report: Report) -> Figure:
    """Draw the parts of a frame with the strongest detail, before and after restoration."""
    index = _shown_index(report)
    before = report.frames[index].nan_to_num(0.0)
    if report.restored is None:
        return plots.comparison_figure(before, before, names=("input", "unchanged"))
    after = report.restored[min(index, len(report.restored) - 1)].nan_to_num(0.0)
    if after.ndim > before.ndim:  # grey frames in a video of colours
        after = after.mean(0)
    return plots.comparison_figure(enlarged(before, after.shape[-1] // before.shape[-1]), after)


def figures_of(report: Report, removed: Vibration | None) -> Iterator[tuple[str, str, Callable[[], Figure]]]:
    """Name of the file, caption, and drawing of everything that the page shows."""
    if report.restored is not None:
        points = report.restored.shape[-1] // report.frames.shape[-1]
        grid = f", which have {points} x {points} points per px" if points > 1 else ""
        caption = f"Parts of both frames with the strongest detail{grid}; each pair has a grey scale of its own."
        yield "before_after", caption, partial(frames_figure, report)
    if report.detection is not None:
        caption = "Measured offsets of the rows between frames, offsets by the detected vibration, and the residual."
        yield "offsets", caption, report.detection.plot
    if removed is not None and bool(removed.moving_axes().any()):
        num_rows = report.frames.shape[int(report.timing.scan_axis)]
        caption = "Point spread functions of rows of frame 0, and the path of the image during their exposure."
        yield "psf", caption, partial(plots.psf_figure, removed, report.timing, num_rows)
    if report.windows is not None and report.windows.gyroscope is None:  # no tones are searched for otherwise
        caption = "Amplitude and frequency over the windows, with two standard deviations."
        yield "windows", caption, report.windows.plot


# --- Page ---


def _camera(timing: SensorTiming) -> str:
    """The camera in a sentence."""
    blind = ", ".join(f"{value:.1f}" for value in blind_frequencies(timing, 4.5 / timing.frame_period).tolist())
    std = f" ± {1e6 * timing.row_time_std:.2g}" if timing.row_time_std > 0 else ""
    return (
        f"row time {1e6 * timing.row_time:g}{std} µs, exposure {1e3 * timing.exposure_time:.4g} ms "
        f"({timing.exposure_rows:g} row times), frame period {timing.frame_rows:g} row times ({timing.frame_rate:.2f} "
        f"frames per second), read along {'x' if timing.scan_axis == -1 else 'y'}, {timing.readout_direction}; "
        f"blind frequencies {blind}, … Hz"
    )


def write_report_page(folder: Path, report: Report) -> list[str]:
    """Write ``report.html`` and its figures as PNG files into an existing folder; returns the names of the files.

    A figure that the folder has already is not drawn again.
    """
    result, timing, finer, index = report.detection, report.timing, report.restored, _shown_index(report)
    # the motion that was removed, at the centre of the frame
    removed, image_motion = None, torch.zeros(2)
    if result is not None:
        removed = trusted_vibration(result, timing)[0].to("cpu").translation()
        image_motion = removed.image_motion
    elif report.windows is not None:
        motion = report.windows.windows[0].motion
        image_motion = image_motion if motion is None else motion.tones.image_motion
    figures = []
    for name, caption, draw in figures_of(report, removed):
        path = folder / f"{name}.png"
        if not path.exists():
            plots.save_figure(draw(), path)
        figures.append((name, caption, data_uri(path.read_bytes(), "image/png")))
    if finer is not None:  # frames are shown on the grid of pixels
        points = finer.shape[-1] // report.frames.shape[-1]
        report = replace(report, restored=finer[..., ::points, ::points])
    mark, sentence = headline(report)
    options: Table = {"autoescape": True, "undefined": jinja2.StrictUndefined}
    environment = jinja2.Environment(**options, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(Path(__file__).with_name("report.html").read_text(encoding="utf-8"))
    text = template.render(
        report=report,
        mark=mark,
        headline=sentence,
        frames=[shown for shown in (whole_frame(report, index), frames_in_turn(report, index, image_motion)) if shown],
        figures=figures,
        camera=_camera(timing),
        created=datetime.now().astimezone().isoformat(" ", "seconds"),
    )
    with whole(folder / "report.html") as part:
        part.write_text(text, encoding="utf-8")
    return ["report.html", *(f"{name}.png" for name, _, _ in figures)]
