"""Stacks in files: round trips with full scale, and files of other programs."""

import cv2
import numpy as np
import pytest
import tifffile
import torch

from rsvib_torch.io import StackInfo, read_stack, read_stack_info, write_stack


def draw_counts(shape, largest, dtype="uint16"):
    values = np.random.default_rng(3).integers(0, largest + 1, shape)
    values.flat[:2] = 0, largest
    return values.astype(dtype)


STACKS = [
    ((1, 9, 7), "uint8", 255),
    ((3, 9, 7), "uint16", 4095),
    ((2, 3, 9, 7), "uint8", 63),
    ((2, 4, 9, 7), "uint16", 65535),
    ((1, 3, 9, 7), "uint16", 1000),
]


@pytest.mark.parametrize(
    ("shape", "dtype", "largest"), [*STACKS, ((2, 2, 9, 7), "int16", 4095), ((2, 5, 9, 7), "uint32", 100000)]
)
def test_tiff_round_trip_keeps_counts_and_full_scale(tmp_path, shape, dtype, largest):
    stored = draw_counts(shape, largest, dtype)
    path = tmp_path / "frames.tif"
    write_stack(path, torch.from_numpy(stored / largest), dtype=dtype, full_scale=largest)
    assert read_stack_info(path) == StackInfo(shape, dtype, float(largest))
    frames = read_stack(path)
    assert frames.dtype == torch.float32
    assert frames.shape == shape
    np.testing.assert_allclose(frames.numpy(), stored / largest, rtol=1e-7)
    raw = tifffile.imread(path)
    assert raw.dtype == dtype
    raw = np.moveaxis(raw, -1, -3) if len(shape) == 4 and shape[1] in (3, 4) else raw
    np.testing.assert_array_equal(raw.reshape(shape), stored)
    write_stack(tmp_path / "again.tif", frames, dtype=dtype, full_scale=largest)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "again.tif"), tifffile.imread(path))


@pytest.mark.parametrize(("shape", "dtype", "largest"), STACKS)
def test_png_folder_round_trip_keeps_counts_and_full_scale(tmp_path, shape, dtype, largest):
    stored = draw_counts(shape, largest, dtype)
    path = tmp_path / "frames"
    write_stack(path, torch.from_numpy(stored / largest), dtype=dtype, full_scale=largest)
    assert sorted(p.name for p in path.iterdir()) == [f"frame_{i:04d}.png" for i in range(shape[0])]
    assert read_stack_info(path) == StackInfo(shape, dtype, float(largest))
    np.testing.assert_allclose(read_stack(path).numpy(), stored / largest, rtol=1e-7)
    raw = cv2.imread(str(path / "frame_0000.png"), cv2.IMREAD_UNCHANGED)
    expected = stored[0] if len(shape) == 3 else np.moveaxis(stored[0], 0, -1)[..., [2, 1, 0, 3][: shape[1]]]
    np.testing.assert_array_equal(raw, expected)


def test_npy_and_single_png(tmp_path):
    stored = draw_counts((2, 9, 7), 4095)
    frames = torch.from_numpy(stored / 4095)
    write_stack(tmp_path / "frames.npy", frames, dtype="uint16", full_scale=4095)
    np.testing.assert_array_equal(np.load(tmp_path / "frames.npy"), stored)
    assert read_stack_info(tmp_path / "frames.npy") == StackInfo((2, 9, 7), "uint16", None)
    torch.testing.assert_close(read_stack(tmp_path / "frames.npy", full_scale=4095), frames.float())
    np.save(tmp_path / "image.npy", stored[0])
    assert read_stack(tmp_path / "image.npy", full_scale=4095).shape == (1, 9, 7)
    write_stack(tmp_path / "one.PNG", frames[:1], dtype="uint16", full_scale=4095)
    torch.testing.assert_close(read_stack(tmp_path / "one.PNG"), frames[:1].float())


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
@pytest.mark.parametrize("ending", [".tif", ".npy"])
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
