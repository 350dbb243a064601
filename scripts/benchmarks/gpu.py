"""Speed of batches on a GPU: frames per second, tensor operations, transfers, and share of the memory bandwidth.

Pairs of frames in batches of 1, 8 and 64 stacks are detected, restored exactly and unwarped; the tracker follows one
stack. Restoration has the true vibration. Operations are those that reach the dispatcher of PyTorch, views included. A
transfer is an operation after which the processor waits for the device: a value or a number of elements that is read,
or a copy between devices. Bytes are those of the inputs and outputs of all operations that are not views, without
regard to caches; over the rate of copying, measured in the same run, they give the least time without fused operations.
Its ratio to the measured time is the share of the bandwidth. On a CPU, copies between devices do not exist and are not
counted.
"""

import argparse
import itertools
import statistics
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from harness import Rows, devices, finish, in_turns, seconds_of, table
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

_CUDA = "cuda" in devices()
OPTIONS = {
    "gpu_sizes": ((512, 2048) if _CUDA else (264,), "gpu: rows and columns of the frames"),
    "gpu_stacks": ((1, 8, 64) if _CUDA else (1, 8), "gpu: stacks of a batch"),
    "gpu_seconds": (240.0, "gpu: seconds within which a case must end to be measured"),
}
QUICK = {"gpu_sizes": (128,), "gpu_stacks": (1, 2)}
PERIOD, EXPOSURE_ROWS, NOISE, MARGIN, SEED = 42e-3, 20, 0.005, 32, 7
TONES = (2.0, 1.5), (50.0, 30.0), (0.4, 1.3)  # px, Hz, rad, along x and y
VARIANTS = 4  # vibrations with different phases, in turn for the stacks of a batch
FOLLOWED, WINDOW = 12, 4  # frames of the tracker, and of them for its first detection
COPIED = 1 << 28  # bytes copied to measure the bandwidth
WAITS = {"item", "is_nonzero", "_local_scalar_dense", "nonzero", "masked_select", "equal", "unique_dim", "_unique2"}
COPIES = {"_to_copy", "copy_", "to", "cpu", "cuda", "_copy_from"}


class Count(TorchDispatchMode):
    """Counts operations, transfers (operations that the processor waits for) and bytes ``moved`` by operations."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self.device, self.operations, self.transfers, self.moved = device, 0, 0, 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation and count it."""
        result = function(*args, **(kwargs or {}))
        given, made = _tensors((args, kwargs)), _tensors(result)
        name = function.overloadpacket.__name__
        self.operations += 1
        if name in WAITS:
            self.transfers += any(value.device.type == self.device for value in given)
        elif name in COPIES:
            self.transfers += len({value.device.type for value in (*given, *made)}) > 1
        changed = any(alias.alias_info is not None and alias.alias_info.is_write for alias in function._schema.returns)
        if changed or not made or _place(made[0]) not in {_place(value) for value in given}:
            self.moved += sum(map(_bytes, given)) + sum(map(_bytes, made))  # otherwise a view
        return result


def _tensors(values: Any) -> list[Tensor]:
    """Tensors in nested sequences and dictionaries."""
    return [value for value in pytree.tree_leaves(values) if isinstance(value, Tensor)]


def _place(value: Tensor) -> int:
    return value.untyped_storage().data_ptr()


def _bytes(value: Tensor) -> int:
    """Bytes that are read or written; an expanded tensor has fewer than its elements."""
    return min(value.numel() * value.element_size(), value.untyped_storage().nbytes())


def camera(size: int) -> rsv.SensorTiming:
    """A camera with the same frame period for all sizes."""
    return rsv.SensorTiming(PERIOD / size, EXPOSURE_ROWS, size)


def vibration_of(count: int) -> rsv.Vibration:
    """The vibrations of a number of stacks; all are detected reliably in frames of 264 px and more."""
    turn = 0.5 * (torch.arange(count, dtype=torch.float64) % VARIANTS)[:, None, None]
    amplitude, frequency, phase = (torch.tensor(v)[:, None].expand(count, 2, 1).double() for v in TONES)
    return rsv.Vibration(amplitude, frequency, phase + turn)


@cache
def drawn(size: int, variant: int, num_frames: int) -> Tensor:
    """Frames (T, H, W) of one of the vibrations, without noise."""
    scene = city_and_fields(size + 2 * MARGIN, size + 2 * MARGIN, SEED)
    vibration = vibration_of(VARIANTS)[variant]
    return rsv.simulate_frames(scene, camera(size), vibration, num_frames, frame_size=(size, size))


def recordings(size: int, count: int, num_frames: int, device: str) -> Tensor:
    """Frames (B, T, 1, H, W) of B stacks on a device: vibrations of different phases, noise of each stack."""
    variants = min(count, VARIANTS)
    clean = torch.stack([drawn(size, variant, num_frames) for variant in range(variants)]).to(device)
    frames = clean[torch.arange(count) % variants][:, :, None]
    noise = torch.Generator(device).manual_seed(SEED)
    return frames.add_(NOISE * torch.randn(frames.shape, generator=noise, device=device))


def measured(work: Callable[[], Any], device: str, runs: int) -> dict[str, Any]:
    """Counts of a first run, and the median time of others, as many as take less than about ten seconds."""
    with Count(device) as count:
        begin = time.perf_counter()
        work()
        finish()
    runs = max(1, min(runs, int(10 / (time.perf_counter() - begin))))
    seconds = statistics.median(seconds_of(work) for _ in range(runs))
    figures = {"operations": count.operations, "transfers": count.transfers, "bytes": count.moved}
    return {"seconds": seconds, **figures}


def works_of(frames: Tensor, timing: rsv.SensorTiming) -> dict[str, Callable[[], Any]]:
    """What is done with the stacks of a batch."""
    batch = vibration_of(len(frames))
    truth = batch if frames.ndim == 5 else batch[0]
    return {
        "detection": lambda: rsv.detect_vibration(frames, timing),
        "restoration, exact": lambda: rsv.restore(frames, timing, truth),
        "restoration, dewarp": lambda: rsv.restore(frames, timing, truth, method="dewarp"),
    }


def tracked(size: int, device: str) -> Callable[[], Any]:
    """Function that processes the next frame; the first detection is done."""
    frames, tracker = recordings(size, 1, FOLLOWED, device)[0], rsv.VibrationTracker(camera(size), window=WINDOW)
    for frame in frames[:WINDOW]:
        tracker.update(frame)
    following = itertools.cycle(frames[WINDOW:])  # one round: a counted run and the timed ones
    return lambda: tracker.update(next(following))


def bandwidth(device: str) -> float:
    """Bytes read and written per second when a device copies memory."""
    source = torch.ones(COPIED // 4, device=device)
    target = torch.empty_like(source)
    return 2 * COPIED / float(np.median(in_turns({"copy": lambda: target.copy_(source)}, 5)["copy"]))


def rows(options: argparse.Namespace) -> Rows:
    """All cases, on a GPU if there is one; batches of more stacks last, and not if there is no time left for them."""
    begin, device = time.perf_counter(), "cuda" if "cuda" in options.device else "cpu"
    results: Rows = [{"part": "device", "device": device, "bytes_a_second": bandwidth(device)}]
    stack_seconds: dict[tuple[int, str], float] = {}  # of one stack in the batch before, by size and work

    def add(size: int, count: int, name: str, work: Callable[[], Any], frames: int) -> None:
        case = {"part": "case", "device": device, "size": size, "stacks": count, "work": name}
        expected = 3 * count * stack_seconds.get((size, name), 0.0)  # counted run, which is slower, and timed run
        if time.perf_counter() - begin + expected > options.gpu_seconds:
            results.append({**case, "left_out": "no time left"})
            return
        try:
            figures = measured(work, device, options.runs)
            stack_seconds[size, name] = figures["seconds"] / count
            results.append({**case, "frames": frames, **figures})
        except torch.cuda.OutOfMemoryError:
            results.append({**case, "left_out": "not enough memory"})
            torch.cuda.empty_cache()

    for size in options.gpu_sizes:
        add(size, 1, "tracker, dewarp", tracked(size, device), 1)
    for count, size in itertools.product(options.gpu_stacks, options.gpu_sizes):
        frames = recordings(size, count, 2, device)
        for name, work in works_of(frames[0, :, 0] if count == 1 else frames, camera(size)).items():
            add(size, count, name, work, 2 * count)
    return results


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    rates = {row["device"]: row["bytes_a_second"] for row in results if row["part"] == "device"}
    text = [
        f"Pairs of frames in batches of stacks, exposure of {EXPOSURE_ROWS} rows; the tracker takes one frame. "
        "Operations and transfers are those of the whole batch. Share of the bandwidth: bytes of all operations at the "
        "rate of copying, over the measured time. Rate of copying: "
        + ", ".join(f"{rate / 1e9:.0f} GB/s ({device})" for device, rate in rates.items())
        + ".",
        "",
    ]
    cells = []
    for row in (row for row in results if row["part"] == "case"):
        case = (row["device"], f"{row['size']}²", row["stacks"], row["work"])
        if "left_out" in row:
            cells.append((*case, row["left_out"], "", "", "", ""))
            continue
        share = row["bytes"] / rates[row["device"]] / row["seconds"]
        figures = (f"{row['frames'] / row['seconds']:.1f}", f"{row['seconds']:.4f}", row["operations"])
        cells.append((*case, *figures, row["transfers"], f"{share:.0%}"))
    heads = ("device", "frames", "stacks", "work", "frames/s", "seconds", "operations", "transfers", "of the bandwidth")
    return text + table(heads, cells)[:-1]
