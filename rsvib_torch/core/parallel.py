"""Independent pieces of work on all cores, where one operation after the other would keep but one of them busy."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import Generic, TypeVar

import torch

__all__ = ["MadeOnce", "in_parallel"]

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_parallel(work: Callable[[Item], Result], items: Iterable[Item], device: torch.device) -> list[Result]:
    """Do some work for every item, on a CPU in as many threads as PyTorch may use; nothing is differentiated.

    The threads share what PyTorch may use for each operation. On other devices, or where one thread is allowed, it is
    a plain loop.

    Args:
        work: Called with every item; must not write what another call reads.
        items: The items.
        device: Where the tensors are.

    Returns:
        The results, in the order of the items.

    Example:
        >>> in_parallel(lambda value: float(value.sum()), torch.ones(3, 2), torch.device("cpu"))
        [2.0, 2.0, 2.0]
    """
    items = list(items)
    allowed = torch.get_num_threads()
    threads = min(allowed, len(items)) if device.type == "cpu" else 1
    if threads == 1:
        with torch.no_grad():
            return [work(item) for item in items]
    inference = torch.is_inference_mode_enabled()
    waiting = enumerate(items)  # each of the threads takes the next one
    results: dict[int, Result] = {}
    errors: dict[int, BaseException] = {}

    def take_part() -> None:
        torch.set_num_threads(allowed // threads)  # of this thread
        with torch.inference_mode(inference), torch.no_grad():
            for place, item in waiting:
                try:
                    results[place] = work(item)
                except BaseException as error:
                    errors[place] = error
                    for _ in waiting:  # nobody begins another
                        pass

    try:
        # a pool of its own: one that is kept would not survive a fork. This thread does its share: what it frees is
        # kept for the next call, while the C library may give back what others held
        with ThreadPoolExecutor(threads - 1) as pool:
            for _ in range(threads - 1):
                pool.submit(take_part)
            take_part()
    finally:
        torch.set_num_threads(allowed)  # what threads begin with that are started later
    if errors:
        raise errors[min(errors)]
    return [results[place] for place in range(len(items))]


class MadeOnce(Generic[Result]):
    """What several threads need, made by the first of them, while the others do what they can without it.

    Made by many short calls from Python, for each of which threads would wait for one another, so that with a lock in
    common only one of several such things is made at a time.

    Args:
        make: Makes it.
        lock: Held meanwhile.

    Example:
        >>> squares = MadeOnce(lambda: [n * n for n in range(4)], Lock())
        >>> squares.begin()  # now, unless something else is being made
        >>> squares.get()
        [0, 1, 4, 9]
    """

    def __init__(self, make: Callable[[], Result], lock: Lock) -> None:
        self._make, self._lock = make, lock
        self._made: list[Result] = []

    def begin(self) -> None:
        """Make it, unless the lock is held; then it is made when it is asked for."""
        if not self._made and self._lock.acquire(blocking=False):
            try:
                self._complete()
            finally:
                self._lock.release()

    def get(self) -> Result:
        """The thing, made now if it was not yet."""
        if not self._made:
            with self._lock:
                self._complete()
        return self._made[0]

    def _complete(self) -> None:
        if not self._made:
            self._made.append(self._make())
