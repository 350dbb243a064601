"""How much of a scene is solved at a time, and the memory for it."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from rsvib_torch.restoration.banded_solver import BandedMemory
from rsvib_torch.restoration.segments import Segments

__all__ = ["Partition"]

_TIMES_THE_SCENE = 8  # the coefficients of a scene: memory of the bands that are solved at a time, or
_VALUES = {"cpu": 1 << 23, "cuda": 1 << 28}  # so many, for small scenes
_STEP = {"cpu": 40_000, "cuda": 1 << 22}  # values that a step of the elimination should change to be worth its call
_LEAST_ROWS = {"cpu": 512, "cuda": 256}  # of a segment: its overlap costs time
_THREADS = 2  # chunks side by side on a CPU, at most: more calls of few values would wait for each other
_OVERLAP = 96  # rows of segments on either side: what lies further away does not matter to 1e-5
_ALIGNED = 8  # frequencies; rows of bands begin at full cache lines
_SPARE = 32  # rows that the next scene may be higher


def _round_up(value: int, step: int) -> int:
    return -(-value // step) * step


@dataclass(eq=False)
class Partition:
    """What is solved at a time, and memory that one system after the other uses.

    Attributes:
        chunk: Frequencies; None: as suits the device.
        segments: Segments of rows at most; None likewise.
    """

    chunk: int | None = None
    segments: int | None = None
    _memories: dict[int, BandedMemory] = field(default_factory=dict)

    @staticmethod
    def threads(device: torch.device) -> int:
        """Chunks that are solved side by side."""
        return min(torch.get_num_threads(), _THREADS) if device.type == "cpu" else 1

    def of(
        self, rows: int, width: int, frequencies: int, device: torch.device, *, blurred: bool, keep: bool
    ) -> tuple[int, Segments]:
        """Frequencies at a time and segments of the rows.

        Where exposures blur, frequencies that many rows in turn do not show follow from rows far away: there the rows
        are one segment.

        Args:
            rows: Of the scene.
            width: Half-width of the band.
            frequencies: How many.
            device: Where they are.
            blurred: Whether the scene moves by more than a px during an exposure.
            keep: All factors are kept, and solving with them is what costs the time.
        """
        kind = device.type if device.type in _VALUES else "cuda"
        threads = _THREADS if kind == "cpu" else 1  # whatever is allowed: results are the same with any number
        split = 1 if blurred else max(1, rows // _LEAST_ROWS[kind])
        windows = rows + 2 * _OVERLAP * (split - 1)
        values = max(_VALUES[kind], _TIMES_THE_SCENE * rows * frequencies)
        most = max(1, values // (threads * windows * (2 * width + 1)))
        rounds = -(-frequencies // (threads * most))
        narrow = -(-frequencies // (threads * rounds))
        if width**2 * narrow * split < _STEP[kind] // 2:  # threads would wait for each other
            narrow = -(-frequencies // rounds)
        chunk = _round_up(narrow, _ALIGNED)
        chunk = min(self.chunk or chunk, frequencies)
        if keep and self.chunk is None:
            chunk = frequencies
        wanted = -(-_STEP[kind] // (max(width, 1) ** (1 if keep else 2) * chunk))
        count = max(1, min(wanted, split)) if self.segments is None or blurred else self.segments
        return chunk, Segments(rows, count, _OVERLAP)

    def memory(self, thread: int, rows: int, width: int, right_sides: int, batch: int, like: Tensor) -> BandedMemory:
        """Memory of a thread for systems of at least so many rows."""
        memory = self._memories.get(thread)
        if memory is None or not memory.holds(rows, width, right_sides, batch):
            self._memories.pop(thread, None)  # before the next is taken
            memory = BandedMemory(_round_up(rows, _SPARE), width, right_sides, batch, like)
            self._memories[thread] = memory
        return memory
