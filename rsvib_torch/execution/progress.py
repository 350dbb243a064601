"""Progress of long loops, reported to one listener of the process: the terminal of the program.

Without a listener nothing is reported, and a loop pays one call per step.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Listener = Callable[[int, int, str], None]  # steps done, number of steps, unit of a step

_lock = threading.Lock()  # loops may run in several threads
_listeners: list[Listener] = []


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Report the progress of all loops in the block to a function of the steps done, their number, and their unit."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def steps(total: int, unit: str) -> Callable[..., None]:
    """Begin a loop; the result is called after each step, or with the number of steps after several, by any thread."""
    done, listeners = 0, _listeners[-1:]

    def advance(count: int = 1) -> None:
        nonlocal done
        with _lock:
            done += count
            for listener in listeners:
                listener(done, total, unit)

    advance(0)
    return advance
