"""A run that writes an output from windows, and is resumed if it was interrupted.

Finished windows are in a folder beside the output: files of pixels, and a file with the record and the hashes of these
files, which is written when they are on the disk. The key of its own hash are the settings of the run: a window of
another run, and one of which any file was changed, is not finished, and computed again.

Files are opened relative to the open folder, and only new files are written: a link in the place of the folder or of a
file is never followed, and nothing that others made is changed.
"""

import errno
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from rsvib_torch.checks.arguments import check_fields
from rsvib_torch.files import atomic
from rsvib_torch.files.atomic import PART, check_outputs, make_folder, nearest_folder, sync
from rsvib_torch.files.reading import Table, size_text
from rsvib_torch.io.stack_writing import stack_files
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import FileRunOptions
from rsvib_torch.results.presentation import Summarised, decode, plain_values
from rsvib_torch.stacks.manifest import StackManifest, read_manifest
from rsvib_torch.stacks.windows import WindowRecord
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
        differences = (_difference(old.get(key), new.get(key), f"{path}.{key}".lstrip(".")) for key in keys)
        return next(filter(None, differences), None)
    texts = (one_line(json.dumps(value), 60) for value in (old, new))
    return None if old == new else "{} was {}, now it is {}".format(path, *texts)


def check_space(path: Path, needed: int) -> None:
    """Raise an ``OSError`` if the disk of a file to be written has less than ``needed`` free bytes."""
    free = shutil.disk_usage(nearest_folder(path)).free
    if needed > free:
        text = f"{os.strerror(errno.ENOSPC)}: a run needs {size_text(needed)}, {size_text(free)} are free"
        raise OSError(f"{path}: {text}")


_SAFELY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # opening a named pipe must not wait for another process
_blake2b = partial(hashlib.blake2b, digest_size=16)


class RunFolder:
    """The finished windows of a run, in a folder beside the file ``sink`` that is locked until it is closed.

    It is created if it does not exist. One that another process uses, that belongs to another user, or that has other
    files than those of a run is refused. A run is resumed only if its ``header`` is unchanged: input, settings and
    versions.
    """

    def __init__(self, sink: Path, header: Mapping[str, object], *, resume: bool) -> None:
        self.path, self.sink, self._above = work_folder(sink), sink, nearest_folder(sink)
        self._finished: dict[int, tuple[WindowRecord, str]] = {}  # record and name of the file of every window
        self._key = _blake2b(json.dumps(header, sort_keys=True).encode()).digest()
        make_folder(self.path.parent)
        with ExitStack() as opened:
            try:
                with suppress(FileExistsError):
                    self.path.mkdir(0o700)
                    sync(self.path.parent)
                self._folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | _SAFELY)
                opened.callback(os.close, self._folder)
                self._lock()
            except (FileNotFoundError, BlockingIOError) as error:
                raise BlockingIOError(f"cannot write {sink}: another run is writing it") from error
            except OSError as error:
                if error.errno not in (errno.ELOOP, errno.ENOTDIR):
                    raise
                raise self._refusal("it is a link" if self.path.is_symlink() else "it is not a folder") from error
            self._find_windows(header, resume=resume)
            self._opened = opened.pop_all()

    def _find_windows(self, header: Mapping[str, object], *, resume: bool) -> None:
        """Find the finished windows; an error if they are not to be continued, or are those of other settings."""
        names = sorted(os.listdir(self._folder))
        for name in names:
            status = os.stat(name, dir_fd=self._folder, follow_symlinks=False)
            if not (_NAMES.fullmatch(name) and stat.S_ISREG(status.st_mode)):
                raise self._refusal("it has another name than files of a run, or is no regular file", name)
        stored, records = self._read(_SETTINGS), list(filter(_RECORD.fullmatch, names))
        if records and not resume:
            raise FileExistsError(
                f"{self.sink}: a run was interrupted here after {len(records)} windows; resume it (--resume), or "
                f"delete {self.path} to start over (--overwrite does not discard finished windows)"
            )
        difference = records and stored is not None and _difference(stored, dict(header))
        if difference:
            raise ValueError(f"{self.sink}: cannot resume: {difference}; delete {self.path} to start over")
        for name in records:
            entry = self._read(name, self._key)
            with suppress(OSError):  # a file is missing, or cannot be read
                if entry is not None and all(self._digest(file) == digest for file, digest in entry["files"].items()):
                    record = decode(WindowRecord, entry["record"], name)
                    if name == f"{record.window:06d}.json":
                        self._finished[record.window] = record, next(iter(entry["files"]))
        if stored != header:
            self._write(_SETTINGS, header)

    def _lock(self) -> None:
        """Lock the folder, which must be that of this user; a ``BlockingIOError`` if another process uses it."""
        if os.fstat(self._folder).st_uid != os.geteuid():
            raise self._refusal("it belongs to another user")
        try:
            fcntl.flock(self._folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):  # as those of some clusters
                raise
            text = f"the file system has no locks ({error.strerror}): start no other run with this output"
            warnings.warn(f"{self.path}: {text}", stacklevel=2)
        if not self._has_its_name():
            raise BlockingIOError  # another process has just ended

    def _has_its_name(self) -> bool:
        with suppress(FileNotFoundError):
            return os.path.samestat(os.lstat(self.path), os.fstat(self._folder))
        return False

    def _refusal(self, reason: str, name: str = "") -> FileExistsError:
        return FileExistsError(
            f"cannot write {self.sink}: {self.path / name} was not made by a run, {reason}; move it elsewhere, or "
            f"delete {self.path} to start over"
        )

    def open(self, name: str, mode: Literal["rb", "x+b"] = "rb") -> IO[bytes]:
        """Open a file of the folder, wherever the folder is now, and never through a link."""
        return open(name, mode, opener=lambda name, flags: os.open(name, flags | _SAFELY, 0o600, dir_fd=self._folder))

    def create(self, name: str) -> IO[bytes]:
        """A new file, in place of one of this name."""
        with suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._folder)
        return self.open(name, "x+b")

    def _write(self, name: str, content: Mapping[str, object], key: bytes = b"") -> None:
        """Write a table with its hash; it is on the disk when the function returns."""
        body = json.dumps(content).encode()
        with self.create(name) as file:
            file.write(_blake2b(body, key=key).hexdigest().encode() + b" " + body)
            file.flush()
            os.fsync(file.fileno())
        os.fsync(self._folder)

    def _read(self, name: str, key: bytes = b"") -> Table | None:
        """The table in a file; None if the file is not as it was written, or with another key."""
        with suppress(OSError), self.open(name) as file:
            digest, _, body = file.read().partition(b" ")
            if digest == _blake2b(body, key=key).hexdigest().encode():
                content: Table = json.loads(body)
                return content
        return None

    def _digest(self, name: str, *, synchronised: bool = False) -> str:
        """Hash of the content of a file, which is on the disk then if ``synchronised``."""
        with self.open(name) as file:
            if synchronised:
                os.fsync(file.fileno())
            return hashlib.file_digest(file, _blake2b).hexdigest()  # type: ignore[arg-type]

    def add(self, record: WindowRecord, pixels: Array | str) -> None:
        """Enter the record of a window and its pixels: an array, or the name of a file, which is closed.

        The name begins with the number of the window in six digits. Both are on the disk when the function returns.
        """
        name = pixels if isinstance(pixels, str) else f"{record.window:06d}.npy"
        if not isinstance(pixels, str):
            with self.create(name) as file:
                np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(pixels))
                file.write(pixels.data)  # errors of np.save do not contain the reason
        content = {"record": plain_values(record), "files": {name: self._digest(name, synchronised=True)}}
        self._write(f"{record.window:06d}.json", content, self._key)
        self._finished[record.window] = record, name

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
        return [self._finished[window][1] for window in sorted(self._finished)]

    def frames(self) -> Iterator[Array]:
        """Frames of the finished windows in order, from the files of arrays."""
        for name in self.files():
            with self.open(name) as file:
                yield from np.load(file, allow_pickle=False)

    def remove(self) -> None:
        """Remove the folder with its windows, and the empty folders above it that were created for it.

        It is renamed first: if the process is killed meanwhile, ``temporary_folder`` removes the rest later.
        """
        self._finished.clear()
        hidden = self.path.with_name(f".{self.sink.name}.{secrets.token_hex(4)}{PART}")
        if self._has_its_name():
            self.path.rename(hidden)
            sync(hidden.parent)
            shutil.rmtree(hidden, ignore_errors=True)
        with suppress(OSError):  # folders that others use
            folder = self.path.absolute().parent
            while folder != self._above:
                folder.rmdir()
                folder = folder.parent

    def close(self) -> None:
        """Release the folder; it is removed if it contains no finished window."""
        try:
            if not self._finished:
                self.remove()
        finally:
            self._opened.close()


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
    detection: DetectedVibration | None  # in the first window with its offset curve, if it was computed in this process
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
        lost = [(self.failed, "window", "failed"), (self.bad_frames, "frame", "could not be used")]
        texts = [f"{number_of(count, what)} {why}" for count, what, why in lost if count]
        if texts:
            lines.append(f"{', '.join(texts)}: see {self.manifest.name}")
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
        make_folder(self.manifest.parent)
        manifest = StackManifest(**self.header, **stated, windows=tuple(folder.records()))
        with atomic.whole(self.manifest) as part:
            manifest.save(part)
            yield manifest
        sync(self.manifest.absolute().parent)  # the temporary folder is gone as well
        folder.remove()

    def report(self, manifest: StackManifest, resumed: int, detection: DetectedVibration | None = None) -> StackReport:
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
            detection=detection,
            manifest=self.manifest,
            not_kept=manifest.not_kept,
        )
