"""One line about unforeseen errors: exhausted memory and threads, and defects of the package or a library."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["in_one_line", "unexpected_errors_in_one_line"]


def in_one_line(error: BaseException) -> str:
    """What happened and the remedy, if there is one.

    Example:
        >>> in_one_line(RuntimeError("can't start new thread"))
        'the system cannot start another thread: use fewer workers, or raise the limit of processes (ulimit -u)'
        >>> in_one_line(KeyError("row"))
        "unexpected KeyError: 'row'"
    """
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError) or "allocate" in text or "out of memory" in text:
        return "not enough memory for a stack of this size: process fewer frames at a time"
    if "can't start new thread" in text:
        return "the system cannot start another thread: use fewer workers, or raise the limit of processes (ulimit -u)"
    if isinstance(error, RecursionError):
        return "the input is nested too deeply"
    return f"unexpected {type(error).__name__}: {text[:500]}"


@contextmanager
def unexpected_errors_in_one_line() -> Iterator[None]:
    """Turn errors that no check foresaw into a ``ValueError``, or an ``OSError`` for memory and threads."""
    try:
        yield
    except (ArithmeticError, LookupError, MemoryError, RuntimeError) as error:
        message = in_one_line(error)
        if message.startswith("not enough memory"):
            raise OSError(errno.ENOMEM, message) from error
        if message.startswith("the system cannot start"):
            raise OSError(errno.EAGAIN, message) from error
        raise ValueError(message) from error
