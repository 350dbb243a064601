"""One line about unforeseen errors: exhausted memory and threads, and defects of the package or a library."""

import errno

from rsvib_torch.core.text import one_line


def system_error(error: BaseException) -> OSError | None:
    """The error of the system that exhausted memory or threads stand for, with the remedy; None for others."""
    text = str(error)
    if isinstance(error, MemoryError) or "allocate" in text or "out of memory" in text:
        return OSError(errno.ENOMEM, "not enough memory for a stack of this size: process fewer frames at a time")
    if "can't start new thread" in text:
        remedy = "use fewer workers, or raise the limit of processes (ulimit -u)"
        return OSError(errno.EAGAIN, f"the system cannot start another thread: {remedy}")
    return None


def in_one_line(error: BaseException) -> str:
    """What happened and the remedy, if there is one.

    Example:
        >>> in_one_line(RuntimeError("can't start new thread"))
        'the system cannot start another thread: use fewer workers, or raise the limit of processes (ulimit -u)'
        >>> in_one_line(KeyError("row"))
        "unexpected KeyError: 'row'"
    """
    known = system_error(error)
    if known is not None:
        return str(known.strerror)
    if isinstance(error, RecursionError):
        return "the input is nested too deeply"
    return f"unexpected {type(error).__name__}: {one_line(error)}"
