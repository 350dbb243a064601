"""Files that would exhaust time or memory are refused in a moment, with one line."""

import os
import struct

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from time_limit import at_most

import rsvib_torch as rsv
from rsvib_torch.config import read_config
from rsvib_torch.core import free_memory
from rsvib_torch.io import hdf5, open_stack, read_stack, read_stack_info
from rsvib_torch.report.results import read_vibration
from rsvib_torch.stacks import read_manifest

TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=104)
COUNTS = np.random.default_rng(2).integers(0, 4096, (4, 16, 16)).astype(np.uint16)


@pytest.fixture(autouse=True)
def _in_time():
    with at_most(10):
        yield


def test_hdf5_groups_that_contain_the_root(tmp_path, monkeypatch):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for index in range(25):
            file[f"link{index}"] = file["/"]
        file.create_dataset("deep/er/and/deep/er/images", data=COUNTS)
    assert read_stack_info(tmp_path / "a.h5").shape == COUNTS.shape
    monkeypatch.setattr(hdf5, "_MAX_MEMBERS", 20)
    with pytest.raises(ValueError, match="it has more than 20 members"):
        read_stack_info(tmp_path / "a.h5")


def test_hdf5_times_of_other_files_are_not_read(tmp_path):
    with h5py.File(tmp_path / "times.h5", "w") as file:
        file["timestamps"] = [0.0, 0.1, 0.2, 0.3]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = COUNTS
        layout = h5py.VirtualLayout(shape=(4,), dtype="f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "times.h5"), "timestamps", shape=(4,))
        file.create_virtual_dataset("timestamps", layout)
    assert read_stack_info(tmp_path / "a.h5").frame_times is None


def pages(path, count):
    with tifffile.TiffWriter(path) as tif:
        for index in range(count):
            tif.write(COUNTS[index % 4], photometric="minisblack", metadata=None, contiguous=False)


def test_headers_of_equal_tiff_pages_are_interpreted_once(tmp_path, monkeypatch):
    pages(tmp_path / "a.tif", 500)
    interpreted, initialise = [], tifffile.TiffPage.__init__
    monkeypatch.setattr(
        tifffile.TiffPage, "__init__", lambda *args, **kw: interpreted.append(1) or initialise(*args, **kw)
    )
    reader = open_stack(tmp_path / "a.tif")
    assert reader.info.shape == (500, 16, 16)
    assert len(interpreted) < 10
    for index in (0, 1, 499):
        np.testing.assert_array_equal(reader.frame(index), COUNTS[index % 4])
    reader.close()


def test_tiff_pages_of_many_layouts(tmp_path):
    entries = {256: 16, 257: 16, 258: 16, 259: 1, 262: 1, 273: 8, 277: 1, 278: 16, 279: 512}
    data, offset = [b"II*\0" + struct.pack("<I", 520) + bytes(512)], 520
    for page in range(1200):  # thumbnails of different sizes
        tags = sorted((entries | {254: 1, 256: page + 1}).items())
        offset += 2 + 12 * len(tags) + 4
        table = b"".join(struct.pack("<HHII", code, 4, 1, value) for code, value in tags)
        data.append(struct.pack("<H", len(tags)) + table + struct.pack("<I", offset if page < 1199 else 0))
    (tmp_path / "a.tif").write_bytes(b"".join(data))
    with pytest.raises(ValueError, match="more than 1000 different layouts"):
        read_stack_info(tmp_path / "a.tif")


@pytest.mark.parametrize("name", ["a.tif", "a.npy", "a.png", "a.h5", "a.raw", "a.mp4", "a.jpg"])
def test_pipes_and_devices_are_not_read(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(ValueError, match="expected a regular file, this is a pipe"):
        read_stack(tmp_path / name)
    (tmp_path / f"d{name}").symlink_to("/dev/urandom")
    with pytest.raises(ValueError, match="expected a regular file, this is a device"):
        read_stack(tmp_path / f"d{name}")


@pytest.mark.parametrize(
    "read",
    [
        read_config,
        read_manifest,
        lambda path: read_vibration(path, TIMING),
        lambda path: rsv.read_motion(path, unit="px"),
    ],
)
def test_other_inputs_are_not_read_from_pipes(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="expected a regular file, this is a pipe"):
        read(tmp_path / "pipe")
    (tmp_path / "endless").symlink_to("/proc/self/mem")
    with pytest.raises((ValueError, OSError)):
        read(tmp_path / "endless")


@pytest.mark.parametrize("kind", ["pipe", "link"])
def test_zarr_chunks_are_regular_files(tmp_path, kind):
    zarr.create_array(tmp_path / "a.zarr", shape=COUNTS.shape, chunks=(1, 16, 16), dtype="u2")[:] = COUNTS
    chunk = tmp_path / "a.zarr" / "c" / "1" / "0" / "0"
    chunk.unlink()
    os.mkfifo(chunk) if kind == "pipe" else chunk.symlink_to("/dev/urandom")
    with pytest.raises(ValueError, match="it contains 0, which is not a regular file"):
        read_stack_info(tmp_path / "a.zarr")


def test_zarr_frame_of_too_many_chunks(tmp_path):
    array = zarr.create_array(tmp_path / "a.zarr", shape=(2, 300, 300), chunks=(1, 1, 1), dtype="u2")
    array[0, 0, :20] = 1
    with pytest.raises(ValueError, match="a frame is divided into 90000 chunks; expected at most 16384"):
        read_stack_info(tmp_path / "a.zarr")


DEEP = 20_000


@pytest.mark.parametrize(
    "text", ["x = " + "[" * DEEP + "]" * DEEP, "x = " + "{a=" * DEEP, "a" + ".a" * DEEP + " = 1", f"[{'a.' * DEEP}a]"]
)
def test_nested_toml(tmp_path, text):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(ValueError, match=r"^[^\n]*a.toml: not a TOML file: [^\n]*$"):
        read_config(tmp_path / "a.toml")


@pytest.mark.parametrize("text", ["[" * DEEP, '{"a":' * DEEP])
def test_nested_json(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError, match=r"^[^\n]*a.json: not a vibration.json: [^\n]*$"):
        read_vibration(tmp_path / "a.json", TIMING)


def test_large_inputs_and_long_messages(tmp_path):
    (tmp_path / "a.toml").write_text("#")
    os.truncate(tmp_path / "a.toml", 10**11)
    with pytest.raises(ValueError, match="100 GB are too large; expected at most 10 MB"):
        read_config(tmp_path / "a.toml")
    (tmp_path / "b.toml").write_text("".join(f"a{n} = 1\n" for n in range(1000)))
    with pytest.raises(ValueError, match="mistakes") as caught:
        read_config(tmp_path / "b.toml")
    assert len(str(caught.value).splitlines()) == 21
    (tmp_path / "a.csv").write_text('time,x,y\n"' + "1" * 10**5)
    with pytest.raises(ValueError, match="must be a number") as caught:
        rsv.read_motion(tmp_path / "a.csv", unit="px")
    assert len(str(caught.value)) < 300


def test_start_times_of_many_frames_are_a_valid_configuration(tmp_path):
    times = ", ".join(f"{0.01 * n:.4f}" for n in range(5000))
    camera = (
        f"[sensor] # a line with points ......\nrow_time = 1e-4\nexposure_rows = 6\nframe_rows = 90\n# {'.' * 200}\n"
    )
    (tmp_path / "a.toml").write_text(f"{camera}frame_start_times = [{times}]\n")
    assert len(read_config(tmp_path / "a.toml").timing.frame_start_times) == 5000


def test_npy_headers(tmp_path):
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1) + b"{")
    with pytest.raises(ValueError, match="its header has 4294967295 bytes"):
        read_stack_info(tmp_path / "a.npy")
    header = {"descr": "|u1", "fortran_order": False, "shape": (10**8, 1, 1)}
    with (tmp_path / "b.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
    os.truncate(tmp_path / "b.npy", 10**8 + 1000)
    with pytest.raises(ValueError, match="100000000 frames; a stack has at most 10000000"):
        read_stack_info(tmp_path / "b.npy")


@pytest.mark.parametrize("several", [False, True])
def test_stack_that_does_not_fit_is_refused_before_it_is_read(tmp_path, monkeypatch, several):
    path = tmp_path / "a.npy"
    np.save(path, COUNTS.astype(np.float32))
    paths = [path, path] if several else path
    needed = (4 if not several else 12) * COUNTS.size + 24 * COUNTS[0].size
    monkeypatch.setattr(free_memory, "free_memory", lambda: needed)
    assert len(read_stack(paths)) == 4 * (1 + several)
    monkeypatch.setattr(free_memory, "free_memory", lambda: needed - 1)
    with pytest.raises(ValueError, match=r"a.npy: 4 frames of 16 x 16 px need .* KB .*; process the stack in windows"):
        read_stack(paths)
    with pytest.raises(ValueError, match=r"need .* of memory"):
        rsv.detect_vibration(paths, TIMING)


def test_video_frames_that_do_not_fit(tmp_path, monkeypatch):
    rsv.write_stack(tmp_path / "a.mkv", np.zeros((2, 64, 64), np.float32), dtype="uint8")
    monkeypatch.setattr(free_memory, "free_memory", lambda: 10**5)
    with pytest.raises(ValueError, match=r"not a readable video stack: .* 64 x 64 px need 197 KB of memory"):
        read_stack_info(tmp_path / "a.mkv")
