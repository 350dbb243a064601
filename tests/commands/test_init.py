"""rsvib init: configuration files for the camera of a stack."""

import shlex
import tomllib

import numpy as np
import pytest
import tifffile
import torch
from program import refused, rsvib
from small_video import write_video

from rsvib_torch.config import read_config
from rsvib_torch.io import StackInfo, write_stack

TIMES = ("--row-time", "40us", "--exposure", "1/1250")
RATE = ("--frame-rate", "30000/1001")


def init(*arguments):
    return rsvib("init", *arguments)


@pytest.fixture(name="frames")
def make_frames():
    return torch.rand(4, 64, 48, generator=torch.Generator().manual_seed(1))


@pytest.fixture(name="place")
def go_to_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_clip(path):
    """Five frames, at 25 per second."""
    frames = np.broadcast_to(20 * np.arange(5, dtype=np.uint8)[:, None, None, None], (5, 64, 48, 3))
    options = {"layout": "rgb24", "codec": "libx264", "encoded": "yuv420p", "rate": 25}
    write_video(path, frames, np.arange(5) / 25, **options)


def test_values_of_a_video_and_of_options(place, capsys):
    write_clip(place / "clip.mp4")
    assert init("clip.mp4", *TIMES) == 0
    text = (place / "camera.toml").read_text()
    assert tomllib.loads(text)["sensor"] == {
        "row_time": 4e-5,
        "exposure_time": 8e-4,
        "frame_rate": 25.0,
        "scan_axis": "y",
        "readout_direction": "forward",
    }
    assert text.startswith("# Camera of clip.mp4: 5 frames of 64 x 48 px (height x width), uint8.")
    assert "rsvib calibrate" in text
    timing = read_config(place / "camera.toml").timing
    assert (timing.exposure_rows, timing.frame_rate) == pytest.approx((20, 25))
    assert "rsvib run clip.mp4 results --config camera.toml --video" in capsys.readouterr().out
    assert init("clip.mp4", *TIMES, "--scan-axis", "x", "--overwrite") == 0  # options are preferred
    assert tomllib.loads((place / "camera.toml").read_text())["sensor"]["scan_axis"] == "x"


def test_frame_times_and_full_scale_of_the_file(place, frames, capsys):
    times = (0.0, 0.04, 0.08, 0.16)  # a frame was dropped
    info = StackInfo(tuple(frames.shape), "uint16", 4095, times)
    write_stack("f.h5", frames, dtype="uint16", full_scale=4095, like=info)
    assert init("f.h5", *TIMES) == 0
    config = read_config(place / "camera.toml")
    assert config.timing.frame_rate == pytest.approx(25.0)
    assert config.full_scale == 4095
    assert "states the time of every frame" in (place / "camera.toml").read_text()
    assert init("f.h5", *TIMES, "--frame-rate", 50, "--overwrite") == 0
    assert "--frame-rate is 50, the times in the file give 25" in capsys.readouterr().err


def test_unknown_full_scale_is_required(place, frames, capsys):
    np.save("f.npy", (frames * 4000).numpy().astype(np.uint16))
    error = refused(capsys, "init", "f.npy", *TIMES, *RATE)
    assert error.startswith("rsvib: error: --full-scale is missing.")
    assert init("f.npy", *TIMES, *RATE, "--full-scale", 4095) == 0
    assert read_config(place / "camera.toml").full_scale == 4095


def test_missing_values_are_explained_in_one_line_each(place, frames, capsys):
    write_stack("f.npy", frames)
    assert init("f.npy") == 2
    errors = capsys.readouterr().err.splitlines()
    assert [line.split(" is missing.")[0] for line in errors] == [
        f"rsvib: error: {option}" for option in ("--frame-rate", "--row-time", "--exposure")
    ]
    assert init("f.npy", *RATE) == 2
    error = capsys.readouterr().err
    assert "rsvib calibrate" in error
    limit = "It is not 1 / (frame rate x rows), because sensors have blanking rows. Here it is less than 521.4 us."
    assert limit in error
    assert not (place / "camera.toml").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--row-time", "40"), "--row-time=40 s is longer than 10 ms; --row-time is in seconds (40 us is 40e-6)"),
        (("--row-time", "600us"), "with 29.97 frames/s, --row-time is at most 0.000521354 s"),
        (("--frame-rate", "0.033"), "--frame-rate=0.033 is less than 0.1; it is in frames per second"),
        (("--out", "none/camera.toml"), "folder"),
    ],
)
def test_errors_are_one_line_and_write_nothing(place, frames, capsys, options, message):
    write_stack("f.npy", frames)
    values = dict(zip((*TIMES, *RATE)[::2], (*TIMES, *RATE)[1::2], strict=True)) | {options[0]: options[1]}
    error = refused(capsys, "init", "f.npy", *(part for pair in values.items() for part in pair))
    assert message in error
    assert sorted(path.name for path in place.iterdir()) == ["f.npy"]


def test_the_first_example_describes_frames_of_twelve_bits(place, frames, capsys):
    tifffile.imwrite("frames.tif", (4095 * frames.numpy()).astype(np.uint16), photometric="minisblack", metadata=None)
    assert init("--help") == 0
    example = capsys.readouterr().out.partition("Examples:")[2].replace("\\\n", " ").splitlines()[1]
    assert rsvib(*shlex.split(example)[1:]) == 0
    assert read_config("camera.toml").full_scale == 4095


@pytest.mark.parametrize(
    ("row_time", "message"),
    [
        ("520.8us", "equals 1 / (frame rate x rows), which is rarely true"),
        ("40ns", "only 0.0077 % of the frame period"),
    ],
)
def test_typical_mistakes_are_warned_of(place, frames, capsys, row_time, message):
    write_stack("f.npy", frames)
    assert init("f.npy", "--row-time", row_time, "--exposure", "1ms", *RATE) == 0
    assert message in capsys.readouterr().err


def test_images_that_are_stored_as_colours_of_one_frame_are_named(place, frames, capsys):
    counts = (4095 * frames[:3].numpy()).astype(np.uint16)
    tifffile.imwrite("frames.tif", counts, photometric="rgb", planarconfig="separate")
    assert init("frames.tif", *TIMES, *RATE, "--full-scale", 4095) == 0
    assert "1 frame of 3 channels of 64 x 48 px" in capsys.readouterr().out
