"""Frames that are stored together are decoded once; the memory that this needs is stated before."""

import h5py
import numpy as np
import pytest
import tifffile
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


def write_tiff(path, axes, counts=COUNTS, names="TYX", **options):
    stored = np.ascontiguousarray(counts.transpose([names.index(axis) for axis in axes]))
    tifffile.imwrite(path, stored, metadata={"axes": axes}, photometric="minisblack", **options)


@pytest.mark.parametrize(
    ("options", "together"),
    [({"chunks": (T, H, W), "compression": "gzip"}, T), ({"chunks": (7, 8, 16), "compression": "lzf"}, 7)],
)
def test_frames_that_are_stored_together_are_decoded_once(tmp_path, options, together):
    write_hdf5(tmp_path / "a.h5", **options)
    with h5py.File(tmp_path / "a.h5") as file:
        places = [file["frames"].id.get_chunk_info(n) for n in range(file["frames"].id.get_num_chunks())]
    reader = open_stack(tmp_path / "a.h5")
    assert together * COUNTS[0].nbytes < reader.info.decoding_bytes < 5 * COUNTS.nbytes
    np.testing.assert_array_equal(reader.frame(0), COUNTS[0])
    with (tmp_path / "a.h5").open("r+b") as file:  # the decoded frames are kept
        for place in places:
            file.seek(place.byte_offset)
            file.write(bytes(place.size))
    for index in range(1, together):
        np.testing.assert_array_equal(reader.frame(index), COUNTS[index])
    reader.close()


@pytest.mark.parametrize("chunks", [(1, H, W), None])
def test_frames_that_are_stored_alone_need_no_block(tmp_path, chunks):
    write_hdf5(tmp_path / "a.h5", chunks=chunks)
    assert check_frames(tmp_path / "a.h5", COUNTS).decoding_bytes <= COUNTS[0].nbytes


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
