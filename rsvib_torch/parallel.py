"""Independent pieces of work on all cores, where one operation after the other would keep but one of them busy."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

__all__ = ["in_parallel"]

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

    def alone(item: Item) -> Result:
        torch.set_num_threads(allowed // threads)  # of this thread
        with torch.inference_mode(inference), torch.no_grad():
            return work(item)

    try:
        # a pool of its own: one that is kept would not survive a fork
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(alone, items))
    finally:
        torch.set_num_threads(allowed)  # what threads begin with that are started later
