"""A run that writes an output from windows, and is resumed if it was interrupted.

Finished windows are in a folder beside the output: files of pixels, and a file with the record and the hashes of these
files, which is written when they are on the disk. The key of its own hash are the settings of the run: a window of
another run, and one of which any file was changed, is not finished, and computed again.
"""

import errno
import json
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsvib_torch.checks.arguments import check_fields
from rsvib_torch.files import atomic
from rsvib_torch.files.atomic import check_outputs, nearest_folder, sync
from rsvib_torch.files.locked_folder import LockedFolder, key_of
from rsvib_torch.files.reading import Table, size_text
from rsvib_torch.io.stack_writing import stack_files
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import FileRunOptions
from rsvib_torch.results.presentation import Summarised, decode, plain_values
from rsvib_torch.stacks.manifest import StackManifest, read_manifest
from rsvib_torch.stacks.windows import WindowRecord, WindowResult
from rsvib_torch.text import number_of, one_line

_SETTINGS = "settings.json"
_RECORD = re.compile(r"\d{6,}\.json")
_NAMES = re.compile(rf"{re.escape(_SETTINGS)}|\d{{6,}}\.(json|npy|mkv|mp4|mov|m4v)")  # of the files that a run makes


def work_folder(sink: Path) -> Path:
    """Work folder of a run that writes ``sink``."""
    return sink.with_name(f".{sink.name}.rsvib")


def _difference(old: object, new: object, path: str = "") -> str | None:
    """The first key in which two tables differ, with both values; None if they are equal."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = dict.fromkeys([*new, *old])
        found = (_difference(old.get(key), new.get(key), f"{path}.{key}".lstrip(".")) for key in keys)
        return next(filter(None, found), None)
    texts = (one_line(json.dumps(value), 60) for value in (old, new))
    return None if old == new else "{} was {}, now it is {}".format(path, *texts)


def check_space(path: Path, needed: int) -> None:
    """Raise an ``OSError`` if the disk of a file to be written has less than ``needed`` free bytes."""
    free = shutil.disk_usage(nearest_folder(path)).free
    if needed > free:
        text = f"{os.strerror(errno.ENOSPC)}: a run needs {size_text(needed)}, {size_text(free)} are free"
        raise OSError(f"{path}: {text}")


class RunFolder(LockedFolder):
    """The finished windows of a run.

    A run is resumed only if its ``header`` is unchanged: input, settings and versions.
    """

    def __init__(self, sink: Path, header: Mapping[str, object], *, resume: bool) -> None:
        super().__init__(work_folder(sink), sink, _NAMES)
        self._finished: dict[int, tuple[WindowRecord, list[str]]] = {}  # record and names of the files of windows
        self._key = key_of(header)
        try:
            self._find_windows(header, resume=resume)
        except BaseException:
            super().close()
            raise

    def _find_windows(self, header: Mapping[str, object], *, resume: bool) -> None:
        """Find the finished windows; an error if they are not to be continued, or are those of other settings."""
        stored, records = self.read_table(_SETTINGS), list(filter(_RECORD.fullmatch, self.names))
        if records and not resume:
            raise FileExistsError(
                f"{self.sink}: a run was interrupted here after {len(records)} windows; resume it (--resume), or "
                f"delete {self.path} to start over (--overwrite does not discard finished windows)"
            )
        difference = records and stored is not None and _difference(stored, dict(header))
        if difference:
            raise ValueError(f"{self.sink}: cannot resume: {difference}; delete {self.path} to start over")
        for name in records:
            entry = self.read_table(name, self._key)
            with suppress(OSError):  # a file is missing, or cannot be read
                if entry is not None and all(self.digest(file) == digest for file, digest in entry["files"].items()):
                    record = decode(WindowRecord, entry["record"], name)
                    if name == f"{record.window:06d}.json":
                        self._finished[record.window] = record, list(entry["files"])
        if stored != header:
            self.write_table(_SETTINGS, header)

    def add(self, record: WindowRecord, names: Sequence[str] = (), array: Array | None = None) -> None:
        """Enter the record of a window with its closed files, and an array, which becomes the last of them.

        Their names begin with the number of the window in six digits. It is on the disk when the function returns.
        """
        names = list(names)
        if array is not None:
            names.append(f"{record.window:06d}.npy")
            with self.create(names[-1]) as file:
                np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(array))
                file.write(array.data)  # errors of np.save do not contain the reason
        digests = {name: self.digest(name, synchronised=True) for name in names}
        content = {"record": plain_values(record), "files": digests}
        self.write_table(f"{record.window:06d}.json", content, self._key)
        self._finished[record.window] = record, names

    def __contains__(self, window: int) -> bool:
        return window in self._finished

    def kept(self) -> str:
        """What an error of the run states about its finished windows."""
        count = len(self._finished)
        return f"; {count} windows are complete, resume the run to continue" if count else ""

    def records(self) -> list[WindowRecord]:
        """Records of the finished windows in order."""
        return [self._finished[window][0] for window in sorted(self._finished)]

    def files(self) -> list[str]:
        """Names of the files of the finished windows in order."""
        return [name for window in sorted(self._finished) for name in self._finished[window][1]]

    def frames(self) -> Iterator[Array]:
        """Frames of the finished windows in order, from the files of arrays."""
        for name in self.files():
            with self.open(name) as file:
                yield from np.load(file, allow_pickle=False)

    def remove(self) -> None:
        """Remove the folder with its windows."""
        self._finished.clear()
        super().remove()

    def close(self) -> None:
        """Release the folder; it is removed if it contains no finished window."""
        try:
            if not self._finished:
                self.remove()
        finally:
            super().close()


@dataclass(frozen=True, eq=False, repr=False)
class StackReport(Summarised):
    """Summary of a run."""

    frames: int  # number of frames written, including those of an interrupted run that was resumed
    windows: int  # number of windows of the stack
    restored: int  # number of windows whose frames were restored
    failed: int  # number of windows in which detection or restoration failed
    bad_frames: int  # number of frames that could not be used
    resumed: int  # number of windows that were complete before
    seconds: float  # duration of the run
    first: WindowResult | None  # of the first window, if it was computed in this process
    manifest: Path  # path of the manifest
    not_kept: tuple[str, ...]  # metadata of the input that the output does not contain

    def __post_init__(self) -> None:
        check_fields(self)

    def summary(self) -> str:
        """Numbers of frames and windows, and the time."""
        lines = [f"{number_of(self.frames, 'frame')} in {number_of(self.windows, 'window')}, {self.restored} restored"]
        if self.frames and not self.resumed:
            lines[0] += f", {self.seconds / self.frames:.2g} s per frame"
        if self.resumed:
            lines.append(f"windows complete before this run: {self.resumed}")
        see = f"see {self.manifest.name}"
        if self.failed:
            lines.append(f"detection or restoration failed in {number_of(self.failed, 'window')}: {see}")
        if self.bad_frames:
            lines.append(f"{number_of(self.bad_frames, 'frame')} could not be used: {see}")
        return "\n".join(lines)


class FileRun:
    """A run that writes an output and its manifest; neither is an input.

    Its steps are ``finished``, ``folder``, ``writing`` and ``report``.
    """

    def __init__(self, sink: Path, options: FileRunOptions, header: Table, inputs: Iterable[Path]) -> None:
        self._start, self.sink, self._resume = time.perf_counter(), sink, options.resume
        self.header: Table = json.loads(json.dumps(header))  # lists instead of tuples, as in files
        self.manifest = Path(options.manifest or sink.with_name(f"{sink.name}.manifest.json"))
        check_outputs([*stack_files(sink), work_folder(sink), self.manifest], inputs)

    def finished(self) -> StackReport | None:
        """The summary of a run to be resumed that is complete; an error if it is one with other settings."""
        if not self._resume or os.path.lexists(work_folder(self.sink)):
            return None
        if not (self.sink.exists() and self.manifest.exists()):
            return None
        manifest = read_manifest(self.manifest)
        difference = _difference({name: getattr(manifest, name) for name in self.header}, self.header)
        if difference:
            raise ValueError(
                f"{self.sink}: cannot resume: {difference}; resume with the settings of before, or write another output"
            )
        for written in (self.sink, self.manifest):
            atomic.remove_abandoned(written)
        return self.report(manifest, len(manifest.windows))

    @contextmanager
    def folder(self) -> Iterator[RunFolder]:
        """The folder of the finished windows, which errors of a full disk in the block state."""
        opened = closing(RunFolder(self.sink, self.header, resume=self._resume))
        with opened as folder, atomic.full_disk_named(self.sink, folder.kept):
            yield folder

    @contextmanager
    def writing(self, folder: RunFolder, **stated: Any) -> Iterator[StackManifest]:
        """Write the manifest, which ``stated`` fields belong to, after the block, which writes the output.

        The folder is removed when both are on the disk.
        """
        atomic.make_folder(self.manifest.parent)
        manifest = StackManifest(**self.header, **stated, windows=tuple(folder.records()))
        with atomic.whole(self.manifest) as part:
            manifest.save(part)
            yield manifest
        sync(self.manifest.absolute().parent)  # the temporary folder is gone as well
        folder.remove()

    def report(self, manifest: StackManifest, resumed: int, first: WindowResult | None = None) -> StackReport:
        """The summary of the run, of which ``resumed`` windows were complete before."""
        records = manifest.windows
        return StackReport(
            frames=sum(record.written for record in records),
            windows=len(records),
            restored=sum(record.frames == "restored" for record in records),
            failed=sum(record.error is not None for record in records),
            bad_frames=len(manifest.bad_frames),
            resumed=resumed,
            seconds=time.perf_counter() - self._start,
            first=first,
            manifest=self.manifest,
            not_kept=manifest.not_kept,
        )
