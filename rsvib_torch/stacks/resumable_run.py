"""A run that writes an output from windows: it is resumed if it was interrupted, and ends with the manifest."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsvib_torch.core.arguments import check_fields
from rsvib_torch.core.atomic import make_folder, remove_abandoned, sync, whole_file
from rsvib_torch.core.presentation import Summarised
from rsvib_torch.core.text import number_of
from rsvib_torch.options import RunOptions
from rsvib_torch.stacks.job import WindowResult
from rsvib_torch.stacks.manifest import manifest_text, read_manifest
from rsvib_torch.stacks.run_folder import RunFolder, describe_difference, disk_errors_named, work_folder


@dataclass(frozen=True, eq=False, repr=False)
class StackReport(Summarised):
    """Summary of a run.

    Attributes:
        frames: Number of frames written, including those of an interrupted run that was resumed.
        windows: Number of windows of the stack.
        restored: Number of windows whose frames were restored.
        failed: Number of windows in which detection or restoration failed.
        bad_frames: Number of frames that could not be used.
        resumed: Number of windows that were complete before.
        seconds: Duration of the run.
        first: Result of the first window, if it was computed in this process.
        manifest: Path of the manifest.
        not_kept: Metadata of the input that the output does not contain.

    Example:
        >>> import rsvib_torch as rsv
        >>> report = rsv.process_stack("frames.tif", "restored.tif", timing)  # doctest: +SKIP
        >>> report.frames, report.windows, report.restored, report.failed  # doctest: +SKIP
        (200, 28, 28, 0)
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
    not_kept: tuple[str, ...]

    def __post_init__(self) -> None:
        check_fields(self)

    def summary(self) -> str:
        """Numbers of frames and windows, and the time."""
        lines = [f"{number_of(self.frames, 'frame')} in {number_of(self.windows, 'window')}, {self.restored} restored"]
        if self.frames and not self.resumed:
            lines[0] += f", {self.seconds / self.frames:.2g} s per frame"
        if self.resumed:
            lines.append(f"windows complete before this run: {self.resumed}")
        if self.failed:
            lines.append(
                f"detection or restoration failed in {number_of(self.failed, 'window')}: see {self.manifest.name}"
            )
        if self.bad_frames:
            lines.append(f"{number_of(self.bad_frames, 'frame')} could not be used: see {self.manifest.name}")
        return "\n".join(lines)


def manifest_path(sink: Path, options: RunOptions) -> Path:
    """Path of the manifest of a run."""
    return sink.with_name(f"{sink.name}.manifest.json") if options.manifest is None else Path(options.manifest)


def run_to_file(
    sink: Path,
    manifest: Path,
    header: dict[str, Any],
    *,
    windows: int,
    resume: bool,
    compute: Callable[[RunFolder], dict[str, Any]],
    write: Callable[[RunFolder], None],
    not_kept: Callable[[int], Sequence[str]],
) -> StackReport:
    """Compute the windows of a run that are not finished, and write the output and its manifest.

    ``compute`` adds the missing windows to the folder and returns further keys of the manifest; ``write`` writes the
    output from the folder; ``not_kept`` names the metadata that an output of a number of frames does not contain.
    """
    start = time.perf_counter()

    def report(windows_done: Iterable[Mapping[str, Any]], resumed: int, lost: Sequence[str]) -> StackReport:
        records = list(windows_done)
        return StackReport(
            frames=sum(record["written"] for record in records),
            windows=windows,
            restored=sum(record["frames"] == "restored" for record in records),
            failed=sum(record["error"] is not None for record in records),
            bad_frames=sum(len(record["bad_frames"]) for record in records),
            resumed=resumed,
            seconds=time.perf_counter() - start,
            first=None,
            manifest=manifest,
            not_kept=tuple(lost),
        )

    if resume and not work_folder(sink).exists() and sink.exists() and manifest.exists():
        complete = read_manifest(manifest)
        difference = describe_difference(complete.header(), header)
        if difference:
            raise ValueError(f"{sink}: cannot resume: {difference}; omit resume to replace the output")
        for path in (sink, manifest):
            remove_abandoned(path)
        return report(map(vars, complete.windows), windows, complete.not_kept)
    folder = RunFolder(sink, header, resume=resume)
    try:
        resumed = folder.count
        results = compute(folder)
        lost = not_kept(folder.written)
        with disk_errors_named(folder):
            make_folder(manifest.parent)
            with whole_file(manifest) as part:
                part.write_text(manifest_text(header, folder.records(), lost, **results), encoding="utf-8")
                write(folder)
            sync(manifest.absolute().parent)  # the temporary folder is gone as well
        summary = report(folder.records(), resumed, lost)
        folder.remove()
        return summary
    finally:
        folder.close()
