"""How much of a scene is solved at a time, and the memory for it."""

from dataclasses import dataclass, field
from threading import Lock

import torch
from torch import Tensor

from rsvib_torch.core.banded_solver import BandedMemory
from rsvib_torch.core.chunking import runs
from rsvib_torch.restoration.exact.interpolated_solver import SubstitutionMemory, chosen_nodes
from rsvib_torch.restoration.scene_model.segments import Segments

__all__ = ["Partition"]

_TIMES_THE_SCENE = 8  # the coefficients of a scene: memory of the bands that are solved at a time, or
_VALUES = {"cpu": 1 << 23, "cuda": 1 << 28}  # so many, for small scenes
_STEP = {"cpu": 40_000, "cuda": 1 << 22}  # values that a step of the elimination should change to be worth its call
_LEAST_ROWS = {"cpu": 512, "cuda": 256}  # of a segment: its overlap costs time
_THREADS = 2  # chunks side by side on a CPU, at most: more calls of few values would wait for each other
_OVERLAP = 96  # rows of segments on either side: what lies further away does not matter to 1e-5
_ALIGNED = 8  # frequencies; rows of bands begin at full cache lines
_SPARE = 32  # rows that the next scene may be higher
# between frequencies that are factored, cycles per px: what priors allow, and what a blur of a px allows
_COARSEST, _OF_BLUR = 1 / 64, 1 / 140
_LONGEST = 1.5  # px that kernels may reach to for that: more, and systems are too near to singular
_FEW = 5  # times fewer, or else all are factored


def _round_up(value: int, step: int) -> int:
    return -(-value // step) * step


@dataclass(frozen=True, eq=False)
class Shares:
    """A system of systems cut into shares.

    Attributes:
        chunk: Frequencies S that are solved at a time.
        segments: Of the rows.
        nodes: (N,) frequencies that are factored, ascending from the first to the last; None: all of them.
        node_segments: Of the rows, for factoring those.
    """

    chunk: int
    segments: Segments
    nodes: Tensor | None = None
    node_segments: Segments | None = None

    def parts(self, frequencies: int) -> list[slice]:
        """Chunks of all frequencies, the last one narrower."""
        return runs(frequencies, self.chunk)


@dataclass(eq=False)
class Partition:
    """What is solved at a time, and memory that one system after the other uses.

    Attributes:
        chunk: Frequencies; None: as suits the device.
        segments: Segments of rows at most; None likewise.
        lock: Held while systems are factored; partitions of several threads share one.
    """

    chunk: int | None = None
    segments: int | None = None
    lock: Lock = field(default_factory=Lock)
    _memories: dict[int | str, BandedMemory | SubstitutionMemory] = field(default_factory=dict)

    @staticmethod
    def threads(device: torch.device) -> int:
        """Chunks that are solved side by side."""
        return min(torch.get_num_threads(), _THREADS) if device.type == "cpu" else 1

    def of(self, rows: int, width: int, length: int, device: torch.device, reach: float, *, blurred: bool) -> Shares:
        """Shares of systems that are solved once.

        Where exposures blur, frequencies that many rows in turn do not show follow from rows far away: there the rows
        are one segment.

        Args:
            rows: Of the scene.
            width: Half-width of the band.
            length: Period of the rows.
            device: Where they are.
            reach: Distance in px that the kernels reach to.
            blurred: Whether the scene moves by more than a px during an exposure.
        """
        kind = device.type if device.type in _VALUES else "cuda"
        frequencies = length // 2 + 1
        nodes = chosen_nodes(frequencies, length * min(_COARSEST, _OF_BLUR / max(reach, 1e-9)), device)
        if reach > _LONGEST or _FEW * len(nodes) > frequencies:
            return self.factoring_all(rows, width, frequencies, device, blurred=blurred)
        most = 1 if blurred else max(1, rows // _LEAST_ROWS[kind])
        split = 1 if kind == "cpu" else most  # there a step is no call
        chunk = self._chunk(rows, split, width + 2, width, frequencies, kind)
        segments = self._segments(rows, split, width * chunk, kind, blurred=blurred)
        return Shares(chunk, segments, nodes, self._segments(rows, most, width**2 * len(nodes), kind, blurred=blurred))

    def factoring_all(
        self, rows: int, width: int, frequencies: int, device: torch.device, *, blurred: bool, keep: bool = False
    ) -> Shares:
        """Shares of systems whose every frequency is factored.

        Args:
            rows: As in ``of``.
            width: As in ``of``.
            frequencies: How many.
            device: As in ``of``.
            blurred: As in ``of``.
            keep: All factors are kept, and solving with them is what costs the time.
        """
        kind = device.type if device.type in _VALUES else "cuda"
        split = 1 if blurred else max(1, rows // _LEAST_ROWS[kind])
        chunk = self._chunk(rows, split, 2 * width + 1, width**2, frequencies, kind)
        if keep and self.chunk is None:
            chunk = frequencies
        each = max(width, 1) if keep else max(width, 1) ** 2
        return Shares(chunk, self._segments(rows, split, each * chunk, kind, blurred=blurred))

    def _chunk(self, rows: int, split: int, kept: int, work: int, frequencies: int, kind: str) -> int:
        """Frequencies at a time, of which each row keeps so many values, and takes so much work."""
        threads = _THREADS if kind == "cpu" else 1  # whatever is allowed: results are the same with any number
        windows = rows + 2 * _OVERLAP * (split - 1)
        values = max(_VALUES[kind], _TIMES_THE_SCENE * rows * frequencies)
        most = max(1, values // (threads * windows * kept))
        rounds = -(-frequencies // (threads * most))
        narrow = -(-frequencies // (threads * rounds))
        if work * narrow * split < _STEP[kind] // 2:  # threads would wait for each other
            narrow = -(-frequencies // rounds)
        return min(self.chunk or _round_up(narrow, _ALIGNED), frequencies)

    def _segments(self, rows: int, split: int, work: int, kind: str, *, blurred: bool) -> Segments:
        """Segments of rows, each of whose steps takes so much work."""
        count = max(1, min(-(-_STEP[kind] // work), split)) if self.segments is None or blurred else self.segments
        return Segments(rows, count, _OVERLAP)

    def memory(
        self, thread: int | str, rows: int, width: int, right_sides: int, batch: int, like: Tensor
    ) -> BandedMemory:
        """Memory of a thread for systems of at least so many rows."""
        memory, sizes = self._memories.get(thread), (width, right_sides, batch)
        if not isinstance(memory, BandedMemory) or not memory.holds(rows, *sizes):
            memory = BandedMemory(self._freed(thread, rows), *sizes, like)
            self._memories[thread] = memory
        return memory

    def substitution_memory(
        self, thread: int, rows: int, width: int, right_sides: int, windows: int, systems: int, like: Tensor
    ) -> SubstitutionMemory:
        """Memory of a thread for systems of at least so many rows with interpolated factors."""
        memory, sizes = self._memories.get(thread), (width, right_sides, windows, systems)
        if not isinstance(memory, SubstitutionMemory) or not memory.holds(rows, *sizes):
            memory = SubstitutionMemory(self._freed(thread, rows), *sizes, like)
            self._memories[thread] = memory
        return memory

    def _freed(self, thread: int | str, rows: int) -> int:
        """Give up the memory of a thread; returns how many rows the next is made for."""
        self._memories.pop(thread, None)
        return _round_up(rows, _SPARE)
