"""Randomly damaged files: reading them must return frames or raise a one-line error."""

import json
import random
import signal
from contextlib import contextmanager

import h5py
import numpy as np
import tifffile
import zarr
from small_stack import TIMING, process_small

from rsvib_torch.config import read_config
from rsvib_torch.io import open_stack
from rsvib_torch.report.results import read_vibration
from rsvib_torch.stacks import read_manifest

COUNTS = np.random.default_rng(2).integers(0, 4096, (4, 96, 64)).astype(np.uint16)
CONFIG = """
[sensor]
row_time = 1e-4
exposure_rows = 6
frame_rows = 104
full_scale = 4095
frame_start_times = [0.0, 0.0104, 0.0208]

[detection]
method = "bands"
tones = 1

[restoration]
method = "banded"
half_rows = 8

[simulation]
num_frames = 3
seed = 1

[simulation.vibration]
amplitude = [3.1, 5.2]
frequency = [[50.0, 60.0], [30.0, 20.0]]

[simulation.noise]
read_noise = 0.003

[stack]
window = 4
bad_frames = "skip"
"""
_TOKENS = (
    b"-1",
    b"0",
    b"99999999999999999999",
    b"1e999",
    b"nan",
    b"null",
    b"[]",
    b"{}",
    b'""',
    b"true",
    b"\xff",
    b"[" * 60,
)


def _write_hdf5(path, **options):
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=COUNTS, **options)
        file["frames"].attrs["full_scale"] = 4095.0


def _write_raw(path):
    COUNTS.tofile(path)
    content = {"format": "rsvib raw", "version": 1, "shape": list(COUNTS.shape), "axes": "THW", "dtype": "uint16"}
    content |= {"offset": 0, "full_scale": 4095, "frame_times": [0.0, 0.1, 0.2, 0.3]}
    path.with_name(path.name + ".json").write_text(json.dumps(content))


def _write_zarr(path):
    array = zarr.create_array(path, shape=COUNTS.shape, chunks=(1, 96, 64), dtype="u2", overwrite=True)
    array.attrs["full_scale"] = 4095.0
    array[:] = COUNTS


def write_originals(folder):
    """Write undamaged files; returns for each file to damage: the stack, the reading function, whether it is text."""
    tifffile.imwrite(folder / "pages.tif", COUNTS, photometric="minisblack", metadata=None)
    tifffile.imwrite(folder / "packed.tif", COUNTS, photometric="minisblack", compression="zlib", bigtiff=True)
    _write_hdf5(folder / "plain.h5")
    _write_hdf5(folder / "packed.h5", chunks=(1, 96, 64), compression="gzip")
    _write_raw(folder / "frames.raw")
    _write_zarr(folder / "frames.zarr")
    (folder / "camera.toml").write_text(CONFIG)
    process_small(folder / "good.tif", folder / "out.npy")
    records = read_manifest(folder / "out.npy.manifest.json")
    detection = json.loads((folder / "out.npy.manifest.json").read_text())["windows"][0]["detection"]
    timing = {"row_time": 1e-4, "exposure_rows": 6.0, "frame_rows": 104.0, "scan_axis": "y"}
    timing |= {"readout_direction": "forward", "frame_start_times": None}
    vibration = {"format": "rsvib vibration", "version": 1, "timing": timing, **detection, "units": {}}
    vibration["period"] = vibration["std"]["period"]
    (folder / "vibration.json").write_text(json.dumps(vibration))
    assert records.windows
    return {
        "pages.tif": ("pages.tif", _read_stack, False),
        "packed.tif": ("packed.tif", _read_stack, False),
        "plain.h5": ("plain.h5", _read_stack, False),
        "packed.h5": ("packed.h5", _read_stack, False),
        "frames.raw.json": ("frames.raw", _read_stack, True),
        "frames.zarr/zarr.json": ("frames.zarr", _read_stack, True),
        "camera.toml": ("camera.toml", read_config, True),
        "out.npy.manifest.json": ("out.npy.manifest.json", _read_manifest, True),
        "vibration.json": ("vibration.json", lambda path: read_vibration(path, TIMING), True),
    }


def _read_manifest(path):
    read_manifest(path).detections()


def _read_stack(path):
    reader = open_stack(path)
    try:
        for index in range(min(reader.info.shape[0], 50)):
            frame = reader.frame(index)
            assert (frame.shape, frame.dtype.name) == (reader.info.shape[1:], reader.info.dtype)
    finally:
        reader.close()


def damage(data, seed, text):
    """The bytes with a few changes: some of them near the start, where headers are."""
    choice = random.Random(seed)
    data = bytearray(data)
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


@contextmanager
def at_most(seconds):
    """Raise ``TimeoutError`` in the main thread after ``seconds``."""

    def stop(*_):
        raise TimeoutError(f"took more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def try_damaged(folder, seeds, seconds=10):
    """Read damaged files; returns the numbers of files read and refused, and a list of all other outcomes."""
    originals = write_originals(folder)
    names = list(originals)
    read, refused, wrong = 0, 0, []
    for seed in seeds:
        name = names[seed % len(names)]
        target, reader, text = originals[name]
        good = (folder / name).read_bytes()
        (folder / name).write_bytes(damage(good, seed, text))
        try:
            with at_most(seconds):
                reader(folder / target)
            read += 1
        except TimeoutError as error:
            wrong.append(f"{seed} {name}: {error}")
        except (ValueError, OSError) as error:
            refused += 1
            lines = str(error).splitlines()
            # configs have one line per mistake
            if not lines or (len(lines) > 1 and not all(str(folder) in line for line in lines)):
                wrong.append(f"{seed} {name}: message {error!s}")
        except Exception as error:  # everything else would be a traceback
            wrong.append(f"{seed} {name}: {type(error).__name__} {error!s}")
        (folder / name).write_bytes(good)
    return read, refused, wrong
