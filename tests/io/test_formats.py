"""The registry of formats: round trips, files of other programs, refused files, additional formats."""

import sys

import cv2
import h5py
import numpy as np
import pytest
import tifffile
import torch
import zarr
from refusals import refuses

from rsvib_torch.io import (
    FrameError,
    StackFormat,
    StackInfo,
    open_stack,
    read_stack,
    read_stack_info,
    register_format,
    write_stack,
)

COUNTS = np.random.default_rng(8).integers(0, 4096, (3, 9, 7)).astype(np.uint16)
COUNTS.flat[0] = 4095


@pytest.mark.parametrize("ending", [".h5", ".zarr", ".raw"])
@pytest.mark.parametrize(("shape", "dtype"), [((3, 9, 7), "uint8"), ((2, 3, 9, 7), "int32"), ((1, 5, 9, 7), "float64")])
def test_stacks_are_read_as_written(tmp_path, ending, shape, dtype):
    path = tmp_path / f"frames{ending}"
    stored = np.random.default_rng(3).integers(0, 256, shape) / 255
    scale = None if "float" in dtype else 255
    for _ in range(2):  # the second call replaces the file of the first
        write_stack(path, torch.from_numpy(stored), dtype=dtype, full_scale=scale)
    assert read_stack_info(path) == StackInfo(shape, dtype, scale)
    np.testing.assert_allclose(read_stack(path).numpy(), stored, rtol=1e-6, atol=1e-7)
    assert {item.name for item in tmp_path.iterdir()} <= {path.name, "frames.raw.json"}


def test_files_can_be_read_by_other_libraries(tmp_path):
    frames = torch.from_numpy(COUNTS / 4095.0)
    for name in ("a.h5", "a.zarr", "a.raw"):
        write_stack(tmp_path / name, frames, dtype="uint16", full_scale=4095)
    with h5py.File(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(file["frames"][:], COUNTS)
        assert file["frames"].attrs["full_scale"] == 4095
    array = zarr.open_group(tmp_path / "a.zarr", mode="r", zarr_format=3)["frames"]
    np.testing.assert_array_equal(array[:], COUNTS)
    assert array.metadata.dimension_names == ("frame", "y", "x")
    np.testing.assert_array_equal(np.fromfile(tmp_path / "a.raw", "<u2").reshape(3, 9, 7), COUNTS)


@pytest.mark.parametrize(("compression", "big"), [("zlib", True), ("lzma", False), ("lzw", False), ("zstd", True)])
def test_compressed_tiff_of_other_programs_is_read(tmp_path, compression, big):
    path = tmp_path / "frames.tif"
    tifffile.imwrite(
        path, COUNTS, photometric="minisblack", compression=compression, bigtiff=big, tile=(16, 16), metadata=None
    )
    np.testing.assert_allclose(read_stack(path, full_scale=4095).numpy(), COUNTS / 4095, rtol=1e-6)


def test_frames_are_read_one_at_a_time_in_any_order(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", COUNTS, photometric="minisblack", compression="zlib")
    np.save(tmp_path / "a.npy", COUNTS)
    np.save(tmp_path / "f.npy", np.asfortranarray(COUNTS))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("scan/counts", data=COUNTS, chunks=(2, 4, 4), compression="gzip")
        file.create_dataset("temperature", data=np.zeros(3))
    group = zarr.create_group(tmp_path / "a.zarr")
    counts = group.create_array("counts", shape=COUNTS.shape, chunks=(2, 5, 5), dtype=COUNTS.dtype)
    counts[:] = COUNTS
    (tmp_path / "tiffs").mkdir()
    (tmp_path / "pngs").mkdir()
    for index, frame in enumerate(COUNTS):
        tifffile.imwrite(tmp_path / "tiffs" / f"{index}.tif", frame)
        cv2.imwrite(str(tmp_path / "pngs" / f"{index}.png"), frame)
    for name in ("a.tif", "a.npy", "f.npy", "a.h5", "a.zarr", "tiffs", "pngs"):
        reader = open_stack(tmp_path / name)
        assert (reader.info.shape, reader.info.dtype) == ((3, 9, 7), "uint16"), name
        for index in (2, 0, 1):
            np.testing.assert_array_equal(reader.frame(index), COUNTS[index])
        reader.close()


def test_npy_file_that_shrinks_while_open_is_an_error(tmp_path):
    big_endian = COUNTS.repeat(800, axis=1).astype(">u2")
    np.save(tmp_path / "a.npy", big_endian)
    reader = open_stack(tmp_path / "a.npy")
    frame = reader.frame(2)
    np.testing.assert_array_equal(frame, big_endian[2])
    assert frame.dtype.isnative
    with (tmp_path / "a.npy").open("r+b") as file:
        file.truncate(5000)
    for index in range(3):
        with pytest.raises(FrameError, match=f"frame {index} .*beyond the end of the file"):
            reader.frame(index)
    reader.close()


def test_folder_of_float_frames_contains_tiff_files(tmp_path):
    write_stack(tmp_path / "frames", torch.from_numpy(COUNTS / 4095.0))
    assert sorted(file.name for file in (tmp_path / "frames").iterdir()) == [f"frame_000{i}.tif" for i in range(3)]
    np.testing.assert_allclose(read_stack(tmp_path / "frames").numpy(), COUNTS / 4095, rtol=1e-6)
    cv2.imwrite(str(tmp_path / "frames" / "x.png"), COUNTS[0])
    refuses(lambda: read_stack(tmp_path / "frames"), "contains both PNG and TIFF files")


@pytest.mark.parametrize(("ending", "message"), [(".TOY", "endings must be like '.tif'"), (None, "has no file ending")])
def test_format_without_a_valid_ending_is_refused(ending, message):
    refuses(lambda: register_format(StackFormat("toy", () if ending is None else (ending,), object)), message)


@pytest.mark.parametrize(
    ("ending", "package", "extra"), [(".h5", "h5py", "formats"), (".zarr", "zarr", "formats"), (".mp4", "av", "video")]
)
def test_missing_package_names_the_extra(tmp_path, monkeypatch, ending, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / "a.h5").write_bytes(b"")
    (tmp_path / "a.mp4").write_bytes(b"")
    (tmp_path / "a.zarr").mkdir()
    message = rf"needs the package {package}: pip install rsvib_torch\[{extra}\]"
    refuses(lambda: read_stack(tmp_path / f"a{ending}"), message, ModuleNotFoundError)
    with pytest.raises(ModuleNotFoundError, match=message):
        write_stack(tmp_path / f"b{ending}", torch.rand(2, 4, 4), dtype="uint8")
