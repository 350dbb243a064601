"""The vibration in every window of a stack of any length, written down for later."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from rsvib_torch.io.atomic import whole_file
from rsvib_torch.io.files import PathLike
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.stacks.engines import compute_here
from rsvib_torch.stacks.fingerprint import fingerprint
from rsvib_torch.stacks.job_setup import DEFAULT_WINDOW, HOPELESS, job_windows_at_once, make_job
from rsvib_torch.stacks.manifest import manifest_header, write_manifest
from rsvib_torch.stacks.windows import cut_windows

__all__ = ["detect_stack"]


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
    job = make_job(
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
    at_once = job_windows_at_once(job, window, memory, workers)
    header = manifest_header(job, window, None, None, fingerprint(job.source))
    errors: list[str] = []

    def records() -> Iterator[dict[str, Any]]:
        for record in compute_here(job, windows, lambda result, _: job.record(result, 0), at_once=at_once):
            errors.extend([record["error"]] if record["error"] is not None else [])
            if len(errors) == min(HOPELESS, len(windows)) == record["window"] + 1:
                raise ValueError(errors[0])
            if progress is not None:
                progress(record["last"] + 1, job.info.shape[0])
            yield record

    with whole_file(manifest) as part:
        write_manifest(part, header, records())
