"""Many small operations in place, one after the other, where each reads what those before it wrote."""

from functools import cache

import torch
from torch import Tensor

__all__ = ["subtract_products"]


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
