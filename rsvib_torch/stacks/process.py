"""Processing of stacks of any length: ``iterate_stack``, ``detect_stack`` and ``process_stack``.

One loop: the frames of the source are read in windows; the motion of each window is detected, its frames are restored
and the result is judged (``StackJob.compute``, in threads); finished windows are stored in a folder (``RunFolder``)
and become the output and its manifest (``FileRun``) when all of them are there.
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TypeVar

import torch

from rsvib_torch.checks.arguments import PathLike
from rsvib_torch.execution.parallel import in_threads
from rsvib_torch.files.atomic import check_outputs, check_writable
from rsvib_torch.frames.entry_points import file_options, source_options
from rsvib_torch.io.stack_writing import check_info_target, metadata_not_kept, stack_files, write_frames
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import DetectStackOptions, ProcessStackOptions, Progress, StackOptions
from rsvib_torch.stacks.job import StackJob, WindowFrames, plan_job, read_windows
from rsvib_torch.stacks.manifest import StackManifest, manifest_header
from rsvib_torch.stacks.memory import share_one_heap
from rsvib_torch.stacks.run_folder import FileRun, StackReport, check_space
from rsvib_torch.stacks.windows import Window, WindowRecord, WindowResult

_Result = TypeVar("_Result")
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
    yield from _in_threads(job, job.compute, windows, at_once)


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
    records: list[WindowRecord] = []
    count = _counter(options.progress, windows, windows)
    with closing(_in_threads(job, job.compute, windows, at_once)) as results:
        for result in results:
            records.append(WindowRecord.of(result, job.timing, written=0))
            if _all_failed(records, len(windows)):
                raise ValueError(records[0].error)
            count(result.window.kept)
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
    # 1. What is computed, and what is written.
    sink, compression = Path(sink), options.compression
    job, windows, at_once = plan_job(source, timing, options)
    out = job.info.with_frames(len(windows) if job.is_joined else job.info.shape[0])
    out = job.content(out.restored_as(job.chosen.scale, job.chosen.mosaic), timing)
    form = check_info_target(sink, out, compression, parent_exists=False)
    run = FileRun(sink, options, manifest_header(job, sink.name, compression), stack_files(source))
    # 2. A complete output is not computed again.
    finished = run.finished()
    if finished is not None:
        return finished
    with run.folder() as folder:
        records = folder.records()
        missing, resumed = [window for window in windows if window.index not in folder], len(records)
        # the finished windows and the output are on the disk together, until the output is complete
        stored = len(missing) if job.is_joined else sum(window.kept for window in missing)
        stored += out.shape[0] if compression is None and form.uncompressed else 0
        check_space(sink, stored * out.frame_bytes)
        # 3. The windows that are not in the folder: read, detected, restored, judged, stored.
        first: WindowResult | None = None
        count = _counter(options.progress, windows, missing)
        with closing(_in_threads(job, job.compute_stored, missing, at_once)) as results:
            for window, (record, frames, result) in zip(missing, results, strict=True):
                records.append(record)
                first = first or result
                if _all_failed(records, len(windows)):
                    folder.remove()
                    raise ValueError(records[0].error)
                folder.add(record, frames)
                count(window.kept)
        # 4. The output from the windows in the folder, and the manifest.
        with run.writing(folder, not_kept=metadata_not_kept(job.info, sink, out.shape)) as manifest:
            write_frames(form, sink, out, folder.frames(), compression)
    return run.report(manifest, resumed, first)


def _in_threads(
    job: StackJob, compute: Callable[[Window, WindowFrames], _Result], windows: Sequence[Window], at_once: int
) -> Generator[_Result, None, None]:
    """Results of ``compute`` of windows and their frames, in order; later windows are read and computed meanwhile."""
    share_one_heap()
    # Sums of floats depend on the number of threads: results must not depend on how many windows are computed at once.
    threads = torch.get_num_threads() if all(window.alone for window in windows) else 1
    return in_threads(compute, read_windows(job, windows), at_once=at_once, threads=threads)


def _all_failed(records: Sequence[WindowRecord], count: int) -> bool:
    """Whether detection has failed in every window so far: in eight, or in all of fewer (``count``)."""
    return len(records) >= min(_MAX_INITIAL_FAILURES, count) and all(record.error for record in records)


def _counter(progress: Progress, windows: Sequence[Window], missing: Sequence[Window]) -> Callable[[int], None]:
    """A function that reports the progress after a number of further frames; those of finished windows are counted."""
    done, total = 0, windows[-1].last + 1

    def count(frames: int) -> None:
        nonlocal done
        done += frames
        if progress is not None:
            progress(done, total)

    count(total - sum(window.kept for window in missing))
    return count
