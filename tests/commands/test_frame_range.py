"""--frames START:END: every command that reads frames uses a part of them."""

import json

import numpy as np
import pytest
import tifffile
import torch
from program import refused, rsvib
from small_stack import CAMERA, MOTION, draw_counts

import rsvib_torch as rsv

RANGE = ("--frames", "5:9")


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("range")
    counts = draw_counts(12)
    tifffile.imwrite(folder / "frames.tif", counts, photometric="minisblack", metadata=None)
    tifffile.imwrite(folder / "part.tif", counts[5:9], photometric="minisblack", metadata=None)
    (folder / "camera.toml").write_text(CAMERA)
    return folder


def command(place, name, *arguments):
    return (name, place / "frames.tif", *arguments, "--config", place / "camera.toml", *RANGE)


def test_detection_is_that_of_the_part(place, tmp_path):
    """Its time origin is frame 5."""
    assert rsvib(*command(place, "detect", "--out", tmp_path / "found")) == 0
    found = rsv.DetectionResult.load(tmp_path / "found" / "vibration.json")
    assert len(found.offsets.pairs) == 3
    truth = MOTION.vibration()
    torch.testing.assert_close(found.vibration.frequency[:, 0], truth.frequency[:, 0], rtol=0.02, atol=0)
    times = torch.linspace(0.0, 0.04, 200, dtype=torch.float64)
    moved = found.vibration.displacement(times) - truth.displacement(times + 5 * 104e-4)
    moved = moved - moved.mean(0)
    assert (moved.square().mean(0).sqrt() < 0.15 * torch.tensor(MOTION.amplitude)).all()


def test_stated_start_times_are_those_of_the_part(place, tmp_path):
    starts = [104e-4 * frame + 3e-3 * (frame > 6) for frame in range(12)]
    config = tmp_path / "camera.toml"
    config.write_text(CAMERA.replace("frame_rows = 104", f"frame_rows = 104\nframe_start_times = {starts}"))
    arguments = ("--config", config, "--out", tmp_path / "found", *RANGE)
    assert rsvib("detect", place / "frames.tif", *arguments) == 0
    stored = rsv.DetectionResult.load(tmp_path / "found" / "vibration.json").timing.frame_start_times
    assert list(stored) == pytest.approx([start - starts[5] for start in starts[5:9]])


def test_restored_frames_are_those_of_the_part(place, tmp_path):
    assert rsvib(*command(place, "run", tmp_path / "out")) == 0
    assert rsv.read_stack_info(tmp_path / "out" / "restored.tif").shape[0] == 4
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["input"]["name"] == "frames.tif[5:9]"
    vibration = ("--vibration", tmp_path / "out" / "vibration.json")
    assert rsvib(*command(place, "restore", tmp_path / "again.tif", *vibration)) == 0
    written = [tifffile.imread(path) for path in (tmp_path / "again.tif", tmp_path / "out" / "restored.tif")]
    np.testing.assert_array_equal(*written)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [("motion", ("--out", "{}/m.csv", "--search", "6")), ("live", ("--out", "{}/live.mkv", "--window", "3"))],
)
def test_other_commands_read_the_part(place, tmp_path, capsys, name, arguments):
    assert rsvib(*command(place, name, *(part.format(tmp_path) for part in arguments), "--json")) == 0
    answer = json.loads(capsys.readouterr().out)
    if name == "live":
        assert answer["frames"] == 4
    if name == "motion":
        times = np.loadtxt(tmp_path / "m.csv", delimiter=",", skiprows=1)[:, 0]
        assert (times[0], times[-1]) == pytest.approx((0.0, 3 * 104e-4 + 102e-4), abs=2e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("5", "expected START:END such as 100:200, 100: or :200, got '5'"),
        ("5:90", "frames.tif: frames 5:90 of a stack of 12 frames; expected START:END with START < END <= 12"),
        ("12:", "frames.tif: frames 12: of a stack of 12 frames"),
    ],
)
def test_wrong_ranges_are_refused_in_one_line(place, tmp_path, capsys, text, message):
    arguments = ("--config", place / "camera.toml", "--frames", text)
    error = refused(capsys, "detect", place / "frames.tif", "--out", tmp_path / "found", *arguments)
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
