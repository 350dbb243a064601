"""Frames that are stored together are decoded once; the memory that this needs is stated before."""

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from refusals import refuses
from test_tiff_pages import check_frames

from rsvib_torch.io import open_stack
from rsvib_torch.io.frame_reader import FrameError

T, H, W = 20, 24, 40
COUNTS = np.random.default_rng(7).integers(0, 4096, (T, H, W)).astype(np.uint16)
COLOUR = np.random.default_rng(8).integers(0, 4096, (T, 3, H, W)).astype(np.uint16)


def write_hdf5(path, counts=COUNTS, **options):
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=counts, **options)


def write_zarr(path, **options):
    zarr.create_array(path, shape=COUNTS.shape, dtype="u2", **options)[:] = COUNTS


def write_tiff(path, axes, counts=COUNTS, names="TYX", **options):
    stored = np.ascontiguousarray(counts.transpose([names.index(axis) for axis in axes]))
    tifffile.imwrite(path, stored, metadata={"axes": axes}, photometric="minisblack", **options)


WRITERS = {
    "one.h5": lambda path: write_hdf5(path, chunks=(T, H, W), compression="gzip"),
    "parts.h5": lambda path: write_hdf5(path, chunks=(7, 8, 16), compression="lzf"),
    "one.zarr": lambda path: write_zarr(path, chunks=(T, H, W)),
    "parts.zarr": lambda path: write_zarr(path, chunks=(7, 8, 16)),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_block_is_read_once(tmp_path, name, monkeypatch):
    WRITERS[name](tmp_path / name)
    reader = open_stack(tmp_path / name)
    together = 7 if "parts" in name else T
    reads, read = [], reader._read
    monkeypatch.setattr(reader, "_read", lambda *args: reads.append(args) or read(*args))
    frames = [reader.frame(index) for index in range(T)]
    reader.close()
    np.testing.assert_array_equal(frames, COUNTS)
    assert reads == [(first, min(first + together, T)) for first in range(0, T, together)]
    assert all(frame.base is None for frame in frames)  # a view would keep its block in memory
    block = together * COUNTS[0].nbytes
    assert block < reader.info.decoding_bytes < 5 * COUNTS.nbytes


@pytest.mark.parametrize("chunks", [(1, H, W), None])
def test_frames_that_are_stored_alone_need_no_block(tmp_path, chunks):
    write_hdf5(tmp_path / "a.h5", chunks=chunks)
    assert check_frames(tmp_path / "a.h5", COUNTS).decoding_bytes <= COUNTS[0].nbytes


def test_sharded_zarr_is_decoded_frame_by_frame(tmp_path):
    write_zarr(tmp_path / "a.zarr", chunks=(1, H, W), shards=(T, H, W))
    assert check_frames(tmp_path / "a.zarr", COUNTS).decoding_bytes < 4 * COUNTS[0].nbytes


@pytest.mark.parametrize(("axes", "compression"), [("TCYX", None), ("TCYX", "zlib"), ("TYX", "zlib")])
def test_pages_of_frames_and_channels(tmp_path, axes, compression):
    counts = COLOUR if "C" in axes else COUNTS
    write_tiff(tmp_path / "a.tif", axes, counts, axes, bigtiff=True, byteorder=">", compression=compression)
    assert check_frames(tmp_path / "a.tif", counts).decoding_bytes == 0


@pytest.mark.parametrize("axes", ["YXT", "YTX", "TXY", "CTYX"])
def test_axes_in_another_order_are_refused(tmp_path, axes):
    write_tiff(tmp_path / "a.tif", axes, *((COLOUR, "TCYX") if "C" in axes else ()))
    refuses(lambda: open_stack(tmp_path / "a.tif"), f"axes {axes} .*expected an axis of frames")


def test_damaged_block_is_an_error_of_its_frames(tmp_path):
    write_hdf5(tmp_path / "a.h5", chunks=(10, H, W), compression="gzip")
    with h5py.File(tmp_path / "a.h5", "r") as file:
        place = file["frames"].id.get_chunk_info(1)
    data = bytearray((tmp_path / "a.h5").read_bytes())
    data[place.byte_offset + 20 : place.byte_offset + 400] = bytes(380)
    (tmp_path / "a.h5").write_bytes(data)
    reader = open_stack(tmp_path / "a.h5")
    np.testing.assert_array_equal(reader.frame(9), COUNTS[9])
    refuses(lambda: reader.frame(12), "frame 12 cannot be read", FrameError)
    reader.close()
