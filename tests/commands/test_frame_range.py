"""NAME[START:END]: every command that reads frames uses a part of them."""

import numpy as np
import pytest
import tifffile
import torch
from program import refused, rsvib
from small_stack import CAMERA, draw_counts

import rsvib_torch as rsv


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("range")
    counts = draw_counts(12)
    tifffile.imwrite(folder / "frames.tif", counts, photometric="minisblack", metadata=None)
    tifffile.imwrite(folder / "part.tif", counts[5:9], photometric="minisblack", metadata=None)
    (folder / "camera.toml").write_text(CAMERA)
    camera = ("--config", folder / "camera.toml")
    assert rsvib("detect", folder / "part.tif", *camera, "--out", folder / "found") == 0
    return folder


@pytest.mark.parametrize(
    ("name", "arguments", "output"),
    [
        ("detect", ("--out", "{}/out"), "out/vibration.json"),
        ("run", ("{}/out",), "out/restored.tif"),
        ("restore", ("{}/r.tif", "--vibration", "found/vibration.json"), "r.tif"),
        ("motion", ("--out", "{}/m.csv", "--search", "6"), "m.csv"),
        ("live", ("--out", "{}/live.mkv", "--window", "3"), "live.mkv"),
    ],
)
def test_a_part_is_used_like_a_file_that_holds_nothing_else(place, tmp_path, monkeypatch, name, arguments, output):
    """The time origin is frame 5."""
    monkeypatch.chdir(place)
    written = []
    for frames in ("frames.tif[5:9]", "part.tif"):
        out = tmp_path / frames
        out.mkdir()
        given = (part.format(out) for part in arguments)
        assert rsvib(name, frames, *given, "--config", "camera.toml") == 0
        is_video = output.endswith("mkv")  # a file has the time of writing
        written.append(rsv.read_stack(out / output).numpy() if is_video else (out / output).read_bytes())
    np.testing.assert_array_equal(*written)


def test_stated_start_times_are_those_of_the_part(place, tmp_path):
    starts = [104e-4 * frame + 3e-3 * (frame > 6) for frame in range(12)]
    config = tmp_path / "camera.toml"
    config.write_text(CAMERA.replace("frame_rows = 104", f"frame_rows = 104\nframe_start_times = {starts}"))
    arguments = ("--config", config, "--out", tmp_path / "found")
    assert rsvib("detect", place / "frames.tif[5:9]", *arguments) == 0
    stored = rsv.DetectionResult.load(tmp_path / "found" / "vibration.json").timing.frame_start_times
    assert list(stored) == pytest.approx([start - starts[5] for start in starts[5:9]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("5:90", "frames.tif: frames 5:90 of a stack of 12 frames; expected START:END with START < END <= 12"),
        ("12:", "frames.tif: frames 12: of a stack of 12 frames"),
    ],
)
def test_wrong_ranges_are_refused_in_one_line(place, tmp_path, capsys, text, message):
    arguments = ("--config", place / "camera.toml")
    error = refused(capsys, "detect", place / f"frames.tif[{text}]", "--out", tmp_path / "found", *arguments)
    assert message in error
    assert not (tmp_path / "found").exists()


def test_part_of_a_stack_in_python(place):
    frames = rsv.read_stack(f"{place / 'frames.tif'}[5:9]", full_scale=4095)
    assert torch.equal(frames, rsv.read_stack(place / "part.tif", full_scale=4095))
    assert rsv.read_stack_info(f"{place / 'frames.tif'}[5:]").shape[0] == 7


def test_a_file_whose_name_looks_like_a_part_is_read_as_a_whole(place, tmp_path):
    folder = tmp_path / "frames[0:2]"
    folder.mkdir()
    for index, frame in enumerate(tifffile.imread(place / "part.tif")):
        tifffile.imwrite(folder / f"{index}.tif", frame)
    assert rsv.read_stack_info(folder).shape[0] == 4
