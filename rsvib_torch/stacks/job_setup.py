"""What every run over a stack begins with: the job, from what was asked for and what the file says."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from rsvib_torch.core.checks import check_choice, check_whole_number
from rsvib_torch.io.files import PathLike, open_stack
from rsvib_torch.io.full_scale import check_full_scale
from rsvib_torch.io.schema import DetectedVibration
from rsvib_torch.io.stack_info import timing_of_stack
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.stacks.job import BadFrames, StackJob
from rsvib_torch.stacks.memory import parse_memory, windows_at_once

__all__ = ["DEFAULT_WINDOW", "HOPELESS", "job_windows_at_once", "make_job"]

DEFAULT_WINDOW = 8  # frames
HOPELESS = 8  # windows that fail one after another from the start before a run gives up


def _device(device: str) -> str:
    check_choice("device", device.partition(":")[0], ("auto", "cpu", "cuda"))
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return device


def make_job(
    source: PathLike,
    timing: SensorTiming,
    *,
    detection: Mapping[str, Any] | None,
    restoration: Mapping[str, Any] | None,
    given: Sequence[DetectedVibration | None] | None,
    full_scale: float | None,
    bad_frames: BadFrames,
    force: bool,
    device: str,
) -> StackJob:
    """What to do with every window: options checked, full scale and frame times from the file where none are given.

    Raises:
        OSError: If the stack cannot be read.
        TypeError: If an option is not known.
        ValueError: If a value is out of range, or does not fit the stack.
    """
    check_choice("bad_frames", bad_frames, get_args(BadFrames))
    reader = open_stack(source)
    reader.close()
    info = reader.info
    if info.is_integer:
        scale = info.full_scale if full_scale is None else full_scale
        if scale is None:
            raise ValueError(
                f"{source}: {info.dtype} frames do not say their full scale; state full_scale, e.g. 4095 for 12-bit "
                "counts"
            )
        full_scale = check_full_scale(scale, np.dtype(info.dtype))
    else:
        full_scale = None
    timing = timing_of_stack(timing, info)
    timing.frame_starts(info.shape[0])
    timing.check_rows(info.shape[-1 if timing.scan_axis == -1 else -2])
    options = dict(detection or {})
    for name in ("window", "window_step"):
        if name in options:
            raise TypeError(f"{name!r} is no option of detection here: a stack is cut into windows by window=")
    if options.get("model", "tones") != "tones":
        raise ValueError(f"model={options['model']!r}: in windows only tones are detected; see detect_vibration")
    return StackJob(
        Path(source),
        info,
        timing,
        full_scale,
        options,
        None if restoration is None else dict(restoration),
        None if given is None else dict(enumerate(given)),
        bad_frames,
        force,
        _device(device),
    )


def job_windows_at_once(job: StackJob, window: int, memory: str | float | None, workers: int | None) -> int:
    """Windows to work on at once: what there are processors for, and memory.

    Raises:
        ValueError: If not even one window fits into the memory that was stated.
    """
    most = check_whole_number("workers", workers, at_least=1) if workers is not None else _processors(job.device)
    limit = None if memory is None else parse_memory(memory)
    return windows_at_once(job.info, window, memory=limit, most=most, restoration=job.restoration)


def _processors(device: str) -> int:
    if device != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
