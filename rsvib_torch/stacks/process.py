"""Stacks of any length from file to file: read ahead, detected in windows, restored, written as it goes."""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rsvib_torch.io.files import PathLike, check_info_target
from rsvib_torch.io.schema import DetectedVibration
from rsvib_torch.io.stack_info import exposure_times
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.stacks.fingerprint import fingerprint
from rsvib_torch.stacks.job import BadFrames
from rsvib_torch.stacks.job_setup import DEFAULT_WINDOW, job_windows_at_once, make_job
from rsvib_torch.stacks.journal import Journal, describe_difference
from rsvib_torch.stacks.manifest import manifest_header, read_manifest, write_manifest
from rsvib_torch.stacks.run import StackReport, StackRun, disk_trouble_named
from rsvib_torch.stacks.sink import Sink
from rsvib_torch.stacks.windows import cut_windows

__all__ = ["process_stack"]


def process_stack(
    source: PathLike,
    sink: PathLike,
    timing: SensorTiming,
    *,
    window: int = DEFAULT_WINDOW,
    detection: Mapping[str, Any] | None = None,
    restoration: Mapping[str, Any] | None = None,
    given: Sequence[DetectedVibration | None] | None = None,
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
    job = make_job(
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
        frame_times=exposure_times(job.info, timing) if count == job.info.shape[0] else None,
    )
    form = check_info_target(sink, out, compression, check_folder=False)
    target = sink.with_name(sink.name + ".manifest.json") if manifest is None else Path(manifest)
    if Path(source).exists() and sink.exists() and os.path.samefile(source, sink):
        raise ValueError(f"{sink}: a stack cannot be written over itself")
    at_once = job_windows_at_once(job, window, memory, workers)
    header = manifest_header(job, window, sink.name, compression, fingerprint(job.source))
    run = StackRun(job, windows, at_once, scheduler, progress)
    journal = Journal(sink)
    try:
        if resume and not journal.has_lines and sink.exists() and target.exists():
            _check_same(sink, read_manifest(target).header(), header)
            return run.report(_records(target), len(windows), start, target)
        fresh = not journal.open(header, resume=resume)
        resumed = journal.count
        sure = bad_frames == "pass"
        with disk_trouble_named(sink, journal):
            writer = Sink(sink, journal.folder, form, out, sure=sure, compression=compression, fresh=fresh)
        try:
            run.write(writer, journal)
            with disk_trouble_named(sink, journal):
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
