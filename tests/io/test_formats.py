"""Stacks in files of all formats: round trips, files of other programs as they are meant, additional formats."""

import sys

import cv2
import h5py
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from refusals import refuses
from test_tiff_pages import check_frames

import rsvib_torch as rsv
from rsvib_torch.io import (
    FrameError,
    StackInfo,
    open_stack,
    read_stack,
    read_stack_info,
    write_stack,
)

COUNTS = np.random.default_rng(8).integers(0, 4096, (3, 9, 7)).astype(np.uint16)
COUNTS.flat[0] = 4095


STACKS = [
    ((1, 9, 7), "uint8", 255),
    ((3, 9, 7), "uint16", 4095),
    ((2, 3, 9, 7), "uint8", 63),
    ((2, 4, 9, 7), "uint16", 65535),
    ((1, 3, 9, 7), "uint16", 1000),
]
OTHERS = [((2, 2, 9, 7), "int16", 4095), ((2, 5, 9, 7), "uint32", 100000)]  # which PNG files do not hold


def pixels_of_images(folder):
    pixels = np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted(folder.iterdir())])
    return pixels if pixels.ndim == 3 else pixels[..., [2, 1, 0, 3][: pixels.shape[-1]]]


def values_in_hdf5(path):
    with h5py.File(path) as file:
        assert "full_scale" in file["frames"].attrs
        return file["frames"][:]


# pixels by other libraries
READERS = {
    "frames": pixels_of_images,
    "a.tif": tifffile.imread,
    "a.h5": values_in_hdf5,
}


@pytest.mark.parametrize(
    ("name", "shape", "dtype", "largest"),
    [(name, *stack) for name in READERS for stack in STACKS + OTHERS * (name != "frames")],
)
def test_stacks_are_read_as_written_also_by_other_libraries(tmp_path, name, shape, dtype, largest):
    stored = np.random.default_rng(3).integers(0, largest + 1, shape).astype(dtype)
    stored.flat[:2] = 0, largest
    path = tmp_path / name
    for _ in range(2):  # the second call replaces the file of the first
        write_stack(path, torch.from_numpy(stored / largest), dtype=dtype, full_scale=largest)
    assert read_stack_info(path) == StackInfo(shape, dtype, float(largest))
    frames = read_stack(path)
    assert (frames.dtype, frames.shape) == (torch.float32, shape)
    np.testing.assert_allclose(frames.numpy(), stored / largest, rtol=1e-7)
    found = READERS[name](path)
    assert found.dtype == dtype
    last = len(shape) == 4 and shape[1] in (3, 4) and name in ("frames", "a.tif")
    np.testing.assert_array_equal((np.moveaxis(found, -1, -3) if last else found).reshape(shape), stored)
    assert {item.name for item in tmp_path.iterdir()} <= {name}
    if name == "frames":
        assert sorted(item.name for item in path.iterdir()) == [f"frame_{i:04d}.png" for i in range(shape[0])]
    write_stack(path, frames, dtype=dtype, full_scale=largest)  # the same counts again
    np.testing.assert_array_equal(READERS[name](path), found)


def test_npy_and_single_png(tmp_path):
    stored, frames = COUNTS[:2], torch.from_numpy(COUNTS[:2] / 4095)
    write_stack(tmp_path / "frames.npy", frames, dtype="uint16", full_scale=4095)
    np.testing.assert_array_equal(np.load(tmp_path / "frames.npy"), stored)
    assert read_stack_info(tmp_path / "frames.npy") == StackInfo((2, 9, 7), "uint16", None)
    torch.testing.assert_close(read_stack(tmp_path / "frames.npy", full_scale=4095), frames.float())
    np.save(tmp_path / "image.npy", stored[0])
    assert read_stack(tmp_path / "image.npy", full_scale=4095).shape == (1, 9, 7)
    write_stack(tmp_path / "one.PNG", frames[:1], dtype="uint16", full_scale=4095)
    torch.testing.assert_close(read_stack(tmp_path / "one.PNG"), frames[:1].float())


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
@pytest.mark.parametrize("ending", [".tif", ".npy", ".h5"])
def test_floats_keep_their_values_also_nan_and_infinity(tmp_path, dtype, ending):
    frames = torch.tensor([[[0.5, -2.0], [1e4, 0.25]], [[np.nan, np.inf], [0.0, 1.0]]])
    path = tmp_path / f"frames{ending}"
    write_stack(path, frames, dtype=dtype)
    assert read_stack_info(path) == StackInfo((2, 2, 2), dtype, None)
    torch.testing.assert_close(read_stack(path, full_scale=4095), frames, equal_nan=True, rtol=0, atol=0)


def test_values_are_rounded_and_clipped_to_full_scale(tmp_path):
    frames = torch.tensor([[[-0.3, 1.7, 0.49 / 4095, 0.51 / 4095, 1.0]]])
    write_stack(tmp_path / "frames.tif", frames, dtype="uint16", full_scale=4095)
    assert tifffile.imread(tmp_path / "frames.tif").tolist() == [[[0, 4095, 0, 1, 4095]]]


def test_full_scale_argument_has_priority(tmp_path):
    write_stack(tmp_path / "frames.tif", torch.full((2, 4, 4), 0.5), dtype="uint16", full_scale=1000)
    assert read_stack(tmp_path / "frames.tif").unique().tolist() == [0.5]
    assert read_stack(tmp_path / "frames.tif", full_scale=2000).unique().tolist() == [0.25]


def test_png_files_are_read_in_natural_order(tmp_path):
    for index in (2, 10, 1, 9):
        cv2.imwrite(str(tmp_path / f"shot{index}.png"), np.full((4, 5), index, np.uint8))
    (tmp_path / "notes.txt").write_text("not a frame")
    assert (read_stack(tmp_path)[:, 0, 0] * 255).round().tolist() == [1, 2, 9, 10]


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
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("scan/counts", data=COUNTS, chunks=(2, 4, 4), compression="gzip")
        file.create_dataset("temperature", data=np.zeros(3))
    (tmp_path / "tiffs").mkdir()
    (tmp_path / "pngs").mkdir()
    for index, frame in enumerate(COUNTS):
        tifffile.imwrite(tmp_path / "tiffs" / f"{index}.tif", frame)
        cv2.imwrite(str(tmp_path / "pngs" / f"{index}.png"), frame)
    for name in ("a.tif", "a.npy", "a.h5", "tiffs", "pngs"):
        check_frames(tmp_path / name, COUNTS)


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


@pytest.mark.parametrize(("ending", "package", "extra"), [(".h5", "h5py", "formats"), (".mp4", "av", "video")])
def test_missing_package_names_the_extra(tmp_path, monkeypatch, ending, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / "a.h5").write_bytes(b"")
    (tmp_path / "a.mp4").write_bytes(b"")
    message = rf"needs the package {package}: pip install rsvib_torch\[{extra}\]"
    refuses(lambda: read_stack(tmp_path / f"a{ending}"), message, ModuleNotFoundError)
    with pytest.raises(ModuleNotFoundError, match=message):
        write_stack(tmp_path / f"b{ending}", torch.rand(2, 4, 4), dtype="uint8")


LARGE = np.random.default_rng(0).integers(0, 4096, (17, 48, 64)).astype(np.uint16)


@pytest.mark.parametrize("kind", [h5py.h5t.STD_U16LE, h5py.h5t.STD_U16BE])
def test_hdf5_integers_of_twelve_bits_within_sixteen(tmp_path, kind):
    """They were read with the position of their bits: 16 times too large."""
    kind = kind.copy()
    kind.set_precision(12)
    kind.set_offset(4)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = h5py.h5d.create(file.id, b"frames", kind, h5py.h5s.create_simple(LARGE.shape))
        dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, LARGE)
    read = rsv.read_stack(tmp_path / "a.h5", full_scale=4095)
    np.testing.assert_array_equal((read * 4095).round().numpy(), LARGE)


@pytest.mark.parametrize(("dtype", "full_scale"), [(np.uint8, 255), (np.uint16, 65535)])
def test_grey_png_with_a_transparent_value(tmp_path, dtype, full_scale):
    counts = LARGE[0].astype(dtype)
    Image.fromarray(counts).save(tmp_path / "a.png", transparency=7)
    read = rsv.read_stack(tmp_path / "a.png", full_scale=full_scale)[0]
    np.testing.assert_array_equal((read * full_scale).round().numpy(), counts)


@pytest.mark.parametrize(("mode", "channels"), [("1", 1), ("P", 3), ("LA", 4)])
def test_png_with_few_bits_a_palette_or_alpha(tmp_path, mode, channels):
    image = Image.fromarray(np.arange(0, 240, 4, dtype=np.uint8).reshape(6, 10))
    image = image.convert("RGB").quantize(64) if mode == "P" else image.convert(mode)
    image.save(tmp_path / "a.png")
    pixels = rsv.read_stack(tmp_path / "a.png")[0]
    expected = np.asarray(image.convert({1: "L", 3: "RGB", 4: "RGBA"}[channels])) / 255
    assert pixels.shape == ((6, 10) if channels == 1 else (channels, 6, 10))
    np.testing.assert_allclose(pixels.numpy(), expected if channels == 1 else np.moveaxis(expected, -1, 0), atol=1e-6)


def test_animated_png_is_refused(tmp_path):
    frames = [Image.fromarray((counts // 16).astype(np.uint8)) for counts in LARGE[:3]]
    frames[0].save(tmp_path / "a.png", save_all=True, append_images=frames[1:])
    refuses(lambda: rsv.read_stack(tmp_path / "a.png"), r"a.png: .*an animated PNG, of which only the first frame")
