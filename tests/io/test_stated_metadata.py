"""Times, frame rate and orientation that other programs store in HDF5, TIFF, PNG and JPEG files."""

import warnings

import h5py
import numpy as np
import pytest
import torch
from PIL import ExifTags, Image
from program import rsvib
from refusals import refuses
from small_stack import CAMERA, OPTIONS, TIMING
from small_video import PERIOD, draw_frames

import rsvib_torch as rsv
from rsvib_torch.io import read_stack, read_stack_info, timing_from_first_frame, write_stack

KEPT = np.array([0, 1, 2, 4, 5, 9])  # the other frames were dropped
TIMES = KEPT * PERIOD
FRAMES = np.random.default_rng(1).integers(0, 255, (6, 20, 30), dtype=np.uint8)


def check_dropped_frames(path):
    used = timing_from_first_frame(TIMING, read_stack_info(path)).frame_start_times
    assert used == pytest.approx(TIMES, rel=1e-9)


def test_frame_rate_in_hdf5_is_compared(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = FRAMES
        file["frames"].attrs["frame_rate"] = 30.0
    message = r"a\.h5: 30 frames per second according to its frame_rate, but 96\.154 .* \(frame_rows=333\.333\)"
    with pytest.warns(rsv.TimingWarning, match=message):
        timing_from_first_frame(TIMING, read_stack_info(tmp_path / "a.h5"))


def test_times_in_attributes(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", data=FRAMES).attrs.update({"frame_times": TIMES, "orientation": "portrait"})
    check_dropped_frames(tmp_path / "a.h5")


def write_images(folder, ending, frames, orientation):
    folder.mkdir()
    for number, frame in enumerate(frames):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation if np.isscalar(orientation) else orientation[number]
        options = {"quality": 98} if ending == "jpg" else {}
        Image.fromarray(frame).save(folder / f"frame{number}.{ending}", exif=exif, **options)


@pytest.mark.parametrize("ending", ["jpg", "png", "tif"])
def test_images_are_read_as_stored_and_their_orientation_is_kept(tmp_path, ending):
    frames = draw_frames(np.arange(3) * PERIOD)
    write_images(tmp_path / "frames", ending, frames, 6)
    info, read = read_stack_info(tmp_path / "frames"), read_stack(tmp_path / "frames")
    assert info.orientation == 6
    np.testing.assert_allclose(read * 255, frames, atol=9)
    for output in ("images", "a.mp4", "a.h5", "a.tif"):
        write_stack(tmp_path / output, read, dtype="uint8", like=info)
        assert read_stack_info(tmp_path / output).orientation == 6
        assert read_stack(tmp_path / output).shape[-2:] == frames.shape[-2:]
    name = "frame0.tif" if ending == "tif" else "frame_0000.png"  # folders of TIFF files keep their names
    with Image.open(tmp_path / "images" / name) as image:
        assert image.getexif()[ExifTags.Base.Orientation] == 6


def test_images_of_different_orientation_are_refused(tmp_path):
    write_images(tmp_path / "frames", "png", FRAMES, (6, 6, 8, 6, 6, 6))
    with pytest.raises(ValueError, match=r"frame0\.png is .* with orientation 6, frame2\.png is .* with orientation 8"):
        read_stack_info(tmp_path / "frames")


def test_jpeg_files_are_read(tmp_path):
    colours = np.broadcast_to(np.array([200, 60, 30], np.uint8), (20, 30, 3))
    Image.fromarray(colours).save(tmp_path / "a.jpg", quality=98)
    Image.fromarray(colours).convert("CMYK").save(tmp_path / "b.jpg")
    frames = read_stack(tmp_path / "a.jpg")
    assert frames.shape == (1, 3, 20, 30)
    np.testing.assert_allclose(frames[0, :, 5, 5] * 255, [200, 60, 30], atol=3)
    refuses(lambda: read_stack(tmp_path / "b.jpg"), r"b\.jpg: .*pixels are CMYK; expected grey or RGB")
    data = (tmp_path / "a.jpg").read_bytes()
    for name, content in (("cut.jpg", data[: len(data) // 2]), ("no.jpg", b"GIF89a"), ("empty.jpeg", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=rf"{name}: (not a readable JPEG|frame 0 cannot be read)"):
            read_stack(tmp_path / name)
    (tmp_path / "c.png").write_bytes(b"")
    refuses(lambda: read_stack(tmp_path), "the folder contains both PNG and JPEG files")


def test_damaged_exif_metadata_do_not_prevent_reading(tmp_path):
    Image.fromarray(FRAMES[0]).save(tmp_path / "a.png", exif=b"Exif\0\0II*\0\xff\xff\xff\xff")
    Image.fromarray(FRAMES[0]).save(tmp_path / "b.png", exif=b"Exif\0\0nonsense")
    for name in ("a.png", "b.png"):
        assert read_stack_info(tmp_path / name).orientation == 1
        assert read_stack(tmp_path / name).shape == (1, 20, 30)


def test_a_frame_rate_is_kept_by_all_formats(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", data=FRAMES).attrs["frame_rate"] = 97.0
    like = read_stack_info(tmp_path / "a.h5")
    for name in ("b.h5", "b.tif"):
        write_stack(tmp_path / name, torch.rand(6, 20, 30), like=like)
        assert read_stack_info(tmp_path / name).frame_rate == 97.0
    write_stack(tmp_path / "b.mkv", torch.rand(6, 20, 30), dtype="uint8", like=like)
    assert read_stack_info(tmp_path / "b.mkv").frame_times == pytest.approx(np.arange(6) / 97, abs=6e-4)


def test_commands_and_functions_warn_once_of_another_frame_rate(tmp_path, capsys):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", data=draw_frames(np.arange(6) * PERIOD)).attrs["frame_rate"] = 30
    (tmp_path / "camera.toml").write_text(CAMERA.replace("full_scale = 4095\n", ""))
    config = ("--config", tmp_path / "camera.toml")
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert rsvib("run", tmp_path / "a.h5", tmp_path / "out", *config) == 0
        assert capsys.readouterr().err.count("a.h5: 30 frames per second according to its frame_rate") == 1
    options = {"detection": OPTIONS["detection"], "restoration": OPTIONS["restoration"]}
    for call in (
        lambda: rsv.process_stack(tmp_path / "a.h5", tmp_path / "b.tif", TIMING, **options),
        lambda: rsv.detect_vibration(tmp_path / "a.h5", TIMING, **OPTIONS["detection"]),
    ):
        with pytest.warns(rsv.TimingWarning, match="30 frames per second"):
            call()
