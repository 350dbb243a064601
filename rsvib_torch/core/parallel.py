"""Independent pieces of work in parallel threads, for sequences of operations too short to use all cores."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

__all__ = ["in_parallel"]

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_parallel(work: Callable[[Item], Result], items: Iterable[Item], device: torch.device) -> list[Result]:
    """Call a function for every item, on a CPU in as many threads as PyTorch may use, without gradients.

    The threads share the number of threads that PyTorch may use within each operation. On other devices, or with one
    thread, it is a plain loop.

    Args:
        work: Called with every item; must not write to memory that another call reads.
        items: The items.
        device: Device of the tensors.

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
                    for _ in waiting:  # no thread begins another item
                        pass

    try:
        # a new pool each time, because a kept one would not survive a fork; this thread takes part, because the C
        # library keeps the memory that it frees for the next call, but may return that of other threads
        with ThreadPoolExecutor(threads - 1) as pool:
            for _ in range(threads - 1):
                pool.submit(take_part)
            take_part()
    finally:
        torch.set_num_threads(allowed)  # the initial value of threads that are started later
    if errors:
        raise errors[min(errors)]
    return [results[place] for place in range(len(items))]
