"""Processing of stacks of any length: ``iterate_stack``, ``detect_stack`` and ``process_stack``."""

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.arguments import checks_arguments
from rsvib_torch.core.atomic import whole_file
from rsvib_torch.core.outputs import check_outputs
from rsvib_torch.io.frame_times import exposure_times
from rsvib_torch.io.stack_reading import PathLike
from rsvib_torch.io.stack_writing import check_info_target, metadata_not_kept, stack_files, write_frames
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import BadFrames
from rsvib_torch.stacks.engines import compute_here, compute_with_dask
from rsvib_torch.stacks.job import (
    DetectOptions,
    RestoreOptions,
    StoredWindow,
    WindowFrames,
    WindowResult,
    plan_job,
)
from rsvib_torch.stacks.manifest import manifest_header, write_manifest
from rsvib_torch.stacks.resumable_run import StackReport, run_to_file
from rsvib_torch.stacks.run_folder import RunFolder, check_space, disk_errors_named, work_folder
from rsvib_torch.stacks.windows import Window

__all__ = ["detect_stack", "iterate_stack", "process_stack"]

_UNCOMPRESSED = ("npy", "hdf5", "raw", "tiff")  # formats whose files have the size of their pixels
_MAX_INITIAL_FAILURES = 8  # windows; a run stops if all windows up to this number fail


@checks_arguments
def iterate_stack(source: PathLike, timing: SensorTiming, **options: Unpack[RestoreOptions]) -> Iterator[WindowResult]:
    """Restore a stack of any length window by window; each is available as soon as it is complete.

    A stack is cut into windows of at most ``window`` frames that share one frame with their neighbours. Each window is
    processed as a separate stack, with the time origin at its first frame. Later windows are read and computed
    meanwhile.

    Args:
        source: The stack, as in ``read_stack``.
        timing: The sensor. If it has no frame start times and the file states them, those of the file are used.
        **options: Options of the run.

            - ``window``: Maximum number of frames of a window, by default 8.
            - ``detection``: Options of ``detect_vibration``.
            - ``restoration``: Options of ``restore``, for frames whose full scale is 1.
            - ``full_scale``: As in ``read_stack``.
            - ``force``: Whether to return restored frames even if they are judged worse than the raw ones.
            - ``memory``: Limit for the memory of the process, in bytes or like ``"2GB"``; by default three
              quarters of the memory that is free or used by the process.
            - ``workers``: Maximum number of windows to compute at once; by default the number of processors.
            - ``device``: ``"auto"``, ``"cpu"`` or ``"cuda"``.

    Yields:
        One ``WindowResult`` per window, in order.

    Raises:
        OSError: If the stack cannot be read.
        TypeError: If an option is unknown.
        ValueError: If a value is out of range, the stack is not readable, or a window does not fit into the memory.

    Example:
        >>> import tempfile
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=100e-6, exposure_rows=10, frame_rows=160)
        >>> vibration = rsv.Vibration(amplitude=[1.6, 1.2], frequency=[155.0, 145.0])
        >>> folder = tempfile.mkdtemp()
        >>> frames = rsv.simulate_frames(city_and_fields(170, 150, seed=3), timing, vibration, num_frames=4)
        >>> rsv.write_stack(f"{folder}/frames.tif", frames, dtype="uint16", full_scale=4095)
        >>> options = {"window": 3, "detection": {"tones": 1}, "restoration": {"method": "dewarp"}}
        >>> for result in rsv.iterate_stack(f"{folder}/frames.tif", timing, **options):
        ...     print(result.indices, result.detection.vibration.frequency[:, 0].round().tolist())
        (0,) [155.0, 145.0]
        (1, 2, 3) [155.0, 145.0]
    """
    job, windows, at_once = plan_job(source, timing, options)
    yield from compute_here(job, windows, lambda result, _: result, at_once=at_once)


def detect_stack(
    source: PathLike,
    manifest: PathLike,
    timing: SensorTiming,
    *,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[DetectOptions],
) -> None:
    """Detect the vibration in every window of a stack of any length.

    Args:
        source: As in ``iterate_stack``.
        manifest: The ``manifest.json`` to write; ``read_manifest`` reads it, ``process_stack(given=...)`` uses it.
        timing: As in ``iterate_stack``.
        progress: As in ``process_stack``.
        **options: As in ``iterate_stack``, without ``restoration`` and ``force``.

    Raises:
        OSError: If the stack cannot be read, or the manifest cannot be written.
        TypeError: If an option is unknown.
        ValueError: If a value is out of range, the stack is not readable, detection fails in all first windows, or
            ``manifest`` is a file of the stack.

    Example:
        >>> detect_stack("frames.tif", "manifest.json", timing)  # doctest: +SKIP
    """
    job, windows, at_once = plan_job(source, timing, options, restores=False)
    check_outputs([manifest], stack_files(source))

    def records() -> Iterator[dict[str, Any]]:
        errors: list[str | None] = []
        for record in compute_here(job, windows, lambda result, _: job.record(result, 0), at_once=at_once):
            errors.append(record["error"])
            _check_not_all_failed(errors, windows)
            if progress is not None:
                progress(record["last"] + 1, job.info.shape[0])
            yield record

    with whole_file(manifest) as part:
        write_manifest(part, manifest_header(job, None, None), records())


@checks_arguments
def process_stack(
    source: PathLike,
    sink: PathLike,
    timing: SensorTiming,
    *,
    given: Sequence[DetectedVibration | None] | None = None,
    bad_frames: BadFrames = "pass",
    scheduler: str | None = None,
    compression: str | None = None,
    resume: bool = False,
    manifest: PathLike | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[RestoreOptions],
) -> StackReport:
    """Restore a stack of any length from file to file.

    The stack is cut into windows as in ``iterate_stack``. They depend only on the number of frames and ``window``, and
    each is computed on one thread: results do not depend on memory, workers and scheduler. The output gets its name
    when it is complete; until then it is stored in the folder ``.NAME.rsvib`` beside it, from which an interrupted run
    can be resumed. Memory does not grow with the number of frames.

    Frames that cannot be read or used (constant, infinite, beyond full scale) are listed in the manifest; the other
    frames of their window are restored without them. A window in which the detection fails is written unchanged.

    Args:
        source: The stack, as in ``read_stack``.
        sink: The stack to write, as in ``write_stack``; data type, full scale, resolution, frame times and metadata are
            kept as far as the format supports them.
        timing: As in ``iterate_stack``.
        given: Detections to use instead, one for each window (see ``read_manifest``).
        bad_frames: Whether frames that cannot be used are written unchanged (``"pass"``; a frame that cannot be read is
            written as NaN, or 0 for integers), or omitted (``"skip"``).
        scheduler: Address of a Dask scheduler whose workers can read ``source`` under the same path; ``"local"`` starts
            workers on this machine; None computes in this process.
        compression: As in ``write_stack``.
        resume: Whether to continue an interrupted run; a complete output is not changed.
        manifest: Path of the manifest; by default ``sink`` with ``.manifest.json`` appended.
        progress: Called with the number of complete frames and of all frames.
        **options: As in ``iterate_stack``. With ``joint=True`` in ``restoration``, every window becomes one image.
            ``memory`` does not limit Dask workers; with ``scheduler="local"``, ``workers`` is the number of processes.

    Returns:
        Summary of the run.

    Raises:
        FileExistsError: If there is an interrupted run and ``resume`` is False.
        ModuleNotFoundError: If an optional package is missing, with the extra to install.
        OSError: If a file cannot be read or written; the run can then be resumed.
        TypeError: If an option is unknown.
        ValueError: If a value is out of range, the stack is not readable, a window does not fit into the memory,
            detection fails in all first windows, an output is or contains the input or lies inside it, input, settings
            or versions differ from those of the run to resume, or its journal is damaged.

    Example:
        >>> import tempfile
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=100e-6, exposure_rows=10, frame_rows=160)
        >>> vibration = rsv.Vibration(amplitude=[1.6, 1.2], frequency=[155.0, 145.0])
        >>> folder = tempfile.mkdtemp()
        >>> frames = rsv.simulate_frames(city_and_fields(170, 150, seed=3), timing, vibration, num_frames=4)
        >>> rsv.write_stack(f"{folder}/frames.tif", frames, dtype="uint16", full_scale=4095)
        >>> report = rsv.process_stack(
        ...     f"{folder}/frames.tif",
        ...     f"{folder}/restored.tif",
        ...     timing,
        ...     window=3,
        ...     detection={"tones": 1},
        ...     restoration={"method": "dewarp"},
        ... )
        >>> report.windows, report.restored, report.bad_frames
        (2, 2, 0)
        >>> rsv.read_stack(f"{folder}/restored.tif").shape == frames.shape
        True
    """
    start, sink = time.perf_counter(), Path(sink)
    here = scheduler in (None, "local")
    job, windows, at_once = plan_job(source, timing, options, given=given, bad_frames=bad_frames, here=here)
    if given is not None and len(given) != len(windows):
        raise ValueError(
            f"given has {len(given)} detections for {len(windows)} windows of at most {job.window} frames; "
            "pass one for each window"
        )
    out = job.info.with_frames(len(windows) if job.joined else job.info.shape[0]).restored_as(job.scale, job.mosaic)
    out = replace(
        out,
        full_scale=job.full_scale,
        frame_times=None if out.frame_times is None else exposure_times(job.info, timing),
        time_error=0.0,
        frame_rate=out.frame_rate or timing.frame_rate,
    )
    form = check_info_target(sink, out, compression, check_folder=False)
    target = sink.with_name(sink.name + ".manifest.json") if manifest is None else Path(manifest)
    check_outputs([*stack_files(sink), work_folder(sink), target], stack_files(source))
    first: WindowResult | None = None

    def finish(result: WindowResult, pixels: WindowFrames) -> StoredWindow:
        nonlocal first
        if result.window.index == 0:
            first = result
        return job.stored(result, pixels)

    def compute(folder: RunFolder) -> dict[str, Any]:
        remaining = [window for window in windows if window.index not in folder]
        frames = len(remaining) if job.joined else sum(window.kept for window in remaining)
        # the finished windows and the output are on the disk together, until the output is complete
        frames += out.shape[0] if compression is None and form.name in _UNCOMPRESSED else 0
        check_space(sink, frames * out.frame_bytes)
        if scheduler is None:
            results = compute_here(job, remaining, finish, at_once=at_once)
        else:
            results = compute_with_dask(job, remaining, scheduler=scheduler, workers=at_once)
        _store_windows(windows, results, folder, progress)
        return {}

    def write(folder: RunFolder) -> None:
        write_frames(form, sink, out.with_frames(folder.written), _stored_frames(folder), compression)

    report = run_to_file(
        sink,
        target,
        manifest_header(job, sink.name, compression),
        windows=len(windows),
        resume=resume,
        compute=compute,
        write=write,
        not_kept=lambda count: metadata_not_kept(job.info, sink, (count, *out.shape[1:])),
    )
    return replace(report, first=first, seconds=time.perf_counter() - start)


def _check_not_all_failed(errors: Sequence[str | None], windows: Sequence[Window]) -> None:
    """Raise a ``ValueError`` with the first error if the detection has failed in every window so far."""
    if len(errors) >= min(_MAX_INITIAL_FAILURES, len(windows)) and all(errors) and errors[0] is not None:
        raise ValueError(errors[0])


def _store_windows(
    windows: Sequence[Window],
    results: Generator[StoredWindow, None, None],
    folder: RunFolder,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Store the results of the windows that are not in the folder, while later ones are computed."""
    errors = [record["error"] for record in folder.records()]
    remaining = [window for window in windows if window.index not in folder]
    total = windows[-1].last + 1
    done = total - sum(window.kept for window in remaining)

    def store(stored: StoredWindow) -> None:
        names = [f"{stored.record['window']:06d}.npy"] if stored.frames else []
        for name in names:
            stack = np.ascontiguousarray(np.stack(stored.frames))  # channels may be stored last
            with folder.create(name) as file:
                np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(stack))
                file.write(stack.data)  # errors of np.save do not contain the reason
        folder.add(stored.record, names)

    if progress is not None:
        progress(done, total)
    with ThreadPoolExecutor(1, "rsvib-write") as writing, closing(results):
        previous: Future[None] | None = None
        for window, stored in zip(remaining, results, strict=True):
            errors.append(stored.record["error"])
            if previous is not None:
                with disk_errors_named(folder):
                    previous.result()
            try:
                _check_not_all_failed(errors, windows)
            except ValueError:
                folder.remove()
                raise
            previous = writing.submit(store, stored)
            if progress is not None:
                done += window.kept
                progress(done, total)
        if previous is not None:
            with disk_errors_named(folder):
                previous.result()


def _stored_frames(folder: RunFolder) -> Iterator[NDArray[Any]]:
    """The frames of all windows in order."""
    for name in folder.files():
        with folder.open(name) as file:
            yield from np.load(file, allow_pickle=False)
