"""What the commands do with a stack: read it, detect, restore and judge, write."""

import inspect
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from rsvib_torch.commands.terminal import error_line, say, working
from rsvib_torch.config import Config
from rsvib_torch.core.checks import check_number
from rsvib_torch.detection import DetectionResult, detect_vibration
from rsvib_torch.io import StackInfo, exposure_times, read_stack, read_stack_info, timing_from_first_frame, write_stack
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.report.plots import offset_figure, save_figure
from rsvib_torch.report.results import write_offsets, write_restoration, write_vibration
from rsvib_torch.restoration import RestorationVerdict, restore
from rsvib_torch.restoration.restore import method_options
from rsvib_torch.restoration.verdict.trust import Detected
from rsvib_torch.stacks import RestoredFrames, restore_trusted

__all__ = [
    "DeviceName",
    "Restored",
    "Stack",
    "Wishes",
    "chosen_device",
    "detect_frames",
    "full_scale_of",
    "load",
    "restoration_options",
    "restore_and_judge",
    "save",
    "tell_restoration",
    "write_detection",
]

DeviceName = Literal["auto", "cpu", "cuda"]
_DEFAULT_METHOD = inspect.signature(restore).parameters["method"].default
_JUDGED_PAIRS = 8  # of a stack, evenly spread


@dataclass(frozen=True)
class Stack:
    """Frames in memory, how their file keeps them, and the sensor with the frame times of the file."""

    frames: Tensor
    info: StackInfo
    full_scale: float | None
    timing: SensorTiming


@dataclass(frozen=True)
class Wishes:
    """What the command line says about restoration; None leaves it to the config."""

    method: str | None
    joint: str | None
    prior: str | None
    saturation: float | None
    force: bool


@dataclass(frozen=True)
class Restored:
    """Frames to write, and what is known of them."""

    frames: Tensor
    restored: bool
    options: dict[str, Any]
    left_alone: tuple[str, ...]
    verdict: RestorationVerdict | None

    def write_report(self, path: Path) -> None:
        """Write what was restored, how, and whether it helped."""
        write_restoration(path, self.verdict, restored=self.restored, options=self.options, left_alone=self.left_alone)


def chosen_device(name: DeviceName) -> torch.device:
    """The device of that name; ``auto`` takes a GPU if there is one."""
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: there is no CUDA device here; use auto or cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def full_scale_of(path: Path, info: StackInfo, config: Config, option: float | None) -> float | None:
    """Full scale of a stack: the option first, then what the file says or 8 bits mean, then the config."""
    if option is not None or not info.is_integer:
        return option
    if info.full_scale is None:
        return config.full_scale
    if info.dtype != "uint8" and config.full_scale not in (None, info.full_scale):
        raise ValueError(
            f"{path} states full_scale={info.full_scale:g}, the config {config.full_scale:g}; say which: --full-scale"
        )
    return info.full_scale


def load(path: Path, config: Config, option: float | None, device: torch.device) -> Stack:
    """Read a stack; ``option`` is the full scale of the command line."""
    info = read_stack_info(path)
    scale = full_scale_of(path, info, config, option)
    with working(f"reading {path}"):
        frames = read_stack(path, full_scale=scale)
    timing = timing_from_first_frame(config.timing, info)
    info = replace(info, frame_times=exposure_times(info, config.timing), times_of_playback=False)
    return Stack(frames.to(device), info, scale, timing)


def save(path: Path, frames: Tensor, stack: Stack) -> None:
    """Write frames in the type and full scale of the stack they come from."""
    with working(f"writing {path.name}"):
        write_stack(path, frames, dtype=stack.info.dtype, full_scale=stack.full_scale, like=stack.info)


def detect_frames(stack: Stack, config: Config) -> DetectionResult:
    """Detect the vibration as the config says."""
    with working("detecting the vibration"):
        found: DetectionResult = detect_vibration(stack.frames, stack.timing, **config.detection)
    return found


def _frames_together(text: str | None) -> bool | int | None:
    """What ``--joint`` says: all frames, or how many neighbours."""
    if text is None or text == "all":
        return None if text is None else True
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"--joint must be 'all' or a number of frames, got {text!r}")
    return int(text)


def restoration_options(info: StackInfo, full_scale: float | None, config: Config, wishes: Wishes) -> dict[str, Any]:
    """Options of ``restore``: the config's, and those of the command line before them."""
    options = dict(config.restoration)
    if wishes.method is not None and wishes.method != options.get("method", _DEFAULT_METHOD):
        known = ("saturation", *method_options(wishes.method))  # the others were meant for the config's method
        options = {name: value for name, value in options.items() if name in known}
    given = {
        "method": wishes.method,
        "joint": _frames_together(wishes.joint),
        "prior": wishes.prior,
        "saturation": wishes.saturation,
    }
    options |= {name: value for name, value in given.items() if value is not None}
    counts = info.is_integer and full_scale is not None
    if options.get("saturation") is not None:
        level = check_number("saturation", options["saturation"], above=0.0)
        options["saturation"] = level / full_scale if counts and full_scale else level
    elif counts:
        options["saturation"] = 1.0
    return options


def restore_and_judge(stack: Stack, config: Config, detected: Detected, wishes: Wishes) -> Restored:
    """Restore frames and judge the result; an axis that is not known well enough is left alone."""
    options = restoration_options(stack.info, stack.full_scale, config, wishes)
    with working("restoring the frames and judging the result"):
        result = restore_trusted(
            stack.frames, stack.timing, detected, options, force=wishes.force, most_pairs=_JUDGED_PAIRS
        )
    tell_restoration(result)
    return Restored(result.frames, result.restored, options, result.left_alone, result.verdict)


def tell_restoration(result: RestoredFrames) -> None:
    """Say which axes were left alone, and whether restoration helped."""
    for note in result.left_alone:
        say(note)
    if not result.moves:
        error_line("there is no vibration to undo: frames are left as they are", "warning")
    elif result.verdict is None:
        say("whether restoration helps cannot be told: no two frames show the same scene")
    elif result.verdict.overall in ("partly", "worse"):
        rest = "" if result.restored else "; frames are left as they are, --force restores them all the same"
        error_line(result.verdict.summary + rest, "warning")
    else:
        say(result.verdict.summary)


def write_detection(folder: Path, result: DetectionResult, timing: SensorTiming) -> None:
    """Write what was detected into a folder."""
    with working("drawing the offset curve"):
        write_vibration(folder / "vibration.json", result, timing)
        write_offsets(folder / "offsets.csv", result)
        save_figure(offset_figure(result), folder / "offsets.png")
