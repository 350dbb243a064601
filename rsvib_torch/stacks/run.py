"""The windows of a stack on their way through an engine into a sink."""

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsvib_torch.stacks.engines import compute_here, compute_with_dask
from rsvib_torch.stacks.job import StackJob, StoredWindow, WindowFrames, WindowResult
from rsvib_torch.stacks.job_setup import HOPELESS
from rsvib_torch.stacks.journal import Journal
from rsvib_torch.stacks.sink import Sink
from rsvib_torch.stacks.windows import Window

__all__ = ["StackReport", "StackRun", "disk_trouble_named"]


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


@contextmanager
def disk_trouble_named(sink: Path, journal: Journal) -> Iterator[None]:
    """An error of the disk says which output it is about, and that the work is not lost."""
    try:
        yield
    except OSError as error:
        kept = f"; {journal.count} windows are kept, resume goes on with them" if journal.count else ""
        # libraries add much to what the system says
        said = os.strerror(error.errno) if error.errno else " ".join(str(error).split())
        raise OSError(error.errno, f"{said}{kept}", str(sink)) from error


class StackRun:
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
                    if self._fine == 0 and len(self._errors) >= min(HOPELESS, len(self._windows)):
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
        with disk_trouble_named(journal.sink, journal):
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
