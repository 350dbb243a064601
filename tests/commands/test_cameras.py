"""rsvib cameras, rsvib init --camera, and the camera that a file names: row times of the table of camera models."""

import csv
import json
import tomllib
from fractions import Fraction
from importlib.resources import files

import av
import numpy as np
import pytest
from PIL import ExifTags, Image
from program import refused, rsvib

import rsvib_torch as rsv
from rsvib_torch.config import read_config

# Name as a user writes it, size and rate of a clip, readout time in ms that the profiles of the model state
MODELS = (
    ("iPhone 12", 3840, 2160, 59.94, 4.98),
    ("apple iphone 12 ultra wide", 1920, 1080, 24, 15.7),
    ("GoPro Hero6 Black", 2704, 2028, 29.97, 11.1),
    ("Pixel 8", 2048, 1536, 24, 4.53),
)


@pytest.fixture(name="place", autouse=True)
def go_to_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_clip(name="clip.mp4", size=(48, 64), rate=30, tags=None):
    """A video of three frames with the tags of a camera."""
    with av.open(name, "w", options={"movflags": "use_metadata_tags"}) as output:
        output.metadata.update(tags or {})
        video = output.add_stream("mpeg4", rate=Fraction(rate).limit_denominator(1001))
        video.height, video.width = size
        for level in (50, 90, 130):
            output.mux(video.encode(av.VideoFrame.from_ndarray(np.full((*size, 3), level, np.uint8))))
        output.mux(video.encode())


def sensor():
    with open("camera.toml", "rb") as file:
        return tomllib.load(file)["sensor"]


@pytest.mark.parametrize(("name", "width", "height", "rate", "readout"), MODELS)
def test_models_by_name(name, width, height, rate, readout):
    mode = rsv.camera_mode(name, width=width, height=height, frame_rate=rate)
    assert mode.row_time == pytest.approx(1e-3 * readout / height, rel=0.01)
    assert 0.029 < mode.row_time_std / mode.row_time < 0.1
    assert mode.frame_rate == rate


def test_table_has_no_row_that_contradicts_itself():
    """Readout times fit into the frame period, spreads are those of measurements, and no mode occurs twice."""
    text = (files("rsvib_torch") / "motion" / "readout_times.csv").read_text(encoding="utf-8")
    assert "CC0 1.0" in text
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    modes = rsv.find_cameras()
    assert len(modes) == len(rows) > 300
    keys = {(mode.name.casefold(), mode.width, mode.height, mode.frame_rate) for mode in modes}
    assert len(keys) == len(modes)
    for mode in modes:
        assert 3e-3 <= mode.readout_time <= 1.02 / mode.frame_rate, mode
        assert 0.029 <= mode.readout_time_std / mode.readout_time <= 0.1, mode
        rsv.SensorTiming.from_seconds(row_time=mode.row_time, exposure_time=1e-4, frame_rate=mode.frame_rate)


@pytest.mark.parametrize(
    ("name", "size", "message"),
    [
        ("iPhnoe 12", (3840, 2160, 60), "no camera 'iPhnoe 12' .*; similar: Apple iPhone 12"),
        (
            "iPhone 7",
            (3840, 2160, 30),
            "no camera 'iPhone 7' .*; similar: Apple iPhone 7 Plus",
        ),  # another camera
        ("GoPro", (3840, 2160, 30), "similar: GoPro HERO, GoPro HERO5 Black, .* and 1 more"),
        ("iPhone 12", (1920, 1080, 24), "several modes fit.*: Apple iPhone 12 Ultra Wide, Apple iPhone 12 Wide"),
        (
            "iPhone 12",
            (1920, 1080, 60),
            "no mode .* at 60/s: 1920 x 1080 px at 24/s Ultra Wide .readout 15.7 ms., 1920 x 1080 px at 24/s Wide "
            ".readout 6.6 ms., 3840 x 2160 px .*; try the readout time of a known rate",
        ),
        ("iPhone 12", (640, 360, 60), ": 3840 x 2160 px at 60/s .readout 4.98 ms., .*; measure the row time"),
        ("iPhone 12", (3840, 2160, 30), "no mode of Apple iPhone 12"),  # another rate
    ],
)
def test_what_the_table_does_not_state_is_refused(name, size, message):
    with pytest.raises(ValueError, match=message) as error:
        rsv.camera_mode(name, width=size[0], height=size[1], frame_rate=size[2])
    assert "\n" not in str(error.value)


def test_command_lists_models_and_modes(capsys):
    assert rsvib("cameras", "iphone", "12") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:2] == ["brand", "model"]
    assert len([line for line in lines if "iPhone 12" in line]) == 5
    assert "Apple  iPhone 12              3840 x 2160     60   4.98 ± 0.15   2.306 ± 0.069  1" in lines[2]
    assert rsvib("cameras", "HERO7", "--json") == 0
    listed = json.loads(capsys.readouterr().out)["cameras"]
    assert {entry["model"] for entry in listed} == {"HERO7 Black"}
    assert listed[0]["row_time"] == pytest.approx(listed[0]["readout_time"] / listed[0]["height"])
    assert "similar: Apple iPhone 12" in refused(capsys, "cameras", "iphnoe 12")


def test_init_takes_the_row_time_of_a_camera(place, capsys):
    write_clip(size=(1080, 1920), rate=30)
    options = ("--exposure", "1/500")
    assert "3840 x 2160 px at 30/s" in refused(
        capsys, "init", "clip.mp4", "--camera", "a6700", *options
    )  # of 2160 rows only: half the size
    error = refused(capsys, "init", "clip.mp4", "--camera", "Xperia 1 VI", *options)
    assert "similar: Sony Xperia 1 V" in error
    write_clip(size=(1520, 2704), rate=30)
    assert rsvib("init", "clip.mp4", "--camera", "HERO5 Black", *options) == 0
    assert sensor()["row_time"] == pytest.approx(26.69e-3 / 1520, rel=1e-3)
    timing = rsv.SensorTiming.from_file("camera.toml")
    assert timing.row_time_std == pytest.approx(0.03 * timing.row_time, rel=0.01)
    assert timing.to_dict()["row_time_std"] == timing.in_row_order().row_time_std == timing.row_time_std
    other = read_config("camera.toml", sensor={"row_time": 12e-6}).timing  # a row time of the command line is exact
    assert (other.row_time, other.row_time_std) == (12e-6, 0.0)
    text = " ".join(line.removeprefix("# ") for line in (place / "camera.toml").read_text().splitlines())
    assert "GoPro HERO5 Black, 2704 x 1520 px at 30/s" in text
    both = ("--camera", "HERO5 Black", "--row-time", "10us")
    assert "give one of them" in refused(capsys, "init", "clip.mp4", *both, *options, "--overwrite")


@pytest.mark.parametrize(
    ("tags", "camera"),
    [
        ({"com.apple.quicktime.make": "Apple", "com.apple.quicktime.model": "iPhone 7 Plus"}, "Apple iPhone 7 Plus"),
        ({"com.android.manufacturer": "Apple", "com.android.model": "iPhone 7 Plus"}, "Apple iPhone 7 Plus"),
    ],
)
def test_camera_that_a_video_names(capsys, tags, camera):
    write_clip(size=(2160, 3840), tags=tags)
    assert rsv.read_stack_info("clip.mp4").camera == camera
    error = refused(capsys, "init", "clip.mp4", "--exposure", "1ms")
    assert f'--camera "{camera}" takes row time' in error
    assert rsvib("init", "clip.mp4", "--exposure", "1ms", "--camera", camera) == 0
    assert sensor()["row_time"] == pytest.approx(15.52e-3 / 2160, rel=0.01)


@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_camera_that_images_name(place, capsys, kind):
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Google", "Pixel 8\0"
    (place / "frames").mkdir()
    for number in range(2):
        Image.new("L", (2048, 1536), 40 + number).save(place / "frames" / f"{number}.{kind}", exif=exif)
    assert rsv.read_stack_info("frames").camera == "Google Pixel 8"
    assert '--camera "Google Pixel 8" takes row time 2.949 ± 0.091 us' in refused(
        capsys, "init", "frames", "--exposure", "1ms", "--frame-rate", "24"
    )
    assert "The file names its camera, Google Pixel 8: no mode of Google Pixel 8" in refused(
        capsys, "init", "frames", "--exposure", "1ms", "--frame-rate", "30"
    )


def test_files_without_a_camera_or_of_an_unknown_one(capsys):
    write_clip()
    assert rsv.read_stack_info("clip.mp4").camera is None
    write_clip("other.mp4", tags={"com.apple.quicktime.model": "Toaster"})
    assert "names its camera, Toaster: no camera 'Toaster' in the table" in refused(
        capsys, "init", "other.mp4", "--exposure", "1ms"
    )
    assert rsvib("init", "other.mp4", "--exposure", "1ms", "--row-time", "20us") == 0
