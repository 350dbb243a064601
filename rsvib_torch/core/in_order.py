"""Many small operations in place, one after the other, where each reads what those before it wrote."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch
from torch import Tensor

__all__ = ["making_views", "subtract_products"]


@contextmanager
def making_views() -> Iterator[None]:
    """Let Python not look for garbage while views of every step of a long loop are made.

    After every few hundred new objects it would look through them, and now and then through all objects that there
    are, which takes longer than the loop.
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def subtract_products(values: tuple[Tensor, ...], first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> None:
    """``values[j] -= first[j] * second[j]`` for one j after the other.

    In one call where that is known to keep the order: calls from Python take as long as the arithmetic, and those of
    two threads wait for each other.

    Args:
        values: Changed in place; may share memory with any of the others.
        first: As many.
        second: As many.

    Example:
        >>> rows = torch.ones(4)
        >>> subtract_products(rows[1:].unbind(), torch.ones(3).unbind(), rows[:3].unbind())
        >>> rows.tolist()
        [1.0, 0.0, 1.0, 0.0]
    """
    if values and values[0].device.type == "cpu" and _keeps_order():
        torch._foreach_addcmul_(values, first, second, value=-1)
        return
    for value, left, right in zip(values, first, second, strict=True):
        value.addcmul_(left, right, value=-1)


@cache
def _keeps_order() -> bool:
    """Whether PyTorch goes through tensors on a CPU from first to last: it does, but does not promise to."""
    rows = torch.ones(513, 64)
    torch._foreach_addcmul_(rows[1:].unbind(), rows[:-1].unbind(), torch.full((512, 1), -1.0).unbind(), value=-1)
    return torch.equal(rows, torch.arange(1.0, 514.0)[:, None].expand_as(rows))
