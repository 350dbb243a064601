"""Stacks of any length: read ahead, detected in windows, restored, written as it goes."""

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from rsvib_torch.checks import check_choice, check_whole_number
from rsvib_torch.sensor import SensorTiming
from rsvib_torch.stacks.atomic import whole_file
from rsvib_torch.stacks.engines import compute_here, compute_with_dask
from rsvib_torch.stacks.files import PathLike, check_info_target, open_stack
from rsvib_torch.stacks.fingerprint import fingerprint
from rsvib_torch.stacks.job import BadFrames, StackJob, StoredWindow, WindowFrames, WindowResult
from rsvib_torch.stacks.journal import Journal, describe_difference
from rsvib_torch.stacks.manifest import manifest_header, read_manifest, write_manifest
from rsvib_torch.stacks.memory import parse_memory, windows_at_once
from rsvib_torch.stacks.records import DetectedWindow
from rsvib_torch.stacks.scale import check_full_scale
from rsvib_torch.stacks.sink import Sink
from rsvib_torch.stacks.windows import Window, cut_windows

__all__ = ["DEFAULT_WINDOW", "StackReport", "detect_stack", "iterate_stack", "process_stack"]

DEFAULT_WINDOW = 8  # frames
_HOPELESS = 8  # windows that fail one after another from the start before the run gives up


@dataclass(frozen=True, eq=False)
class StackReport:
    """What a run did.

    Attributes:
        frames: Frames that it wrote, those of an earlier run that it went on with among them.
        windows: Windows of the stack.
        restored: Windows whose frames were restored.
        failed: Windows in which nothing could be detected.
        bad_frames: Frames that could not be used.
        resumed: Windows that were there already.
        seconds: Time that it took.
        first: The first window's result, where it was worked on here.
        manifest: Where all of it is written down.
    """

    frames: int
    windows: int
    restored: int
    failed: int
    bad_frames: int
    resumed: int
    seconds: float
    first: WindowResult | None
    manifest: Path


def _device(device: str) -> str:
    check_choice("device", device.partition(":")[0], ("auto", "cpu", "cuda"))
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return device


def _make_job(
    source: PathLike,
    timing: SensorTiming,
    *,
    detection: Mapping[str, Any] | None,
    restoration: Mapping[str, Any] | None,
    given: Sequence[DetectedWindow | None] | None,
    full_scale: float | None,
    bad_frames: BadFrames,
    force: bool,
    device: str,
) -> StackJob:
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
    if timing.frame_start_times is None and info.frame_times is not None:
        timing = replace(timing, frame_start_times=info.frame_times)
    timing.frame_starts(info.shape[0])
    timing.check_rows(info.shape[-1 if timing.scan_axis == -1 else -2])
    options = dict(detection or {})
    for name in ("window", "window_step"):
        if name in options:
            raise TypeError(f"{name!r} is no option of detection here: a stack is cut into windows by window=")
    return StackJob(
        Path(source),
        info,
        timing,
        full_scale,
        options,
        None if restoration is None else dict(restoration),
        given,
        bad_frames,
        force,
        _device(device),
    )


def _workers(job: StackJob, window: int, memory: str | float | None, workers: int | None) -> int:
    most = check_whole_number("workers", workers, at_least=1) if workers is not None else _processors(job.device)
    limit = None if memory is None else parse_memory(memory)
    return windows_at_once(job.info, window, memory=limit, most=most)


def _processors(device: str) -> int:
    if device != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def iterate_stack(
    source: PathLike,
    timing: SensorTiming,
    *,
    window: int = DEFAULT_WINDOW,
    detection: Mapping[str, Any] | None = None,
    restoration: Mapping[str, Any] | None = None,
    full_scale: float | None = None,
    force: bool = False,
    memory: str | float | None = None,
    workers: int | None = None,
    device: str = "auto",
) -> Iterator[WindowResult]:
    """Restore a stack of any length window by window: the frames of each come as soon as they are done.

    A stack is cut into windows of at most ``window`` frames that share one frame with their neighbours. Each is a
    stack of its own: its time begins with its first frame. Reading goes on while others are computed.

    Args:
        source: The stack, as in ``read_stack``.
        timing: The sensor. Where it has no frame start times and the file states them, those of the file are used.
        window: Most frames of a window.
        detection: Options of ``detect_vibration``.
        restoration: Options of ``restore``, for frames whose full scale is 1.
        full_scale: As in ``read_stack``.
        force: Keep restored frames even where they are judged no better than raw.
        memory: Memory that the process may take, in bytes or like ``"2GB"``; by default four fifths of what is free.
        workers: Windows to work on at once, if there is memory; by default as many as there are processors.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.

    Yields:
        One ``WindowResult`` a window, in order.

    Raises:
        OSError: If the stack cannot be read.
        TypeError: If an option is not known.
        ValueError: If a value is out of range, or the stack is not readable.
    """
    job = _make_job(
        source,
        timing,
        detection=detection,
        restoration=restoration or {},
        given=None,
        full_scale=full_scale,
        bad_frames="pass",
        force=force,
        device=device,
    )
    windows = cut_windows(job.info.shape[0], window)
    at_once = _workers(job, window, memory, workers)
    yield from compute_here(job, windows, lambda result, _: result, at_once=at_once)


def detect_stack(
    source: PathLike,
    manifest: PathLike,
    timing: SensorTiming,
    *,
    window: int = DEFAULT_WINDOW,
    detection: Mapping[str, Any] | None = None,
    full_scale: float | None = None,
    memory: str | float | None = None,
    workers: int | None = None,
    device: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Detect the vibration in every window of a stack of any length.

    Args:
        source: As in ``iterate_stack``.
        manifest: The ``manifest.json`` to write, see ``read_manifest``; ``process_stack(given=...)`` restores with it.
        timing: As in ``iterate_stack``.
        window: As in ``iterate_stack``.
        detection: As in ``iterate_stack``.
        full_scale: As in ``iterate_stack``.
        memory: As in ``iterate_stack``.
        workers: As in ``iterate_stack``.
        device: As in ``iterate_stack``.
        progress: As in ``process_stack``.

    Raises:
        OSError: If the stack cannot be read, or the manifest not be written.
        TypeError: If an option is not known.
        ValueError: If a value is out of range, the stack is not readable, or nothing in it can be detected.
    """
    job = _make_job(
        source,
        timing,
        detection=detection,
        restoration=None,
        given=None,
        full_scale=full_scale,
        bad_frames="pass",
        force=False,
        device=device,
    )
    windows = cut_windows(job.info.shape[0], window)
    at_once = _workers(job, window, memory, workers)
    header = manifest_header(job, window, None, None, fingerprint(job.source))
    errors: list[str] = []

    def records() -> Iterator[dict[str, Any]]:
        for record in compute_here(job, windows, lambda result, _: job.record(result, 0), at_once=at_once):
            errors.extend([record["error"]] if record["error"] is not None else [])
            if len(errors) == min(_HOPELESS, len(windows)) == record["window"] + 1:
                raise ValueError(errors[0])
            if progress is not None:
                progress(record["last"] + 1, job.info.shape[0])
            yield record

    with whole_file(manifest) as part:
        write_manifest(part, header, records())


def process_stack(
    source: PathLike,
    sink: PathLike,
    timing: SensorTiming,
    *,
    window: int = DEFAULT_WINDOW,
    detection: Mapping[str, Any] | None = None,
    restoration: Mapping[str, Any] | None = None,
    given: Sequence[DetectedWindow | None] | None = None,
    full_scale: float | None = None,
    bad_frames: BadFrames = "pass",
    force: bool = False,
    memory: str | float | None = None,
    workers: int | None = None,
    device: str = "auto",
    scheduler: str | None = None,
    compression: str | None = None,
    resume: bool = False,
    manifest: PathLike | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> StackReport:
    """Restore a stack of any length from file to file.

    The stack is cut into windows as in ``iterate_stack``; where they begin depends on the number of frames and
    ``window`` alone, and each is computed on one thread: results are the same whatever memory, workers and engine. The
    output appears when it is complete; until then the work is kept in a folder ``.NAME.rsvib`` beside it, from which a
    run that was broken off goes on. Memory does not grow with the number of frames.

    Frames that cannot be read or used (constant, infinite, beyond full scale) are named in the manifest; the others of
    their window are restored without them. A window in which nothing can be detected is written as taken.

    Args:
        source: The stack, as in ``read_stack``.
        sink: The stack to write, as in ``write_stack``; type, full scale, resolution and frame times are kept.
        timing: As in ``iterate_stack``.
        window: As in ``iterate_stack``.
        detection: As in ``iterate_stack``.
        restoration: As in ``iterate_stack``; with ``joint=True`` every window becomes one image.
        given: Detections to use instead, one a window (see ``read_manifest``).
        full_scale: As in ``read_stack``.
        bad_frames: Whether frames that cannot be used are written as they are (``"pass"``; one that cannot be read is
            0, or NaN in floats), or left out (``"skip"``).
        force: As in ``iterate_stack``.
        memory: As in ``iterate_stack``. Dask workers keep to their own limits.
        workers: As in ``iterate_stack``; with ``scheduler="local"``, processes.
        device: As in ``iterate_stack``.
        scheduler: Address of a Dask scheduler whose workers see ``source`` under the same path; ``"local"`` starts
            workers on this machine; None computes here.
        compression: As in ``write_stack``.
        resume: Go on with a run that was broken off; a complete one is left as it is.
        manifest: Where to write down what was done; beside ``sink`` with ``.manifest.json`` added, if not given.
        progress: Called with the number of frames that are done, and of all.

    Returns:
        What was done.

    Raises:
        FileExistsError: If a run was broken off there, and is not to be resumed.
        ModuleNotFoundError: If an optional package is missing, with the extra to install.
        OSError: If a file cannot be read or written; what is done is kept to go on with.
        TypeError: If an option is not known.
        ValueError: If a value is out of range, the stack is not readable, nothing in it can be detected, or input,
            settings or versions are not those of the run to go on with.
    """
    start, sink = time.perf_counter(), Path(sink)
    job = _make_job(
        source,
        timing,
        detection=detection,
        restoration=restoration or {},
        given=given,
        full_scale=full_scale,
        bad_frames=bad_frames,
        force=force,
        device=device,
    )
    windows = cut_windows(job.info.shape[0], window)
    if given is not None and len(given) != len(windows):
        raise ValueError(f"{len(given)} detections for {len(windows)} windows of at most {window} frames")
    count = len(windows) if job.joined else job.info.shape[0]
    out = replace(
        job.info,
        shape=(count, *job.info.shape[1:]),
        full_scale=job.full_scale,
        frame_times=job.info.frame_times if count == job.info.shape[0] else None,
    )
    form = check_info_target(sink, out, compression, try_folder=False)
    target = sink.with_name(sink.name + ".manifest.json") if manifest is None else Path(manifest)
    if Path(source).exists() and sink.exists() and os.path.samefile(source, sink):
        raise ValueError(f"{sink}: a stack cannot be written over itself")
    at_once = _workers(job, window, memory, workers)
    header = manifest_header(job, window, sink.name, compression, fingerprint(job.source))
    run = _Run(job, windows, at_once, scheduler, progress)
    journal = Journal(sink)
    try:
        if resume and not journal.has_lines and sink.exists() and target.exists():
            _check_same(sink, read_manifest(target).header(), header)
            return run.report(_records(target), len(windows), start, target)
        fresh = not journal.open(header, resume=resume)
        resumed = journal.count
        writer = Sink(sink, journal.folder, form, out, sure=bad_frames == "pass", compression=compression, fresh=fresh)
        try:
            run.write(writer, journal)
            with _disk_trouble_named(sink, journal):
                write_manifest(journal.folder / "manifest.json", header, journal.records())
                writer.finish(journal.written)
        finally:
            writer.close()
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(journal.folder / "manifest.json", target)
        report = run.report(journal.records(), resumed, start, target)
        journal.remove()
        return report
    finally:
        journal.close()


def _check_same(sink: Path, old: Mapping[str, Any], new: Mapping[str, Any]) -> None:
    """Raise a ``ValueError`` unless a complete output came from what is to be done now."""
    difference = describe_difference(old, new)
    if difference:
        raise ValueError(f"{sink}: cannot resume: {difference}; without resume it is done again and replaced")


def _records(manifest: Path) -> Iterator[dict[str, Any]]:
    return (record.model_dump() for record in read_manifest(manifest).windows)


@contextmanager
def _disk_trouble_named(sink: Path, journal: Journal) -> Iterator[None]:
    """An error of the disk says which output it is about, and that the work is not lost."""
    try:
        yield
    except OSError as error:
        kept = f"; {journal.count} windows are kept, resume goes on with them" if journal.count else ""
        raise OSError(error.errno, f"{error.strerror or error}{kept}", str(sink)) from error


class _Run:
    """The windows of a stack on their way through an engine into a sink."""

    def __init__(
        self,
        job: StackJob,
        windows: list[Window],
        at_once: int,
        scheduler: str | None,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self._job, self._windows, self._at_once, self._scheduler = job, windows, at_once, scheduler
        self._progress = progress or (lambda done, total: None)
        self._first: WindowResult | None = None
        self._fine = 0
        self._errors: list[str] = []

    def _compute(self, windows: Sequence[Window]) -> Iterator[StoredWindow]:
        if self._scheduler is not None:
            return compute_with_dask(self._job, windows, scheduler=self._scheduler, workers=self._at_once)
        return compute_here(self._job, windows, self._finish, at_once=self._at_once)

    def _finish(self, result: WindowResult, pixels: WindowFrames) -> StoredWindow:
        if result.window.index == 0:
            self._first = result
        return self._job.stored(result, pixels)

    def write(self, sink: Sink, journal: Journal) -> None:
        """Do the windows that are not in the journal yet; writing goes on while the next ones are computed."""
        for record in journal.records():
            self._count(record)
        todo = self._windows[journal.count :]
        total = self._windows[-1].last + 1
        self._progress(todo[0].first if todo else total, total)
        results = self._compute(todo)
        with ThreadPoolExecutor(1, "rsvib-write") as writing:
            before: Future[None] | None = None
            try:
                for window, stored in zip(todo, results, strict=True):
                    self._count(stored.record)
                    if self._fine == 0 and len(self._errors) >= min(_HOPELESS, len(self._windows)):
                        if before is not None:
                            before.result()
                        journal.forget()
                        raise ValueError(self._errors[0])
                    if before is not None:
                        before.result()
                    before = writing.submit(self._store, sink, journal, stored)
                    self._progress(window.first + window.kept, total)
                if before is not None:
                    before.result()
            finally:
                close = getattr(results, "close", None)
                if close is not None:
                    close()

    def _count(self, record: Mapping[str, Any]) -> None:
        if record["error"] is None:
            self._fine += 1
        else:
            self._errors.append(record["error"])

    @staticmethod
    def _store(sink: Sink, journal: Journal, stored: StoredWindow) -> None:
        with _disk_trouble_named(journal.sink, journal):
            sink.put(stored.record["window"], journal.written, stored.frames)
            journal.add(stored.record)

    def report(self, records: Iterable[Mapping[str, Any]], resumed: int, start: float, manifest: Path) -> StackReport:
        """What the records tell."""
        frames = restored = failed = bad = 0
        for record in records:
            frames += record["written"]
            restored += record["frames"] == "restored"
            failed += record["error"] is not None
            bad += len(record["bad_frames"])
        seconds = time.perf_counter() - start
        return StackReport(frames, len(self._windows), restored, failed, bad, resumed, seconds, self._first, manifest)
