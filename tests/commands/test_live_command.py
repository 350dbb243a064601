"""rsvib live: from a file or a video on standard input to a video or a pipe."""

import json
import os
from contextlib import contextmanager

import numpy as np
import pytest
from program import refused, rsvib
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, StackInfo, read_stack, write_stack

SIZE, COUNT = 128, 12
TIMING = SensorTiming(row_time=2e-4, exposure_rows=4, frame_rows=1 / 30 / 2e-4)
CAMERA = ("--row-time", "200us", "--exposure", "0.8ms", "--frame-rate", "30")
SCENE = draw_scene(SIZE + 80, SIZE + 80, seed=3)


@pytest.fixture(scope="module", name="clip")
def make_clip(tmp_path_factory):
    taken = take_frames(SCENE, TIMING, Motion((2.1, 1.6), (52.0, 71.0), (0.5, 1.0)), COUNT, 0.005)
    counts = np.clip(np.round(taken * 255), 0, 255).astype(np.uint8)
    path, info = tmp_path_factory.mktemp("live") / "clip.mkv", StackInfo(counts.shape, "uint8", 255.0, frame_rate=30.0)
    write_stack(path, counts, dtype="uint8", full_scale=255, like=info)
    return path


@contextmanager
def on_standard_input(path):
    """Standard input is a file, for libraries as well."""
    before = os.dup(0)
    try:
        with path.open("rb") as source:
            os.dup2(source.fileno(), 0)
            yield
    finally:
        os.dup2(before, 0)
        os.close(before)


def test_from_file_to_video(clip, tmp_path, capsys):
    out = tmp_path / "still.mkv"
    arguments = ("live", clip, *CAMERA, "--out", out, "--json")
    assert rsvib(*arguments) == 0
    shown = capsys.readouterr()
    answer = json.loads(shown.out)
    assert (answer["frames"], answer["tracked"], answer["dropped"], answer["detections"]) == (COUNT, COUNT - 3, 0, 1)
    assert answer["corrected"] == COUNT - 3
    frequency = np.array(answer["detection"]["vibration"]["frequency"])[:, 0]
    assert frequency == pytest.approx([52.0, 71.0], abs=0.1)
    assert [path.name for path in tmp_path.iterdir()] == ["still.mkv"]
    still = crop(SCENE)
    raw, restored = read_stack(clip), read_stack(out)
    assert restored.shape == raw.shape
    assert min(decibel(frame, still) for frame in restored[4:]) > max(decibel(frame, still) for frame in raw[4:]) + 6
    assert "results exist already" in refused(capsys, *arguments)


def test_from_standard_input_to_a_pipe(clip, capfdbinary):
    with on_standard_input(clip):
        assert rsvib("live", "-", *CAMERA, "--out", "-") == 0
    shown = capfdbinary.readouterr()
    assert b"not delivered by the source" not in shown.err  # frames of a pipe are as late as the pipe
    frames = np.frombuffer(shown.out, np.uint8).reshape(-1, SIZE, SIZE, 3) / 255
    assert len(frames) == COUNT
    assert decibel(frames[-1].mean(-1), crop(SCENE)) > 30
    assert f"{COUNT} frames in".encode() in shown.err


def test_a_file_that_is_no_video_on_standard_input_is_refused_in_one_line(tmp_path, capfd):
    (tmp_path / "text").write_text("no video " * 100)
    with on_standard_input(tmp_path / "text"):
        message = refused(capfd, "live", "-", *CAMERA)
    assert "standard input is not a video that can be read from a pipe: send Matroska" in message


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("none.mp4",), "none.mp4: no such file; a camera is a number or a URL"),
        (("CLIP", "--out", "still.gif"), "a live video is written to .mp4, .mov, .m4v or .mkv"),
        (("CLIP", "--out", "CLIP", "--overwrite"), "it is the input"),
        (("http://127.0.0.1:1/none",), "cannot be opened; check its number or URL"),
    ],
)
def test_wrong_options_are_refused_in_one_line(clip, arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = [str(clip) if argument == "CLIP" else argument for argument in arguments]
    assert message in refused(capsys, "live", *given, *CAMERA)
    assert list(tmp_path.iterdir()) == []
