"""Results share no memory with the arguments, and buffers that the caller writes to again change no result."""

import itertools
import random
from collections.abc import Iterator
from pathlib import Path

import torch
from attacks.trial import Trial
from attacks.warm import in_warm_child
from test_all_functions import CASES, FRAMES, ONLY_TENSORS, TIMING, test_results_share_no_memory_with_arguments

import rsvib_torch as rsv

Item = tuple[str, int]  # case, and whether its arguments are arrays; or "tracker" and the number of buffers


def _tracked(buffers: int) -> list[rsv.tracking.TrackedFrame]:
    """Frames that are tracked with a number of buffers in turn; without buffers each has memory of its own."""
    tracker, memory = rsv.VibrationTracker(TIMING, window=4), torch.zeros(max(buffers, 1), *FRAMES[0].shape)
    results = []
    for index in range(24):
        frame = FRAMES[index % 4].clone()
        if buffers:
            frame = memory[index % buffers].copy_(frame)
        results.append(tracker.update(frame))
        frame.fill_(0.5) if buffers else None
    return results


def attempt(folder: Path, item: Item) -> str:
    """One case: a call, or a tracker whose frames are in buffers of the caller."""
    name, number = item
    if name != "tracker":
        try:
            test_results_share_no_memory_with_arguments(name, bool(number))
        except AssertionError as error:
            return str(error)[:300] or "memory is shared"
        return ""
    pairs = zip(_tracked(0), _tracked(number), strict=True)
    changed = [i for i, two in enumerate(pairs) if not torch.equal(two[0].restored, two[1].restored)]
    return f"frames {changed} differ" if changed else ""


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Trackers with up to four buffers, and the calls in random order."""
    calls = [(name, kind) for name, kind in itertools.product(CASES, (0, 1)) if not (kind and name in ONLY_TENSORS)]
    items = [*(("tracker", number) for number in range(1, 5)), *random.Random(seed).sample(calls, len(calls))]
    yield from in_warm_child(attempt, [(str(item), item) for item in items[:count]], folder, memory=2**31)
