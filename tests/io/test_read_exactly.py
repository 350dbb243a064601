"""Files of other programs are read as they are meant, or refused in one line that names the file."""

from fractions import Fraction

import av
import h5py
import numpy as np
import pytest
from PIL import Image
from refusals import refuses

import rsvib_torch as rsv

COUNTS = np.random.default_rng(0).integers(0, 4096, (17, 48, 64)).astype(np.uint16)


@pytest.mark.parametrize("kind", [h5py.h5t.STD_U16LE, h5py.h5t.STD_U16BE])
def test_hdf5_integers_of_twelve_bits_within_sixteen(tmp_path, kind):
    """They were read with the position of their bits: 16 times too large."""
    kind = kind.copy()
    kind.set_precision(12)
    kind.set_offset(4)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = h5py.h5d.create(file.id, b"frames", kind, h5py.h5s.create_simple(COUNTS.shape))
        dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, COUNTS)
    read = rsv.read_stack(tmp_path / "a.h5", full_scale=4095)
    np.testing.assert_array_equal((read * 4095).round().numpy(), COUNTS)


def test_truncated_matroska_is_refused(tmp_path):
    """The container states its duration; 11 of 17 frames were read without a word."""
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=30, width=64, height=48, pix_fmt="gray")
        for index, counts in enumerate(COUNTS):
            frame = av.VideoFrame.from_ndarray((counts // 16).astype(np.uint8), format="gray")
            frame.pts, frame.time_base = index, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert rsv.read_stack_info(tmp_path / "a.mkv").shape == (17, 48, 64)
    data = (tmp_path / "a.mkv").read_bytes()
    (tmp_path / "b.mkv").write_bytes(data[: 2 * len(data) // 3])
    refuses(lambda: rsv.read_stack_info(tmp_path / "b.mkv"), r"b.mkv: .*truncated: 11 frames")


@pytest.mark.parametrize(("dtype", "full_scale"), [(np.uint8, 255), (np.uint16, 65535)])
def test_grey_png_with_a_transparent_value(tmp_path, dtype, full_scale):
    counts = COUNTS[0].astype(dtype)
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
    frames = [Image.fromarray((counts // 16).astype(np.uint8)) for counts in COUNTS[:3]]
    frames[0].save(tmp_path / "a.png", save_all=True, append_images=frames[1:])
    refuses(lambda: rsv.read_stack(tmp_path / "a.png"), r"a.png: .*an animated PNG, of which only the first frame")
