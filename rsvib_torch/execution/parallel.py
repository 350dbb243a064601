"""Threads, chunks, items computed ahead; decorators that exclude functions from mixed precision, graphs, gradients."""

import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from copy import copy
from dataclasses import is_dataclass
from functools import cache, wraps
from importlib import import_module
from itertools import chain, islice
from threading import Lock
from types import ModuleType
from typing import ParamSpec, TypeVar, cast

import numpy as np
import torch
from threadpoolctl import ThreadpoolController
from torch import Tensor


def runs(count: int, size: int) -> list[slice]:
    """Consecutive slices of ``size`` indices that cover ``count``; the last one may be shorter."""
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def at_once(bytes_per_item: int, device: torch.device, *, cpu_bytes: int = 2**23) -> int:
    """Number of items to process at a time: at least 1, and as many as ``cpu_bytes`` hold, the cache of a CPU.

    On other devices, as many as 1 GiB holds, which limits the memory.
    """
    return max(1, (cpu_bytes if device.type == "cpu" else 2**30) // bytes_per_item)


def chunks(count: int, bytes_per_item: int, device: torch.device, *, multiple: int = 1) -> list[slice]:
    """Slices of consecutive items, a multiple of ``multiple`` each, to be processed at a time, see ``at_once``."""
    return runs(count, at_once(bytes_per_item * multiple, device) * multiple)


Item = TypeVar("Item")
Result = TypeVar("Result")

# px of a frame. Threads of one operation wait for each other at its end, and operations on a frame of 512 x 512 px take
# 0.1 ms. On two idle cores, a second thread saves a tenth of the time of a detection in a pair of 512 x 512 px. Beside
# eight other processes, one thread and two take 0.34 and 2.1 s, with 1024 x 1024 px 0.43 and 1.6 s
_SMALL = 1200 * 1200
_allowed: ContextVar[int | None] = ContextVar("allowed", default=None)


class ProcessSetting:
    """Context that changes a setting of the process: the first of several threads changes it, the last restores it."""

    def __init__(self, changed: Callable[[], AbstractContextManager[object]]) -> None:
        self._changed, self._lock, self._users = changed, Lock(), 0

    def __enter__(self) -> None:
        with self._lock:
            if self._users == 0:
                self._context = self._changed()
                self._context.__enter__()
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._context.__exit__(None, None, None)


@cache
def _blas(opencv: bool) -> ThreadpoolController:
    """The BLAS of NumPy, of SciPy, and of OpenCV if it is loaded, which have threads of their own."""
    import_module("scipy.linalg")  # a library is found once it is loaded
    return ThreadpoolController()


# Tables of fits are small, and threads of BLAS wait for each other after every product. Detection of three tones in 16
# frames of 266 x 266 px beside four busy processes on two cores: 3.0 s, and 17.4 s with the threads of BLAS
ONE_BLAS_THREAD = ProcessSetting(lambda: _blas("cv2" in sys.modules).limit(limits=1, user_api="blas"))


def allowed_threads() -> int:
    """Number of threads for independent pieces of work on a CPU, also within ``threads_for``."""
    return _allowed.get() or torch.get_num_threads()


@contextmanager
def threads_for(images: Tensor) -> Iterator[None]:
    """One thread within operations on small images (..., H, W) on a CPU; ``in_parallel`` uses as many as before."""
    allowed = torch.get_num_threads()
    if allowed == 1 or images.device.type != "cpu" or images.shape[-2:].numel() > _SMALL:
        yield
        return
    token = _allowed.set(allowed)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(allowed)
        _allowed.reset(token)


def in_parallel(
    work: Callable[[Item], Result], items: Iterable[Item], device: torch.device, *, at_most: int | None = None
) -> list[Result]:
    """Call a function for every item, on a CPU in as many threads as PyTorch may use, or fewer, without gradients.

    The threads share the number of threads that PyTorch may use within each operation. On other devices, or with one
    thread, it is a plain loop.
    """
    items = list(items)
    within = torch.get_num_threads()
    allowed = allowed_threads()
    threads = min(allowed, len(items), at_most or allowed) if device.type == "cpu" else 1
    if threads <= 1:
        with torch.no_grad():
            return [work(item) for item in items]
    inference = torch.is_inference_mode_enabled()
    waiting = enumerate(items)  # each of the threads takes the next one

    def take_part() -> list[tuple[int, Result]]:
        torch.set_num_threads(min(within, allowed // threads))  # of this thread
        with torch.inference_mode(inference), torch.no_grad():
            try:
                return [(place, work(item)) for place, item in waiting]
            except BaseException:
                deque(waiting, maxlen=0)  # no thread begins another item
                raise

    try:
        # a new pool each time, because a kept one would not survive a fork; this thread takes part, because the C
        # library keeps the memory that it frees for the next call, but may return that of other threads
        with ThreadPoolExecutor(threads - 1) as pool:
            futures = [pool.submit(take_part) for _ in range(threads - 1)]
            own_results = take_part()
    finally:
        torch.set_num_threads(within)  # the initial value of threads that are started later
    results = dict(chain(own_results, *(future.result() for future in futures)))
    return [results[place] for place in range(len(items))]


@contextmanager
def _pool(count: int, threads: int, items: Generator[object, None, None]) -> Iterator[ThreadPoolExecutor]:
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
    """Yield the items of a generator, which a thread computes while earlier ones are used; up to ``count`` wait.

    The thread uses a number of ``threads`` of PyTorch. It ends with the generator, or when this one is closed. An error
    is raised after the items before it.
    """
    with _pool(1, threads, items) as pool:
        waiting = deque(pool.submit(list, islice(items, 1)) for _ in range(count + 1))
        while item := waiting.popleft().result():  # empty if there are no further items
            yield item[0]
            waiting.append(pool.submit(list, islice(items, 1)))


def in_threads(
    work: Callable[..., Result], items: Generator[tuple[object, ...], None, None], *, at_once: int, threads: int = 1
) -> Generator[Result, None, None]:
    """Results of ``work(*item)`` in order, from ``at_once`` threads with ``threads`` of PyTorch each."""
    waiting: deque[Future[Result]] = deque()
    with _pool(at_once, threads, items) as pool:
        for item in items:
            waiting.append(pool.submit(work, *item))
            if len(waiting) > at_once:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


P = ParamSpec("P")
R = TypeVar("R")


_BACKENDS: ModuleType = torch.backends  # whose attributes are not typed


@contextmanager
def _products_of_float32() -> Iterator[None]:
    """Products and convolutions of float32 use float32, not TF32 or bfloat16."""
    cudnn, mkldnn = _BACKENDS.cudnn, _BACKENDS.mkldnn
    # those of cuDNN's recurrent networks are set together with its convolutions under one name
    kinds = (_BACKENDS.cuda.matmul, cudnn.conv, cudnn.rnn, mkldnn.matmul, mkldnn.conv)
    previous = [kind.fp32_precision for kind in kinds]
    for kind in kinds:
        kind.fp32_precision = "ieee"
    yield
    for kind, value in zip(kinds, previous, strict=True):
        kind.fp32_precision = value


_FLOAT32_PRODUCTS = ProcessSetting(_products_of_float32)


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function without autocast and TF32: splines, transforms and fits need all digits of float32.

    The device is that of the first tensor among the arguments.
    """

    @wraps(function)
    def in_full_precision(*args: P.args, **kwargs: P.kwargs) -> R:
        tensors = (value for value in (*args, *kwargs.values()) if isinstance(value, Tensor) and not value.is_meta)
        device = next((tensor.device.type for tensor in tensors), "cpu")
        with torch.autocast(device_type=device, enabled=False), _FLOAT32_PRODUCTS:
            return function(*args, **kwargs)

    return in_full_precision


def outside_graphs(function: Callable[P, R]) -> Callable[P, R]:
    """Exclude a function from ``torch.compile``: one break of the graph instead of many.

    Sizes of kernels and bands follow from the motion, so that a graph would be compiled again for every vibration.
    """
    disabled: list[Callable[P, R]] = []  # filled at the first use: importing the compiler takes seconds

    @wraps(function)
    def uncompiled(*args: P.args, **kwargs: P.kwargs) -> R:
        if not torch.compiler.is_compiling():
            return function(*args, **kwargs)
        if not disabled:
            disabled.append(torch.compiler.disable(function, reason="sizes follow from the motion"))
        return disabled[0](*args, **kwargs)

    return uncompiled


def without_gradients(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function in inference mode; its results can be differentiated and changed like all others.

    Operations on small tensors take 10 to 15 % less time than with ``torch.no_grad`` (detection in two frames of
    512 x 512 px, and a frame of ``VibrationTracker``). Derivatives that the function itself computes would be zero.
    NumPy does not warn of NaN and infinite values in the tables of fits, as PyTorch does not of those in tensors.
    """

    @wraps(function)
    def in_inference_mode(*args: P.args, **kwargs: P.kwargs) -> R:
        with ONE_BLAS_THREAD, torch.inference_mode(), np.errstate(all="ignore"):
            result = function(*args, **kwargs)
        return outside_inference(result)

    return in_inference_mode


def outside_inference(value: R) -> R:
    """Copies of the tensors of inference mode in a tensor, sequence, mapping or dataclass; the rest is kept."""
    result: object = value
    if isinstance(value, Tensor):
        result = value.clone() if value.is_inference() else value
    elif isinstance(value, (tuple, list)):
        result = type(value)(map(outside_inference, value))
    elif isinstance(value, dict):
        result = {key: outside_inference(entry) for key, entry in value.items()}
    elif is_dataclass(value) and not isinstance(value, type):
        result = copy(value)
        vars(result).update(outside_inference(vars(value)))  # cached properties as well
    return cast(R, result)
