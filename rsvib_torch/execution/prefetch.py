"""Loops over a source of items, which threads make and process ahead of the one that uses the results."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import repeat, takewhile
from typing import Any, TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")
_END: Any = object()


def in_order(
    items: Iterable[Any],
    submit: Callable[[Any], Item],
    capacity: Callable[[], int],
    result: Callable[[Item], Result],
    waiting: deque[Item],
) -> Generator[Result, None, None]:
    """Results of items in their order; up to ``capacity()`` of them are computed or wait, in ``waiting``."""
    remaining = iter(items)
    while True:
        while len(waiting) < capacity() and (item := next(remaining, None)) is not None:
            waiting.append(submit(item))
        if not waiting:
            return
        yield result(waiting.popleft())


@contextmanager
def _pool(count: int, threads: int, items: Generator[Any, None, None]) -> Iterator[ThreadPoolExecutor]:
    """Threads that use ``threads`` of PyTorch each; they end with the block, and then the source of items is closed."""
    before = torch.get_num_threads()
    pool = ThreadPoolExecutor(count, "rsvib", initializer=torch.set_num_threads, initargs=(threads,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
        items.close()
        torch.set_num_threads(before)  # the default of threads that start later


def prefetched(items: Generator[Item, None, None], count: int, threads: int = 1) -> Generator[Item, None, None]:
    """Yield the items of a generator, which a thread makes while earlier ones are used; ``count`` of them wait.

    The thread uses a number of ``threads`` of PyTorch. It ends with the generator, or when this one is closed. Errors
    are raised behind the items before them.
    """
    with _pool(1, threads, items) as pool:
        made = in_order(repeat(0), lambda _: pool.submit(next, items, _END), lambda: count + 1, Future.result, deque())
        yield from takewhile(lambda item: item is not _END, made)


def in_threads(
    work: Callable[..., Result], items: Generator[tuple[Any, ...], None, None], *, at_once: int, threads: int = 1
) -> Generator[Result, None, None]:
    """Results of ``work(*item)`` in order, from ``at_once`` threads with ``threads`` of PyTorch each."""
    with _pool(at_once, threads, items) as pool:
        yield from in_order(items, lambda item: pool.submit(work, *item), lambda: at_once + 1, Future.result, deque())
