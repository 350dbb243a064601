"""Randomly damaged files of all formats: frames are read, or a one-line error is raised."""

import contextlib
import io
import random
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from attacks.files import (
    BANDS,
    DETECTION,
    FULL_SCALE,
    vibrating_counts,
    write_hdf5,
    write_stack,
    write_tiff,
)
from attacks.trial import Trial
from attacks.warm import in_warm_child
from gpmf_file import mp4, packets_of
from small_stack import CAMERA, TIMING

import rsvib_torch as rsv
from rsvib_torch.commands.main import run_command
from rsvib_torch.config import read_config
from rsvib_torch.io import open_stack
from rsvib_torch.report.results import read_vibration

SECONDS, MEMORY = 10.0, 1 << 30  # limits of one trial
_RUN_EVERY = 12  # the program is run in one of so many trials, on a stack
_TIMES = "frame_start_times = [0.0, 0.0104, 0.0208]\n"
CONFIG = (
    CAMERA.replace("[detection]", _TIMES + "[detection]")
    + """
[stack]
window = 4
"""
)
_TOKENS = (*b'-1 0 99999999999999999999 1e999 nan null [] {} "" true \xff'.split(), b"[" * 60)


def _read_stack(path: Path, most: int = 50) -> None:
    reader = open_stack(path)
    try:
        for index in range(min(reader.info.shape[0], most)):
            frame = reader.frame(index)
            if (frame.shape, frame.dtype.name) != (reader.info.shape[1:], reader.info.dtype):
                raise AssertionError(f"frame {index} is {frame.shape} {frame.dtype}, expected {reader.info}")
    finally:
        reader.close()


def _read_manifest(path: Path) -> None:
    manifest = rsv.read_manifest(path)
    manifest.detections()
    str(manifest)


_STACKS = ("pages.tif", "packed.tif", "tiles.tif", "own.tif", "frames.npy", "frames.png", "colour.png", "frames.jpg")
_STACKS += ("plain.h5", "packed.h5", "frames.mkv", "frames.mp4")
_TEXTS = (".json", ".toml", ".csv", ".gcsv")  # endings of files of text
# Files to damage, or members of what is read, and how it is read.
ORIGINALS: dict[str, Callable[[Path], Any]] = {
    **dict.fromkeys(_STACKS, _read_stack),
    "pngs/frame_0001.png": _read_stack,
    "camera.toml": read_config,
    "motion.csv": lambda path: str(rsv.read_motion(path, unit="px")),
    "clip.gcsv": lambda path: str(rsv.read_gyroscope(path)),
    "rates.csv": lambda path: str(rsv.read_gyroscope(path)),
    "clip.mp4": lambda path: str(rsv.read_gyroscope(path)),
    "out.npy.manifest.json": _read_manifest,
    "vibration.json": lambda path: str(read_vibration(path, TIMING)),
    "detection.json": lambda path: str(rsv.DetectionResult.load(path)),
    "free.json": lambda path: str(rsv.FreeMotion.load(path)),
}


@cache
def write_originals(folder: Path) -> dict[str, bytes]:
    """Write the undamaged files, and return their content."""
    shutil.rmtree(folder, ignore_errors=True)  # of a child process that ended
    folder.mkdir(parents=True)
    counts = vibrating_counts(TIMING, 4, (96, 64))
    frames = torch.from_numpy(counts / np.float32(FULL_SCALE))
    write_tiff(folder / "pages.tif", counts)
    write_tiff(folder / "packed.tif", counts, metadata={}, compression="zlib", bigtiff=True)
    write_tiff(folder / "tiles.tif", counts, metadata={}, tile=(32, 32), compression="lzw")
    for name in ("own.tif", "frames.npy", "pngs"):
        write_stack(folder / name, counts)
    for name in ("frames.mkv", "frames.mp4"):
        info = rsv.StackInfo(counts.shape, "uint8", 255.0, frame_rate=96.0)
        rsv.write_stack(folder / name, frames, dtype="uint8", like=info)
    write_stack(folder / "frames.png", counts[:1])
    colour = np.repeat((counts[0] >> 4).astype(np.uint8)[..., None], 3, axis=-1)
    cv2.imwrite(str(folder / "colour.png"), colour)
    cv2.imwrite(str(folder / "frames.jpg"), colour)
    write_hdf5(folder / "plain.h5", counts)
    write_hdf5(folder / "packed.h5", counts, chunks=(1, 96, 64), compression="gzip")
    (folder / "camera.toml").write_text(CONFIG)
    options: dict[str, Any] = {"window": 3, "detection": DETECTION, "restoration": {"method": "dewarp"}, "workers": 1}
    rsv.process_stack(folder / "own.tif", folder / "out.npy", TIMING, **options)
    detected = rsv.detect_vibration(frames, TIMING, **DETECTION)
    detected.save(folder / "vibration.json")
    detected.save(folder / "detection.json")
    rsv.detect_motion(frames, TIMING, **BANDS).motion.save(folder / "free.json")
    lines = [f"{0.001 * i:.3f},{0.1 * i:.2f},{-0.1 * i:.2f}" for i in range(40)]
    (folder / "motion.csv").write_text("\n".join(["time,x,y", *lines]))
    head = ["GYROFLOW IMU LOG", "version,1.3", "orientation,YxZ", "tscale,1", "gscale,1", "t,gx,gy,gz"]
    (folder / "clip.gcsv").write_text("\n".join([*head, *(f"{line},0" for line in lines)]))
    (folder / "rates.csv").write_text("\n".join(["time,gx_rad_s,gy_rad_s,gz_rad_s", *(f"{line},0" for line in lines)]))
    mp4(folder / "clip.mp4", packets_of())
    return {name: (folder / name).read_bytes() for name in ORIGINALS}


def damage(content: bytes, seed: int, text: bool) -> bytes:
    """The bytes with a few changes: some of them near the start, where headers are."""
    choice = random.Random(seed)
    data = bytearray(content)
    for _ in range(choice.choice((1, 1, 2, 5))):
        end = len(data) if choice.random() < 0.4 else min(len(data), 2000)
        place = choice.randrange(max(1, end))
        kind = choice.choice(("flip", "byte", "cut", "insert", "copy", "number", *("number",) * (9 if text else 1)))
        if kind == "flip":
            data[place : place + 1] = bytes([data[place] ^ (1 << choice.randrange(8))])
        elif kind == "byte":
            data[place : place + 1] = bytes([choice.choice((0, 1, 127, 128, 255))])
        elif kind == "cut":
            del data[place : place + choice.choice((1, 4, 200, len(data)))]
        elif kind == "insert":
            data[place:place] = choice.choice(_TOKENS) if text else choice.randbytes(choice.choice((1, 4, 30)))
        elif kind == "copy":
            other = choice.randrange(len(data))
            data[place : place + 8] = data[other : other + 8]
        elif text:  # replace a number
            digits = [i for i, byte in enumerate(data) if chr(byte).isdigit()] or [0]
            start = choice.choice(digits)
            data[start : start + 1] = choice.choice(_TOKENS)
        else:
            size = choice.choice((2, 4, 8))
            value = choice.choice((0, 1, 2**15, 2**31 - 1, 2**32 - 1, 2**63 - 1))
            data[place : place + size] = (value % 2 ** (8 * size)).to_bytes(size, "little")
        if not data:
            break
    return bytes(data)


def _run(folder: Path, target: Path) -> str:
    """Run the program on a damaged stack; returns why that is a failure, an empty text if it is not."""
    (folder / "good.toml").write_text(CONFIG.replace(_TIMES, ""))
    out = folder / "results"
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        code = run_command(["run", str(target), str(out), "--config", str(folder / "good.toml"), "--workers", "1"])
    shown = errors.getvalue()
    lines = [line for line in shown.splitlines() if not line.startswith("rsvib: warning: ")]
    if code not in (0, 2) or "error: unexpected " in shown or "Traceback" in shown:
        return f"exit code {code}: {shown[-300:]}"
    if code == 2 and (len(lines) != 1 or out.exists()):
        return f"{len(lines)} lines of errors, results {'exist' if out.exists() else 'do not exist'}: {shown[:300]}"
    if code == 0 and not all((out / name).is_file() for name in ("restored.tif", "manifest.json")):
        return "exit code 0 without results"
    return ""


Item = tuple[int, str, bool]  # seed, name of the file, whether the program is run on it


def attempt(folder: Path, item: Item) -> str:
    """Read one damaged file, or run the program on it."""
    contents = write_originals(folder)
    seed, name, runs = item
    path, target = folder / name, folder / name.partition("/")[0]
    path.write_bytes(damage(contents[name], seed, path.suffix in _TEXTS))
    try:
        if runs:
            return _run(folder, target)
        ORIGINALS[name](target)
        return ""
    except (ValueError, TypeError, OSError) as error:
        lines = str(error).splitlines()  # a configuration has one line per mistake
        if len(lines) > 1 and not all(str(folder) in line for line in lines):
            return f"message {error}"
        raise
    finally:
        shutil.rmtree(folder / "results", ignore_errors=True)
        path.write_bytes(contents[name])


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Damaged files in turn; the program is run on every twelfth stack, the other files are read."""
    stacks = [name for name, read in ORIGINALS.items() if read is _read_stack]
    items: list[tuple[str, Item]] = []
    names = list(ORIGINALS)
    for index in range(count):
        runs = index % _RUN_EVERY == 0
        chosen = stacks[index // _RUN_EVERY % len(stacks)] if runs else names[index % len(names)]
        number = 1_000_003 * seed + index
        items.append((f"{chosen}, seed {number}{', rsvib run' * runs}", (number, chosen, runs)))
    place = folder / "files"
    yield from in_warm_child(attempt, items, place, limit=SECONDS, memory=MEMORY, prepare=write_originals)
