"""The rsvib program: all commands on small frames, and one line for every error."""

import json
import re

import numpy as np
import pytest
import tifffile
import torch
from program import refused, rsvib
from truth import MARGIN, Curve, Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorNoise, SensorTiming, StackInfo, Vibration, __version__, read_manifest, simulate_frames
from rsvib_torch.io import read_stack, read_stack_info, write_stack

AMPLITUDE, FREQUENCY, PHASE = (1.6, 1.1), (71.0, 113.0), (0.6, -1.2)
CONFIG = """
[sensor]
row_time = 4e-5
exposure_rows = 12
frame_rows = 512
full_scale = 4095
"""


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    """A folder with a config, a scene, and frames of it."""
    folder = tmp_path_factory.mktemp("camera")
    (folder / "camera.toml").write_text(CONFIG)
    write_stack(folder / "scene.png", draw_scene(368, 240, 11)[None], dtype="uint16", full_scale=65535)
    scene, timing = read_stack(folder / "scene.png")[0], SensorTiming.from_file(folder / "camera.toml")
    noise, generator = SensorNoise(read_noise=0.003), torch.Generator().manual_seed(5)
    vibration = Vibration(AMPLITUDE, FREQUENCY, PHASE)
    frames = simulate_frames(scene, timing, vibration, 2, frame_size=(304, 176), noise=noise, generator=generator)
    info = StackInfo(tuple(frames.shape), "uint16", 4095.0, frame_rate=timing.frame_rate)
    write_stack(folder / "frames.tif", frames, dtype="uint16", full_scale=4095, like=info)
    return folder


@pytest.fixture(scope="module", name="vibration_text")
def detect_once(place):
    assert rsvib("detect", place / "frames.tif", "--config", place / "camera.toml", "--out", place / "detection") == 0
    return (place / "detection" / "vibration.json").read_text()


def restore_arguments(place, folder, out="r.tif"):
    config = ("--config", place / "camera.toml")
    return ("restore", place / "frames.tif", folder / out, *config, "--vibration", folder / "v.json")


def test_pixels_without_data_are_neither_used_nor_changed(tmp_path, capsys):
    timing, motion = SensorTiming(row_time=4e-5, exposure_rows=12, frame_rows=210), Motion(AMPLITUDE, FREQUENCY, PHASE)
    scene = draw_scene(200 + 2 * MARGIN, 160 + 2 * MARGIN, 3)
    frames = np.clip(4095 * take_frames(scene, timing, motion, 5, 0.003), 1, 4095).astype(np.uint16)
    border = np.arange(160) < 50 - 0.2 * np.arange(200)[:, None]
    frames[:, border] = 65535
    tags = [(42113, "s", 0, "65535", False)]
    tifffile.imwrite(tmp_path / "f.tif", frames, photometric="minisblack", metadata=None, extratags=tags)
    camera = ("--row-time", "40us", "--exposure", "0.48ms", "--frame-rate", timing.frame_rate, "--full-scale", 4095)
    inside, sharp = ~border[24:-24, 24:-24], crop(scene)[24:-24, 24:-24]
    for name, more in (("whole", ()), ("windows", ("--window", 3))):
        assert rsvib("run", tmp_path / "f.tif", tmp_path / name, *camera, *more) == 0
        restored = tifffile.imread(tmp_path / name / "restored.tif")
        assert (restored[:, border] == 65535).all()
        assert (restored[:, ~border] <= 4095).all()
        before, after = (f[:, 24:-24, 24:-24][:, inside] / 4095 - sharp[inside] for f in (frames, restored))
        assert np.square(after).mean() < np.square(before).mean() / 100  # 20 dB
    assert "not kept" not in capsys.readouterr().out
    vibration = json.loads((tmp_path / "whole" / "vibration.json").read_text())["vibration"]
    assert [tones[0] for tones in vibration["amplitude"]] == pytest.approx(AMPLITUDE, rel=0.01)


def test_a_wrong_vibration_leaves_the_frames_unchanged_unless_forced(place, vibration_text, tmp_path, capsys):
    data = json.loads(vibration_text)
    data["vibration"]["phase"] = [[p + 3.0 for p in axis] for axis in data["vibration"]["phase"]]
    (tmp_path / "v.json").write_text(json.dumps(data))
    arguments = restore_arguments(place, tmp_path)
    capsys.readouterr()
    assert rsvib(*arguments) == 0
    shown = capsys.readouterr()
    assert shown.err.startswith("rsvib: warning: improvement not certain: restored is no better than raw")
    assert "--force writes the restored ones" in shown.err
    assert shown.err.count("\n") == 1
    assert "2 frames in 1 window, 0 restored" in shown.out
    assert (tifffile.imread(tmp_path / "r.tif") == tifffile.imread(place / "frames.tif")).all()
    assert rsvib(*arguments, "--force", "--overwrite", "--json") == 0
    shown = capsys.readouterr()
    assert "restored is no better than raw" in shown.err
    restoration = json.loads(shown.out)["restoration"]
    assert (restoration["restored"], restoration["outcomes"]) == (1, {"worse": 1})
    assert (tifffile.imread(tmp_path / "r.tif") != tifffile.imread(place / "frames.tif")).any()


def test_known_motion_that_makes_frames_worse_leaves_them_unchanged_unless_forced(tmp_path, capsys):
    """The motion is right in the first pair of frames, which moves most, and wrong in the others."""

    transient = Curve(lambda times: np.stack([12 * np.exp(-times / 0.006) * np.cos(400 * times), 0 * times], -1))
    timing = SensorTiming(row_time=4e-5, exposure_rows=12, frame_rows=210)
    scene = draw_scene(200 + 2 * MARGIN, 128 + 2 * MARGIN, 3)
    frames = np.clip(4095 * take_frames(scene, timing, transient, 5, 0.003), 0, 4095).astype(np.uint16)
    tags = [(33550, "d", 3, (0.5, 0.5, 0.0), False), (42113, "s", 0, "0", False)]
    options = {"photometric": "minisblack", "metadata": None, "extratags": tags}
    tifffile.imwrite(tmp_path / "frames.tif", frames, **options)
    times = np.arange(-0.001, 0.06, 2e-5)
    x, y = transient.displacement(times).T
    wrong = 0.25 * np.sin(2 * np.pi * 173 * times)
    table = np.column_stack([times, x + wrong, y + wrong])
    np.savetxt(tmp_path / "motion.csv", table, delimiter=",", header="time,x,y", comments="")
    text = "[sensor]\nrow_time = 4e-5\nexposure_rows = 12\nframe_rows = 210\nfull_scale = 4095\n"
    (tmp_path / "camera.toml").write_text(text)
    known = ("restore", tmp_path / "frames.tif", tmp_path / "k.tif", "--config", tmp_path / "camera.toml")
    known += ("--motion", tmp_path / "motion.csv", "--unit", "px", "--offset", "0")
    assert rsvib(*known) == 0
    shown = capsys.readouterr()
    assert "5 frames in 1 window, 0 restored" in shown.out
    assert "restored is no better than raw" in shown.err
    assert "--force writes the restored ones" in shown.err
    assert (tifffile.imread(tmp_path / "k.tif") == frames).all()
    assert rsvib(*known, "--force", "--overwrite") == 0
    assert "5 frames in 1 window, 1 restored" in capsys.readouterr().out
    assert (tifffile.imread(tmp_path / "k.tif") != frames).any()
    with tifffile.TiffFile(tmp_path / "k.tif") as tif:
        assert [tif.pages[1].tags[code].value for code in (33550, 42113)] == [(0.5, 0.5, 0.0), "0"]
    assert rsvib(*known[:2], tmp_path / "k.npy", *known[3:]) == 0
    assert "k.npy: not kept from the input: ModelPixelScaleTag, GDAL_NODATA\n" in capsys.readouterr().out


def test_options_of_restoration_come_from_config_or_command_line(place, tmp_path, capsys):
    out = tmp_path / "out"
    config = tmp_path / "dewarp.toml"
    config.write_text(CONFIG + "[restoration]\nmethod = 'banded'\nhalf_rows = 8\nsaturation = 4000\n")
    common = ("run", place / "frames.tif", out, "--config", config, "--overwrite")
    assert rsvib(*common) == 0
    manifest = read_manifest(out / "manifest.json")
    assert manifest.settings["restoration"] == {"method": "banded", "half_rows": 8, "saturation": 4000 / 4095}
    (record,) = manifest.windows
    assert (record.outcome, record.frames, record.left_alone) == ("helps", "restored", ())
    assert "1 restored" in capsys.readouterr().out
    # options of the configured method are dropped with it
    assert rsvib(*common, "--method", "exact", "--joint", "all", "--saturation", 4095) == 0
    stated = read_manifest(out / "manifest.json").settings["restoration"]
    assert stated == {"method": "exact", "joint": True, "saturation": 1.0}
    assert read_stack_info(out / "restored.tif").shape == (1, 304, 176)
    at_rest = read_stack(place / "scene.png")[0, 32:-32, 32:-32]
    assert decibel(read_stack(out / "restored.tif")[0], at_rest.numpy()) > 40
    for options, message in (
        (("--method", "dewarp", "--joint", "2"), "joint is no option of method='dewarp', which has none"),
        (("--method", "exact", "--joint", "many"), "expected 'all' or a number of frames, got 'many'"),
    ):
        assert message in refused(capsys, *common, *options)


def test_full_scale_comes_from_option_file_or_config(place, tmp_path, capsys):
    counts = tifffile.imread(place / "frames.tif")
    tifffile.imwrite(tmp_path / "plain.tif", counts, photometric="minisblack")
    arguments = (tmp_path / "plain.tif", "--config", place / "camera.toml", "--out", tmp_path / "out", "--overwrite")
    assert rsvib("detect", *arguments) == 0  # the full scale is in the configuration
    silent = tmp_path / "silent.toml"
    silent.write_text(CONFIG.replace("full_scale = 4095", ""))
    assert rsvib("detect", arguments[0], "--config", silent, "--out", tmp_path / "o", "--full-scale", 4095) == 0
    found = ("--vibration", tmp_path / "out" / "vibration.json")
    for command in (("detect", "--out", tmp_path / "out2"), ("restore", tmp_path / "r.tif", *found)):
        unknown = refused(capsys, command[0], arguments[0], *command[1:], "--config", silent)
        assert "plain.tif: full scale of uint16 frames unknown: pass full_scale, e.g. 4095 for 12-bit counts" in unknown
    assert "beyond --full-scale=100" in refused(capsys, "detect", *arguments, "--full-scale", 100)
    assert not (tmp_path / "out2").exists()


def test_options_describe_the_camera_without_a_file(place, tmp_path, capsys):
    """The frame rate is that of the file; it and the full scale are in the next command."""
    camera, found = ("--row-time", "40us", "--exposure", "0.48ms"), tmp_path / "found"
    assert rsvib("detect", place / "frames.tif", *camera, "--full-scale", 65535, "--out", found) == 0
    printed = capsys.readouterr()
    assert "frame rate 48.8281 per second, from the times in" in re.sub(r"\s+", " ", printed.out + printed.err)
    assert "--full-scale 65535" in printed.out
    stated = json.loads((found / "vibration.json").read_text())
    assert stated["timing"]["frame_rows"] == pytest.approx(512)
    assert [tones[0] for tones in stated["vibration"]["amplitude"]] == pytest.approx(AMPLITUDE, rel=0.02)
    unexposed = refused(capsys, "detect", place / "frames.tif", *camera[:2], "--out", tmp_path / "none")
    assert "the camera is not described: give --exposure, or --config" in unexposed
    np.save(tmp_path / "frames.npy", np.zeros((2, 96, 96), np.uint8))
    assert "the camera is not described: give --frame-rate, or --config" in refused(
        capsys, "detect", tmp_path / "frames.npy", *camera, "--out", tmp_path / "none"
    )
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(CONFIG.replace("4e-5", "5e-5").replace("exposure_rows = 12", "exposure_time = 0.48e-3"))
    arguments = (place / "frames.tif", "--config", wrong, "--row-time", "40us", "--out", tmp_path / "replaced")
    assert rsvib("detect", *arguments) == 0
    replaced = json.loads((tmp_path / "replaced" / "vibration.json").read_text())
    assert replaced["vibration"]["frequency"][0] == pytest.approx(stated["vibration"]["frequency"][0], rel=1e-3)


def test_outputs_that_cannot_be_written(place, vibration_text, tmp_path, capsys, monkeypatch):
    (tmp_path / "v.json").write_text(vibration_text)
    (tmp_path / "file").write_text("")
    frames, config = place / "frames.tif", ("--config", place / "camera.toml")
    cases = [
        (restore_arguments(place, tmp_path, "none/r.tif"), "none does not exist"),
        (("detect", frames, *config, "--out", tmp_path / "file"), "a file of that name exists"),
        (("run", frames, tmp_path / "file" / "out", *config), "file is not writable"),
        (restore_arguments(place, tmp_path, "f.webm"), "wmv files can only be read"),
        (("run", tmp_path / "none.tif", tmp_path / "out", *config), "none.tif does not exist"),
        (("detect", frames, "--config", "none.toml", "--out", tmp_path / "out"), "none.toml: No such"),
    ]

    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    before = sorted(tmp_path.iterdir())
    for arguments, message in cases:
        assert message in refused(capsys, *arguments)
    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    for arguments in (("run", frames, tmp_path / "out", *config), restore_arguments(place, tmp_path)):
        assert f"folder {tmp_path} is not writable (Permission denied)" in refused(capsys, *arguments)
    assert sorted(tmp_path.iterdir()) == before


def test_usage_errors(capsys, tmp_path):
    detect = ("detect", "f.tif", "--out", tmp_path)
    for arguments, message in (
        (("detect", "f.tif"), "Missing option '--out'"),
        ((*detect, "--exposure", "1ms"), "the camera is not described: give --row-time, --frame-rate, or --config"),
        ((*detect, "--row-time", "20um"), "expected a time such as 14.5us, 1/500 or 2e-5"),
        ((*detect, "--frame-rate", "fast"), "expected a number such as 29.97 or 30000/1001"),
        (("paint",), "No such command 'paint'"),
        (("run", "a.png", "b.png", "out"), "(out); give a sequence of files as their folder"),
        ((*detect, "--config", "c.toml", "--full-scale", "x"), "Invalid value for '--full-scale'"),
        (("restore", "f.tif", "r.tif", "--vibration", "v", "--mosaic", "RGB"), "'RGB' is not one of 'RGGB', 'BGGR'"),
    ):
        assert message in refused(capsys, *arguments)
    assert rsvib() == 0
    assert "calibrate" in capsys.readouterr().out
    assert rsvib("--version") == 0
    assert capsys.readouterr().out == f"rsvib {__version__}\n"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_missing_gpu(place, tmp_path, capsys):
    arguments = (place / "frames.tif", "--config", place / "camera.toml", "--out", tmp_path / "out")
    error = refused(capsys, "detect", *arguments, "--device", "cuda")
    assert error.startswith("rsvib: error: device='cuda' is not available: ")
    assert error.count("\n") == 1
