"""Processing of stacks of any length: ``iterate_stack``, ``detect_stack`` and ``process_stack``."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from rsvib_torch.checks.arguments import PathLike
from rsvib_torch.execution.parallel import in_threads
from rsvib_torch.files.atomic import check_outputs, check_writable
from rsvib_torch.files.reading import Table
from rsvib_torch.frames.entry_points import file_options, source_options
from rsvib_torch.io.stack_writing import check_info_target, metadata_not_kept, stack_files, write_frames
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import DetectStackOptions, ProcessStackOptions, Progress, StackOptions
from rsvib_torch.stacks.job import StackJob, StoredWindow, WindowFrames, WindowResult, plan_job, read_windows
from rsvib_torch.stacks.manifest import StackManifest, manifest_header
from rsvib_torch.stacks.memory import share_one_heap
from rsvib_torch.stacks.run_folder import RunFolder, StackReport, check_space, run_to_file
from rsvib_torch.stacks.windows import Window

_Result = TypeVar("_Result")
_UNCOMPRESSED = ("npy", "hdf5", "tiff")  # formats whose files have the size of their pixels
_MAX_INITIAL_FAILURES = 8  # windows; a run stops if all windows up to this number fail


@source_options(StackOptions)
def iterate_stack(source: PathLike, timing: SensorTiming, options: StackOptions) -> Iterator[WindowResult]:
    """Restore a stack of any length window by window; each is available as soon as it is complete.

    A stack is cut into windows of at most ``window`` frames that share one frame with their neighbours. Each window is
    processed as a separate stack, with the time origin at its first frame. Later windows are read and computed
    meanwhile.

    Args:
        source: The stack, as in ``read_stack``.
        timing: The sensor. If it has no frame start times and the file states them, those of the file are used.
        options: Options.

    Yields:
        One ``WindowResult`` per window, in order.

    Raises:
        ValueError: If a value is out of range, the stack is not readable, or a window does not fit into the memory.

    Example:
        >>> for result in iterate_stack("frames.tif", timing, window=3):  # doctest: +SKIP
        ...     print(result.indices, result.detection.vibration.frequency[:, 0].round().tolist())
        (0,) [110.0, 90.0]
        (1, 2, 3) [110.0, 90.0]
    """
    job, windows, at_once = plan_job(source, timing, options)
    yield from _computed(job, windows, lambda result, _: result, at_once=at_once)


@file_options(DetectStackOptions)
def detect_stack(source: PathLike, sink: PathLike, timing: SensorTiming, options: DetectStackOptions) -> None:
    """Detect the vibration in every window of a stack of any length.

    Args:
        source: As in ``iterate_stack``.
        sink: The ``manifest.json`` to write; ``read_manifest`` reads it, ``process_stack(given=...)`` uses it.
        timing: As in ``iterate_stack``.
        options: Options.

    Raises:
        ValueError: If detection fails in all first windows, or ``sink`` is a file of the stack.
    """
    job, windows, at_once = plan_job(source, timing, options)
    check_outputs([sink], stack_files(source))
    check_writable(Path(sink))
    results = _computed(job, windows, lambda result, _: (list[Array](), job.record(result, 0)), at_once=at_once)
    records = (record for _, record in _watched(results, windows, windows, [], options.progress))
    StackManifest(**manifest_header(job, None, None), windows=tuple(records)).save(sink)


@file_options(ProcessStackOptions)
def process_stack(source: PathLike, sink: PathLike, timing: SensorTiming, options: ProcessStackOptions) -> StackReport:
    """Restore a stack of any length from file to file.

    The stack is cut into windows as in ``iterate_stack``. They depend only on the number of frames and ``window``, and
    each is computed on one thread: results do not depend on memory and workers. The output gets its name
    when it is complete; until then it is stored in the folder ``.NAME.rsvib`` beside it, from which an interrupted run
    can be resumed. Memory does not grow with the number of frames.

    Frames that cannot be read or used (constant, infinite, beyond full scale) are listed in the manifest; the other
    frames of their window are restored without them. A window in which the detection fails is written unchanged.

    Args:
        source: The stack, as in ``read_stack``.
        sink: The stack to write, as in ``write_stack``; data type, full scale, resolution, frame times and metadata are
            kept as far as the format supports them.
        timing: As in ``iterate_stack``.
        options: Options.

    Returns:
        Summary of the run.

    Raises:
        FileExistsError: If there is an interrupted run and ``resume`` is False.
        ModuleNotFoundError: If an optional package is missing, with the extra to install.
        OSError: If a file cannot be read or written; the run can then be resumed.
        ValueError: If a value is out of range, the stack is not readable, a window does not fit into the memory,
            detection fails in all first windows, an output is or contains the input or lies inside it, input, settings
            or versions differ from those of the run to resume.

    Example:
        >>> import tempfile
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, _ = example_frames(num_frames=4)
        >>> folder = tempfile.mkdtemp()
        >>> rsv.write_stack(f"{folder}/frames.npy", frames)
        >>> options = {"window": 3, "detection": {"tones": 1}, "restoration": {"method": "dewarp"}}
        >>> report = rsv.process_stack(f"{folder}/frames.npy", f"{folder}/restored.npy", timing, **options)
        >>> report.windows, report.restored, report.bad_frames
        (2, 2, 0)
        >>> rsv.read_stack(f"{folder}/restored.npy").shape == frames.shape
        True
    """
    sink = Path(sink)
    compression = options.compression
    job, windows, at_once = plan_job(source, timing, options)
    joined = job.chosen.joint is True
    out = job.info.with_frames(len(windows) if joined else job.info.shape[0])
    out = out.restored_as(job.chosen.scale, job.chosen.mosaic)
    out = job.content(out, timing)
    form = check_info_target(sink, out, compression, check_folder=False)
    first: WindowResult | None = None

    def finish(result: WindowResult, pixels: WindowFrames) -> StoredWindow:
        nonlocal first
        if result.window.index == 0:
            first = result
        return job.stored(result, pixels)

    def compute(folder: RunFolder) -> Table:
        remaining = [window for window in windows if window.index not in folder]
        count = len(remaining) if joined else sum(window.kept for window in remaining)
        # the finished windows and the output are on the disk together, until the output is complete
        count += out.shape[0] if compression is None and form.name in _UNCOMPRESSED else 0
        check_space(sink, count * out.frame_bytes)
        results = _computed(job, remaining, finish, at_once=at_once)
        errors = [record.error for record in folder.records()]
        for frames, record in _watched(results, windows, remaining, errors, options.progress, folder.remove):
            # channels may be stored last
            folder.add(record, array=np.ascontiguousarray(np.stack(frames)) if frames else None)
        return {"not_kept": metadata_not_kept(job.info, sink, out.shape)}

    def stored(folder: RunFolder) -> Iterator[Array]:
        for name in folder.files():
            with folder.open(name) as file:
                yield from np.load(file, allow_pickle=False)

    def write(folder: RunFolder) -> None:
        write_frames(form, sink, out, stored(folder), compression)

    report = run_to_file(
        sink,
        options,
        manifest_header(job, sink.name, compression),
        inputs=stack_files(source),
        compute=compute,
        write=write,
    )
    return replace(report, first=first)


def _computed(
    job: StackJob, windows: Sequence[Window], finish: Callable[[WindowResult, WindowFrames], _Result], *, at_once: int
) -> Generator[_Result, None, None]:
    """Compute windows, in order; ``finish`` gets a result and its frames in the thread that computed it."""

    def compute(window: Window, pixels: WindowFrames) -> _Result:
        return finish(job.compute(window, pixels), pixels)

    share_one_heap()
    # Sums of floats depend on the number of threads: results must not depend on how many windows are computed at once.
    threads = torch.get_num_threads() if all(window.alone for window in windows) else 1
    return in_threads(compute, read_windows(job, windows), at_once=at_once, threads=threads)


def _watched(
    results: Generator[StoredWindow, None, None],
    windows: Sequence[Window],
    remaining: Sequence[Window],
    errors: list[str | None],
    progress: Progress,
    fail: Callable[[], None] = lambda: None,
) -> Iterator[StoredWindow]:
    """The results of the remaining windows, while their frames are counted.

    If detection has failed in every window so far (``errors`` before these), ``fail`` is called, and it is an error.
    """
    total = windows[-1].last + 1
    done = total - sum(window.kept for window in remaining)
    if progress is not None:
        progress(done, total)
    with closing(results):
        for window, stored in zip(remaining, results, strict=True):
            errors.append(stored[1].error)
            if len(errors) >= min(_MAX_INITIAL_FAILURES, len(windows)) and all(errors):
                fail()
                raise ValueError(errors[0])
            yield stored
            done += window.kept
            if progress is not None:
                progress(done, total)
