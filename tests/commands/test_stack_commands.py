"""rsvib run, detect and restore of long stacks: in windows, resumed, within a memory limit."""

import csv

import numpy as np
import pytest
import tifffile
from program import refused, rsvib
from small_stack import CAMERA, HEIGHT, STILL, WIDTH, write_small

from rsvib_torch import read_manifest, read_stack, read_stack_info

FRAMES = 13
CONFIG = CAMERA + "[stack]\nwindow = 4\n"
MOSAIC = """
[restoration]
joint = true
scale = 2
mosaic = "RGGB"

[restoration.optics]
sigma = 0.4
pixel = 1.0

[stack]
window = 3
"""


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("long")
    write_small(folder / "frames.tif", FRAMES)
    (folder / "camera.toml").write_text(CONFIG)
    arguments = ("run", folder / "frames.tif", folder / "out", "--config", folder / "camera.toml")
    assert rsvib(*arguments, "--memory", "2GB", "--workers", 1) == 0
    return folder


def command(place, out, *more):
    return ("run", place / "frames.tif", out, "--config", place / "camera.toml", *more)


def test_run_of_a_long_stack(place, tmp_path, capsys):
    assert rsvib(*command(place, tmp_path / "out", "--output", "clear.h5")) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "13 frames in 4 windows, 4 restored, " in shown.out
    names = ["before_after.png", "clear.h5", "manifest.json", "tones.csv", "windows.png"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    assert read_stack_info(tmp_path / "out" / "clear.h5").full_scale == 4095
    with (tmp_path / "out" / "tones.csv").open() as file:
        lines = list(csv.DictReader(file))
    # one row per window, axis and tone; the middle is that of the exposures of the frames first ... last
    assert [(line["first_frame"], line["axis"]) for line in lines] == [(f, a) for f in "0369" for a in "xy"]
    for line in lines:
        amplitude, frequency = (1.2, 130) if line["axis"] == "x" else (0.8, 170)
        assert float(line["amplitude_px"]) == pytest.approx(amplitude, rel=0.06)
        assert float(line["frequency_Hz"]) == pytest.approx(frequency, rel=0.03)
        assert (line["tone"], line["frames"], line["reliable"], line["reasons"]) == ("1", "restored", "True", "")
        middle = 104e-4 * (int(line["first_frame"]) + int(line["last_frame"])) / 2 + 0.5 * ((HEIGHT - 1) * 1e-4 + 6e-4)
        assert float(line["middle_time_s"]) == pytest.approx(middle)
    totals = read_manifest(tmp_path / "out" / "manifest.json").totals()
    assert (totals["windows"], totals["restored"], totals["tones"]["y"]["reliable_windows"]) == (4, 4, 4)
    assert totals["tones"]["y"]["tones"][0]["frequency"] == pytest.approx(170, rel=0.02)
    assert (totals["outcomes"], totals["errors"]) == ({"helps": 4}, {})
    gain = totals["predicted_gain_db"]
    assert 1 < gain["lowest"] <= gain["highest"] < 40


@pytest.mark.parametrize("bands", [2, 5])
def test_files_of_any_number_of_bands(place, tmp_path, bands):
    grey = tifffile.imread(place / "frames.tif")[:4]
    np.save(tmp_path / "bands.npy", np.stack([grey] * bands, 1))
    more = ("--config", place / "camera.toml", "--full-scale", 4095)
    assert rsvib("run", tmp_path / "bands.npy", tmp_path / "out", *more, "--output", "restored.npy") == 0
    assert read_stack_info(tmp_path / "out" / "restored.npy").shape == (4, bands, *grey.shape[1:])
    assert read_manifest(tmp_path / "out" / "manifest.json").totals()["restored"] == 1
    assert rsvib("detect", tmp_path / "bands.npy", "--out", tmp_path / "found", *more) == 0
    assert rsvib("motion", tmp_path / "bands.npy", "--out", tmp_path / "motion.csv", *more, "--search", 6) == 0


def test_files_that_are_no_vibration_are_refused(place, tmp_path, capsys):
    expected = "expected format 'rsvib vibration' of version 1"
    for vibration, message in (("manifest.json", expected), ("windows.png", "not a file of DetectionResult.save")):
        options = ("--config", place / "camera.toml", "--vibration", place / "out" / vibration)
        assert message in refused(capsys, "restore", place / "frames.tif", tmp_path / "o.tif", *options)
    assert not (tmp_path / "o.tif").exists()


def test_a_required_axis_that_is_not_reliable_is_exit_code_3(place, tmp_path, capsys):
    """In one window or in several; the results are those without the option. Other windows may be reliable."""
    options, found = ("--config", place / "camera.toml"), tmp_path / "found"
    assert rsvib(*command(place, found, "--require-reliable", "x,y")) == 0
    found = ("detect", place / "frames.tif", *options, "--overwrite", "--out", found)
    assert rsvib(*found, "--require-reliable", "x,y") == 0
    counts = tifffile.imread(place / "frames.tif")
    counts[6:] = np.random.default_rng(0).integers(0, 4095, counts[6:].shape)
    tifffile.imwrite(tmp_path / "noise.tif", counts, photometric="minisblack", metadata=None)
    capsys.readouterr()
    assert rsvib("run", tmp_path / "noise.tif", tmp_path / "out", *options, "--require-reliable", "y") == 3
    shown = capsys.readouterr()
    assert "--require-reliable: y not reliable" in shown.err
    assert "Files" in shown.out
    assert rsvib(*found, "--require-reliable", "x,roll") == 3
    motion = ("motion", place / "frames.tif[0:5]", *options, "--search", 6)
    assert rsvib(*motion, "--out", tmp_path / "motion.csv", "--require-reliable", "roll") == 3
    assert "expected axes such as x,y" in refused(capsys, *found, "--require-reliable", "z")


def test_interrupted_run_is_resumed_or_refused(place, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr("rsvib_torch.stacks.process.write_frames", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert rsvib(*command(place, out)) == 130
    assert "--resume continues" in capsys.readouterr().err
    for more in ((), ("--overwrite",)):
        error = refused(capsys, *command(place, out, *more))
        assert "a run was interrupted here after 4 windows; resume it (--resume)" in error
        assert "to start over (--overwrite does not discard finished windows)" in error
    for _ in range(2):  # the second time it is complete
        assert rsvib(*command(place, out, "--resume")) == 0
        assert "windows complete before this run: 4" in capsys.readouterr().out
    assert (out / "restored.tif").read_bytes() == (place / "out" / "restored.tif").read_bytes()
    assert (out / "manifest.json").read_bytes() == (place / "out" / "manifest.json").read_bytes()


def test_bad_frames_are_reported(place, tmp_path, capsys):
    counts = tifffile.imread(place / "frames.tif")
    counts[4] = 0
    np.save(tmp_path / "frames.npy", counts)
    arguments = ("run", tmp_path / "frames.npy", tmp_path / "out", "--config", place / "camera.toml")
    assert rsvib(*arguments) == 0
    assert "warning: 1 frame could not be used: see manifest.json" in capsys.readouterr().err
    assert read_stack_info(tmp_path / "out" / "restored.tif").shape == (FRAMES, HEIGHT, WIDTH)
    assert list(read_manifest(tmp_path / "out" / "manifest.json").bad_frames) == ["4"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--memory", "much"), "memory must be like '2GB' or '500MB', got 'much'"),
        (("--memory", "100MB"), "memory of 100 MB is too little: a window of 4 frames of 96 x 64 px takes about"),
        (("--output", "../restored.tif"), "--output must be a file name without a folder, got '../restored.tif'"),
        (("--video", "--output", "x.tif"), "--video writes .mp4, .mov, .m4v or .mkv, got --output x.tif"),
        (("--video", "--steady", "1s", "--window", 4), "--window has no effect on frames that --video follows"),
        (("--video", "--steady", "1s", "--force"), "--force has no effect on frames that --video follows"),
    ],
)
def test_errors_are_one_line_and_leave_no_files(place, tmp_path, capsys, options, message):
    assert message in refused(capsys, *command(place, tmp_path / "out", *options))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_raw_frames_behind_colour_filters_on_a_finer_grid(tmp_path):
    """In windows, with the page of the first one."""
    raw, out, config = tmp_path / "raw.tif", tmp_path / "out", tmp_path / "mosaic.toml"
    write_small(raw, frames=5)  # of a grey scene
    config.write_text(CAMERA.partition("[restoration]")[0] + MOSAIC)
    assert rsvib("run", raw, out, "--config", config, "--workers", 1, "--report") == 0
    assert read_stack_info(out / "restored.tif").shape == (2, 3, 2 * HEIGHT, 2 * WIDTH)
    written = read_stack(out / "restored.tif")[0, :, ::2, ::2].double().numpy()
    assert np.sqrt(np.mean((written - STILL)[:, 12:-12, 12:-12] ** 2)) < 0.06
    assert (out / "before_after.png").exists()
    assert "which have 2 x 2 points per px" in (out / "report.html").read_text()


def test_saturation_of_left_aligned_counts_in_a_run(place, tmp_path):
    """12 bits in 16: pixels of the count 65520 are saturated, although full scale is 65535."""
    frames = (tifffile.imread(place / "frames.tif")[:5].astype(int) * 2).clip(0, 4095) << 4
    assert (frames == 65520).mean() > 0.001
    tifffile.imwrite(tmp_path / "left.tif", frames.astype("uint16"), photometric="minisblack")
    for name, options in (("auto", ()), ("stated", ("--saturation", 65520))):
        arguments = (tmp_path / "left.tif", tmp_path / name, "--config", place / "camera.toml", "--full-scale", 65535)
        assert rsvib("run", *arguments, *options, "--method", "exact") == 0
    found, expected = (tifffile.imread(tmp_path / name / "restored.tif") for name in ("auto", "stated"))
    assert found.max() > 60000
    np.testing.assert_array_equal(found, expected)
