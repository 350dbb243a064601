"""Runs with a memory limit for every layout of a stack: the peak memory must not exceed the limit."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import h5py
import numpy as np
import tifffile
import zarr
from attacks.trial import Trial, outcome_of_command, rsvib, run_watched
from numpy.typing import NDArray

import rsvib_torch as rsv
from rsvib_torch.stacks.memory import memory_needed

__all__ = ["LAYOUTS", "trials"]

Stack = NDArray[np.uint16]
_SIZE, _FRAMES, _WINDOW = 512, 64, 4  # px; 34 MB of 16 bits
_TIMING = rsv.SensorTiming(row_time=4e-5, exposure_rows=20, frame_rows=560)
_CAMERA = """
[sensor]
row_time = 4e-5
exposure_rows = 20
frame_rows = 560
full_scale = 4095

[detection]
method = "bands"
tones = 1

[restoration]
method = "dewarp"
"""


def _hdf5(path: Path, counts: Stack, **options: object) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=counts, **options)


def _zarr(path: Path, counts: Stack, **options: object) -> None:
    zarr.create_array(path, shape=counts.shape, dtype=counts.dtype, **options)[:] = counts


def _raw(path: Path, counts: Stack) -> None:
    counts.tofile(path)
    sidecar = {"format": "rsvib raw", "version": 1, "shape": counts.shape, "axes": "THW", "dtype": "uint16"}
    path.with_name(path.name + ".json").write_text(json.dumps(sidecar), encoding="utf-8")


def _folder(path: Path, counts: Stack) -> None:
    path.mkdir()
    for index, frame in enumerate(counts):
        cv2.imwrite(str(path / f"frame{index}.png"), frame)


def _tiff(path: Path, counts: Stack, **options: object) -> None:
    tifffile.imwrite(path, counts, photometric="minisblack", maxworkers=1, **options)


def _video(path: Path, counts: Stack) -> None:
    rsv.write_stack(path, counts / np.float32(4095), dtype="uint16", full_scale=4095)


# Layout, name of the file, and function that writes it.
LAYOUTS: dict[str, tuple[str, Callable[[Path, Stack], None]]] = {
    "TIFF, contiguous": ("a.tif", lambda path, counts: _tiff(path, counts, metadata=None, contiguous=True)),
    "TIFF, pages, zlib": ("b.tif", lambda path, counts: _tiff(path, counts, compression="zlib")),
    "TIFF, tiled, zlib": ("c.tif", lambda path, counts: _tiff(path, counts, compression="zlib", tile=(64, 64))),
    "TIFF, axes YXT": (
        "d.tif",
        lambda path, counts: _tiff(path, np.ascontiguousarray(np.moveaxis(counts, 0, -1)), metadata={"axes": "YXT"}),
    ),
    "TIFF, axes YXT, zlib": (
        "e.tif",
        lambda path, counts: _tiff(
            path, np.ascontiguousarray(np.moveaxis(counts, 0, -1)), metadata={"axes": "YXT"}, compression="zlib"
        ),
    ),
    "npy, C order": ("f.npy", np.save),
    "npy, Fortran order": ("g.npy", lambda path, counts: np.save(path, np.asfortranarray(counts))),
    "HDF5, contiguous": ("h.h5", _hdf5),
    "HDF5, chunk per frame": (
        "i.h5",
        lambda path, counts: _hdf5(path, counts, chunks=(1, *counts.shape[1:]), compression="gzip"),
    ),
    "HDF5, one chunk": (
        "j.h5",
        lambda path, counts: _hdf5(path, counts, chunks=counts.shape, compression="gzip", compression_opts=1),
    ),
    "HDF5, automatic chunks": ("k.h5", lambda path, counts: _hdf5(path, counts, chunks=True, compression="lzf")),
    "Zarr, chunk per frame": ("l.zarr", lambda path, counts: _zarr(path, counts, chunks=(1, *counts.shape[1:]))),
    "Zarr, one chunk": ("m.zarr", lambda path, counts: _zarr(path, counts, chunks=counts.shape)),
    "Zarr, sharded": (
        "n.zarr",
        lambda path, counts: _zarr(path, counts, chunks=(1, *counts.shape[1:]), shards=counts.shape),
    ),
    "raw": ("o.raw", _raw),
    "PNG folder": ("p", _folder),
    "video": ("q.mkv", _video),
}


def _draw(seed: int) -> Stack:
    """Frames of a vibrating camera, 12 bits."""
    generator = np.random.default_rng(seed)
    margin = 24
    side = _SIZE + 2 * margin
    scene = cv2.GaussianBlur(generator.random((side, side)).astype(np.float32), (0, 0), 1.2)
    scene = 0.5 + 0.15 * (scene - scene.mean()) / scene.std()
    vibration = rsv.Vibration([2.0, 1.5], [130.0, 170.0], [0.3, 0.9])
    starts = [index * _TIMING.frame_period for index in range(_FRAMES)]
    counts = np.empty((_FRAMES, _SIZE, _SIZE), np.uint16)
    for first in range(0, _FRAMES, 8):  # of all frames the spectra need 1 GB
        timing = rsv.SensorTiming(
            _TIMING.row_time, _TIMING.exposure_rows, _TIMING.frame_rows, frame_start_times=starts[first : first + 8]
        )
        frames = rsv.simulate_frames(scene, timing, vibration, 8, frame_size=(_SIZE, _SIZE)).numpy()
        frames += 0.002 * generator.standard_normal(frames.shape, np.float32)
        counts[first : first + 8] = np.clip(np.rint(frames * 4095), 0, 4095)
    return counts


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Run ``rsvib run --memory`` on stacks in different layouts, with the smallest limit that it accepts.

    A run that needs more than its limit has the outcome ``memory``; if its output differs from that of the first
    layout, ``wrong``. The last trial restores a quarter of the frames with ``scale=2``.
    """
    counts = _draw(seed)
    (folder / "camera.toml").write_text(_CAMERA, encoding="utf-8")
    reference: NDArray[np.uint16] | None = None
    for name in list(LAYOUTS)[:count]:
        file, write = LAYOUTS[name]
        write(folder / file, counts)
        limit = memory_needed(rsv.read_stack_info(folder / file), _WINDOW, {"method": "dewarp"})
        command = rsvib("run", file, "out", "--config", "camera.toml", "--window", str(_WINDOW), "--quiet")
        run = run_watched([*command, "--memory", str(limit), "--overwrite"], limit=300.0, folder=folder)
        outcome, detail = outcome_of_command(run), f"{100 * run.peak_memory / limit:.0f} % of {limit / 1e6:.0f} MB"
        if outcome != "completed":
            outcome, detail = "wrong" if outcome == "refused" else outcome, f"{run.output.strip()[-200:]}, {detail}"
        elif run.peak_memory > limit:
            outcome = "memory"
        else:
            restored = tifffile.imread(folder / "out" / "restored.tif")
            reference = restored if reference is None else reference
            outcome = "completed" if np.array_equal(restored, reference) else "wrong"
        yield Trial(name, outcome, f"{detail}, {run.seconds:.0f} s")
    yield _finer_grid(folder, counts[: _FRAMES // 4])


def _finer_grid(folder: Path, counts: Stack) -> Trial:
    """Windows with ``scale=2``, each restored to one image."""
    np.save(folder / "finer.npy", counts)
    options = "scale = 2\njoint = true\n"
    (folder / "finer.toml").write_text(_CAMERA.replace('method = "dewarp"\n', options), encoding="utf-8")
    limit = memory_needed(rsv.read_stack_info(folder / "finer.npy"), _WINDOW, {"scale": 2})
    command = rsvib("run", "finer.npy", "finer", "--config", "finer.toml", "--window", str(_WINDOW), "--quiet")
    run = run_watched([*command, "--memory", str(limit), "--overwrite"], limit=300.0, folder=folder)
    outcome, detail = outcome_of_command(run), f"{100 * run.peak_memory / limit:.0f} % of {limit / 1e6:.0f} MB"
    if outcome == "completed":
        shape = tifffile.imread(folder / "finer" / "restored.tif").shape
        outcome = (
            "memory" if run.peak_memory > limit else "completed" if shape[1:] == (2 * _SIZE, 2 * _SIZE) else "wrong"
        )
        detail += f", {shape}"
    return Trial("scale 2", outcome, f"{detail}, {run.seconds:.0f} s")
