"""Items of an iterator, made ahead in a thread."""

import queue
import threading
from collections.abc import Generator, Iterator
from typing import Any, TypeVar

import torch

Item = TypeVar("Item")
_END = object()


def prefetched(items: Iterator[Item], count: int) -> Generator[Item, None, None]:
    """Yield the items of an iterator, which a thread makes while earlier ones are used; ``count`` of them wait.

    The thread uses one thread of PyTorch. It ends with the iterator, or when the generator is closed. Errors of the
    iterator are raised behind the items before them.

    Example:
        >>> list(prefetched(iter("abc"), 2))
        ['a', 'b', 'c']
    """
    waiting: queue.Queue[Any] = queue.Queue(count)
    stopped = threading.Event()

    def put(item: Any) -> None:
        while not stopped.is_set():
            try:
                waiting.put(item, timeout=0.2)  # s
            except queue.Full:
                continue
            return

    def work() -> None:
        torch.set_num_threads(1)
        error: BaseException | None = None
        try:
            for item in items:
                put(item)
                if stopped.is_set():
                    break
        except BaseException as raised:
            error = raised
        finally:
            if isinstance(items, Generator):
                items.close()
            put((_END, error))

    threads = torch.get_num_threads()
    thread = threading.Thread(target=work, name="rsvib-ahead", daemon=True)
    thread.start()
    try:
        while True:
            item = waiting.get()
            if isinstance(item, tuple) and len(item) == 2 and item[0] is _END:
                if item[1] is not None:
                    raise item[1]
                return
            yield item
    finally:
        stopped.set()
        thread.join()
        torch.set_num_threads(threads)  # the default of threads that start later
