"""Items of an iterator, made ahead in a thread."""

from collections import deque
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch

Item = TypeVar("Item")
_END: Any = object()


def prefetched(items: Generator[Item, None, None], count: int) -> Generator[Item, None, None]:
    """Yield the items of a generator, which a thread makes while earlier ones are used; ``count`` of them wait.

    The thread uses one thread of PyTorch. It ends with the generator, or when this one is closed. Errors are raised
    behind the items before them.
    """
    threads = torch.get_num_threads()
    pool = ThreadPoolExecutor(1, "rsvib-ahead", initializer=torch.set_num_threads, initargs=(1,))
    try:
        waiting = deque(pool.submit(next, items, _END) for _ in range(count))
        while (item := waiting.popleft().result()) is not _END:
            waiting.append(pool.submit(next, items, _END))
            yield item
    finally:
        pool.shutdown(cancel_futures=True)
        items.close()
        torch.set_num_threads(threads)  # the default of threads that start later
