"""Values of options, and errors about them."""

import json
import os
import subprocess
import sys

import pytest
from program import refused, rsvib
from small_stack import CAMERA, write_small

from rsvib_torch.checks.values import fields_of
from rsvib_torch.options import COMMAND_LINE, ProcessStackOptions, StackOptions
from rsvib_torch.stacks import read_manifest


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("options")
    write_small(folder / "frames.tif", 3)
    (folder / "camera.toml").write_text(CAMERA)
    return folder


def command(place, name, *more):
    return (name, place / "frames.tif", *more, "--config", place / "camera.toml")


@pytest.mark.parametrize(("level", "stated"), [("AUTO", "auto"), ("4000", 4000 / 4095)])
def test_saturation_is_a_level_or_a_word(place, tmp_path, level, stated):
    assert rsvib(*command(place, "run", tmp_path / "out"), "--saturation", level) == 0
    options = json.loads((tmp_path / "out" / "manifest.json").read_text())["settings"]["restoration"]
    assert options["saturation"] == stated


def test_mistakes_of_a_value_name_its_sources(place, tmp_path, capsys):
    detect = ("--out", tmp_path / "out")
    error = refused(capsys, *command(place, "detect", *detect), "--row-time", "5")
    assert "camera.toml and the command line: sensor: --row-time=5 s is longer than 10 ms" in error
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(CAMERA.replace("frame_rows = 104", "frame_rows = 3"))
    error = refused(capsys, "detect", place / "frames.tif", "--config", wrong, *detect)
    assert error.startswith(f"rsvib: error: {wrong}: sensor: exposure_rows=6 exceeds")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("calibrate", "--frequency", -5), "--frequency must be larger than 0"),
        (("calibrate", "--by-motion", "--frame-rate", 90, "--row-time", "10us"), "give --row-time twice"),
        (("calibrate", "--by-motion", "--frame-rate", 90, "--exposure", 20), "--exposure=20 s exceeds the frame"),
        (("detect", "--config", "{}", "--out", "d", "--full-scale", 0), "--full-scale must be larger than 0"),
        (("motion", "--config", "{}", "--out", "m.csv", "--knot-rows", 1), "--knot-rows must be at least 4"),
        (
            ("restore", "o.tif", "--config", "{}", "--vibration", "{}", "--focal-length", 900),
            "--focal-length is for --motion, a recording",
        ),
        (
            ("run", "r", "--config", "{}", "--method", "exact", "--joint", 4),
            "--joint must be at most 3, the number of frames",
        ),
    ],
)
def test_errors_name_options_instead_of_arguments_of_python(place, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    name, *more = (str(one).format(place / "camera.toml") for one in arguments)
    scale = () if "--full-scale" in more else ("--full-scale", 4095)
    assert message in refused(capsys, name, place / "frames.tif", *more, *scale)


def test_a_missing_input_is_reported_before_an_existing_output(tmp_path, capsys):
    (tmp_path / "camera.toml").write_text("")
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "tones.csv").write_text("")
    camera = ("--row-time", "100us", "--exposure", "1ms", "--frame-rate", 90)
    for arguments in (("init", "--out", tmp_path / "camera.toml"), ("run", tmp_path / "results")):
        error = refused(capsys, arguments[0], tmp_path / "none.tif", *arguments[1:], *camera)
        assert error == f"rsvib: error: {tmp_path / 'none.tif'} does not exist\n"


def test_a_complete_run_that_is_resumed_has_the_same_answer_and_output(place, tmp_path, capsys):
    arguments = command(place, "run", tmp_path / "out", "--json")
    assert rsvib(*arguments) == 0
    answer = json.loads(capsys.readouterr().out)
    written = (tmp_path / "out" / "restored.tif").stat()
    assert rsvib(*arguments, "--resume") == 0
    assert json.loads(capsys.readouterr().out) == answer
    assert (tmp_path / "out" / "restored.tif").stat().st_mtime_ns == written.st_mtime_ns


def test_a_complete_run_writes_tables_with_another_unit_or_in_place_of_those_of_another_run(
    place, tmp_path, monkeypatch
):
    def stop(*_, **__):
        raise KeyboardInterrupt

    arguments, table = command(place, "run", tmp_path / "out"), tmp_path / "out" / "tones.csv"
    assert rsvib(*arguments) == 0
    assert rsvib(*arguments, "--resume", "--pixel-size", "5um") == 0
    assert "amplitude_um" in table.read_text()
    with monkeypatch.context() as patch:
        patch.setattr("rsvib_torch.commands.answers.write_detection", stop)
        assert rsvib(*arguments, "--overwrite") == 130
    assert "amplitude_um" in table.read_text()
    assert rsvib(*arguments, "--resume") == 0
    assert "amplitude_um" not in table.read_text()


def test_marked_options_of_process_stack_are_those_of_run_and_restore(place, tmp_path, capsys):
    """And a run is resumed only with the same values of those on which its result may depend."""
    fields = fields_of(ProcessStackOptions)
    marked = {f"--{name}" for name, field in fields.items() if field.json_schema_extra == COMMAND_LINE}
    assert marked == {"--memory", "--workers", "--window", "--resume"}
    for name in ("run", "restore"):
        assert rsvib(name, "--help") == 0
        assert marked <= set(capsys.readouterr().out.split())
    assert rsvib(*command(place, "run", tmp_path / "out"), "--workers", 1) == 0
    manifest = read_manifest(tmp_path / "out" / "manifest.json")
    unstored = {"memory", "workers", "motion"}  # ``given`` stands for detections and for a motion
    assert manifest.settings.keys() == {"sensor", *fields_of(StackOptions)} - unstored


def test_a_session_that_is_stopped_before_it_begins_is_one_line(place, tmp_path, capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("rsvib_torch.stacks.process.read_windows", stop)
        assert rsvib(*command(place, "run", tmp_path / "out")) == 130
    assert capsys.readouterr().err == "rsvib: error: stopped\n"
    program = "import sys; sys.modules['rsvib_torch.commands.main'] = None\n"
    program += "import builtins, rsvib_torch.__main__ as entry\n"
    program += "def stop(name, *a): raise KeyboardInterrupt\n"
    program += "builtins.__import__ = stop\nentry.main()"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=os.environ, check=False)
    assert (ended.returncode, ended.stderr) == (130, "rsvib: error: stopped\n")
