"""A stack of any length as an iterator of restored windows."""

from collections.abc import Iterator, Mapping
from typing import Any

from rsvib_torch.io.files import PathLike
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.stacks.engines import compute_here
from rsvib_torch.stacks.job import WindowResult
from rsvib_torch.stacks.job_setup import DEFAULT_WINDOW, job_windows_at_once, make_job
from rsvib_torch.stacks.windows import cut_windows

__all__ = ["iterate_stack"]


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
    job = make_job(
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
    at_once = job_windows_at_once(job, window, memory, workers)
    yield from compute_here(job, windows, lambda result, _: result, at_once=at_once)
