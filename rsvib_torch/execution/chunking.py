"""Processing of tensors in chunks along one axis."""

from collections.abc import Iterable

import torch
from torch import Tensor


def runs(count: int, size: int) -> list[slice]:
    """Consecutive slices of ``size`` indices that cover ``count``; the last one may be shorter."""
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def at_once(bytes_per_item: int, device: torch.device, *, cpu_bytes: int = 2**23) -> int:
    """Number of items to process at a time: those of ``cpu_bytes``, which stay in the cache of a CPU.

    On other devices those of 1 GiB, which limits the memory. At least 1.
    """
    return max(1, (cpu_bytes if device.type == "cpu" else 2**30) // bytes_per_item)


def chunks(count: int, bytes_per_item: int, device: torch.device, *, multiple: int = 1) -> list[slice]:
    """Slices of consecutive items, a multiple of ``multiple`` each, to be processed at a time, see ``at_once``."""
    return runs(count, at_once(bytes_per_item * multiple, device) * multiple)


def gathered(pieces: Iterable[tuple[slice, Tensor]], count: int, dim: int) -> Tensor:
    """Join pieces of a tensor, each with its slice along ``dim``, to one tensor of ``count`` indices.

    Each piece is copied as soon as it is computed, so that one piece at a time needs memory. Pieces that require
    gradients, and those of a graph that is recorded, are concatenated. A piece that is the whole is returned.
    """
    kept: list[Tensor] = []
    whole: Tensor | None = None
    for place, piece in pieces:
        if piece.shape[dim] == count:
            return piece
        if piece.requires_grad or torch.compiler.is_compiling():
            kept.append(piece)
            continue
        if whole is None:
            whole = piece.new_empty(*piece.shape[:dim], count, *piece.shape[dim + 1 :])
        whole.narrow(dim, place.start, piece.shape[dim]).copy_(piece)
    return torch.cat(kept, dim) if whole is None else whole
