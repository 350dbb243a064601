"""Every command ends with its answer, as text, as JSON or not at all; help, completion, progress, existing results."""

import inspect
import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import typer
from program import refused, rsvib
from refusals import refuses
from truth import Motion, recorded

import rsvib_torch as rsv
from rsvib_torch.commands import main, terminal
from rsvib_torch.execution.progress import listening, steps

PROGRAM = Path(sys.executable).with_name("rsvib")
TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=200)
CONFIG = """
[sensor]
row_time = 1e-4
exposure_rows = 6
frame_rows = 200
full_scale = 4095
"""
COMMANDS = ("run", "detect", "restore", "motion", "calibrate")


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    """Frames of a vibration, of one whose tone along y is blind, of a longer stack, and of a flickering light."""
    folder = tmp_path_factory.mktemp("answers")
    (folder / "camera.toml").write_text(CONFIG)
    steady = Motion((1.6, 1.1), (71.0, 113.0), (0.6, -1.2))
    blind, still = replace(steady, frequency=(71.0, 49.5)), steady.scaled(0.0)
    for name, motion, count in (("frames", steady, 2), ("blind", blind, 2), ("long", steady, 7), ("still", still, 2)):
        frames = recorded((192, 128), TIMING, motion, count, 0.003, seed=3).clamp(0, 1)
        rsv.write_stack(folder / f"{name}.tif", frames, dtype="uint16", full_scale=4095)
    light = 0.4 + 0.2 * torch.cos(2 * torch.pi * torch.arange(512) / 64)
    rsv.write_stack(folder / "led.png", light[None, :, None].expand(1, 512, 16), dtype="uint16", full_scale=65535)
    long = (folder / "long.tif", "--config", folder / "camera.toml", "--quiet")
    assert rsvib("detect", *long, "--out", folder / "found") == 0
    assert rsvib("motion", *long, "--out", folder / "m.csv") == 0
    return folder


@pytest.fixture(name="config")
def config_option(place):
    return "--config", place / "camera.toml"


def sections(text):
    """Lines of the answer by the title above them."""
    found, title = {}, None
    for line in text.splitlines():
        if line and not line.startswith(" "):
            title = line
            found[title] = []
        elif line:
            found[title].append(line[2:])
    return found


def test_the_answer_of_run_names_everything(place, config, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert rsvib("run", place / "frames.tif", "out", *config) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    answer = sections(shown.out)
    assert list(answer) == ["Vibration in frames.tif", "Restoration", "Files (open before_after.png first)", "Next"]
    vibration = answer["Vibration in frames.tif"]
    assert vibration == rsv.DetectionResult.load("out/vibration.json").summary().splitlines()
    assert re.match(r"x     1\.(59|60)\d* ± 0\.0\d+( \(± 0\.\d+\))?  +7[01]\.", vibration[1])
    assumed = " ".join(" ".join(line for line in vibration if not re.match("[xy]:", line)).split())
    assert "assumed: frame_rows, readout direction, scan axis and order of the frames: two frames cannot" in assumed
    assert "assumed: frame_rows=200: if it is stated 1 % too large, this changes x 7" in assumed
    assert re.fullmatch(r"2 frames in 1 window, 1 restored, \S+ s per frame", answer["Restoration"][0])
    assert re.fullmatch(r"estimated improvement \+\d+\.\d dB", answer["Restoration"][1])
    assert len(answer["Restoration"]) == 2
    names = " ".join(answer["Files (open before_after.png first)"]).removeprefix("out: ").replace(",", "").split()
    assert sorted(names) == sorted(path.name for path in Path("out").iterdir())
    assert names[0] == "before_after.png"
    command = shlex.split(answer["Next"][1])
    assert command[0] == "rsvib"
    assert rsvib(*command[1:]) == 0  # the command that is suggested works
    assert list(sections(capsys.readouterr().out))[2] == "Files (open report.html first)"


def test_an_axis_that_is_left_unchanged_is_named_with_the_reason(place, config, tmp_path, capsys):
    assert rsvib("run", place / "blind.tif", tmp_path / "out", *config) == 0
    answer = sections(capsys.readouterr().out)
    reasons = answer["Vibration in blind.tif"]
    assert "x: reliable" in reasons
    assert "y: not reliable:" in reasons
    assert any("nearly blind" in line for line in reasons)
    assert answer["Restoration"][0].startswith("2 frames in 1 window, 1 restored")
    assert "y unchanged: its vibration is not reliable, see the reasons above" in answer["Restoration"]
    assert "follow the remedies that the reasons above name" in answer["Next"]


WORK = {  # arguments of a command, results that it does not replace, and keys of its answer
    "run": ("frames.tif {}", "manifest.json restored.tif tones.csv", "detection restoration"),
    "detect": ("long.tif --out {}", "vibration.json tones.csv", "detection"),
    "motion": ("long.tif --out {}/m.csv", "m.csv", "motion columns"),
    "calibrate": ("led.png --frequency 1000 --out {}/c.toml", "c.toml", "calibration"),
    "restore": ("long.tif {}/r.tif --vibration found/vibration.json", "r.tif", "detection restoration"),
    "restore by a recording": (
        "long.tif {}/r.tif --motion m.csv --unit px --offset 0",
        "r.tif",
        "alignment restoration",
    ),
}


@pytest.fixture(name="command", params=WORK)
def make_command(request, place, tmp_path, monkeypatch):
    """Arguments of a command, its results, and the keys of its answer."""
    monkeypatch.chdir(place)
    arguments, results, keys = WORK[request.param]
    config = () if request.param == "calibrate" else ("--config", "camera.toml")
    return (request.param.split()[0], *arguments.format(tmp_path).split(), *config), results.split(), set(keys.split())


def test_json_is_the_only_output(command, capsys):
    arguments, _, keys = command
    assert rsvib(*arguments, "--json") == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    answer = json.loads(shown.out)
    assert answer.keys() == keys | {"command", "files", "open_first", "next_steps", "notes", "warnings"}
    assert answer["command"] == arguments[0]
    assert answer["open_first"] == answer["files"][0]
    assert all(Path(file).exists() for file in answer["files"])
    assert answer["warnings"] == []
    assert len(shown.out) < 20_000
    if arguments[0] == "run":
        assert len(answer["detection"]["assumptions"]) >= 3
        assert answer["detection"]["sensitivity"].keys() >= {"amplitude_by_frame_rows", "frequency_by_row_time"}
        assert answer["detection"]["reliable"] == [True, True]
        assert answer["detection"]["vibration"]["amplitude"][0][0] == pytest.approx(1.6, rel=0.01)
    if "restoration" in keys:
        assert answer["restoration"]["outcomes"] == {"helps": 1}
        assert not any(answer["restoration"]["left_alone"].values())


def test_existing_results_are_not_replaced(command, tmp_path, capsys):
    arguments, results, _ = command
    for result in results:
        (tmp_path / result).write_text("precious")
        error = refused(capsys, *arguments)
        assert error == (
            f"rsvib: error: results exist already in {tmp_path}: {result}; choose another name, or replace them with "
            "--overwrite\n"
        )
        assert (tmp_path / result).read_text() == "precious"
        assert [path.name for path in tmp_path.iterdir()] == [result]
        (tmp_path / result).unlink()


def test_overwrite_replaces_all_results_of_the_earlier_run(place, config, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    assert rsvib("run", place / "long.tif", out, *config, "--window", 3) == 0
    assert (out / "windows.png").exists()
    assert rsvib("run", place / "frames.tif", out, *config, "--overwrite") == 0
    names = {path.name for path in out.iterdir()}
    assert {"vibration.json", "notes.txt"} <= names
    assert "windows.png" not in names


@pytest.mark.parametrize("command", COMMANDS)
def test_help_contains_every_text_and_examples(capsys, monkeypatch, command):
    assert rsvib(command, "-h") == 0
    text = capsys.readouterr().out
    assert rsvib(command, "--help") == 0
    assert capsys.readouterr().out == text
    words = " ".join(text.split())
    function = next(entry.callback for entry in main.app.registered_commands if entry.name == command)
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        info = next(part for part in parameter.annotation.__metadata__ if hasattr(part, "help"))
        assert info.help.replace(" ", "") in words.replace(" ", ""), parameter.name  # lines also end at hyphens
    for paragraph in inspect.getdoc(function).split("\n\n"):
        assert " ".join(paragraph.split()) in words
    examples = text.partition("Examples:\n")[2].replace("\\\n", " ").strip().splitlines()
    assert examples
    group = typer.main.get_command(main.app)
    for example in examples:
        program, name, *arguments = shlex.split(example)
        assert (program, name) == ("rsvib", command)
        group.commands[name].make_context(name, arguments)  # raises an error for options that do not exist
    assert max(map(len, text.splitlines())) <= 100


@pytest.mark.parametrize("module", ["rsvib_torch", "rsvib_torch.commands.main"])
def test_modules_that_are_the_program(module):
    command = [sys.executable, "-m", module, "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == f"rsvib {rsv.__version__}\n"


def test_shell_completion():
    environment = os.environ | {"_RSVIB_COMPLETE": "complete_bash", "COMP_WORDS": "rsvib re", "COMP_CWORD": "1"}
    done = subprocess.run([PROGRAM], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["restore"]


def test_progress_is_shown_in_terminals_only(monkeypatch, capsys):
    with terminal.working("restoring"):
        steps(2, "frames")()
    assert capsys.readouterr() == ("", "")
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a terminal
    with terminal.working("restoring frames.tif", counts=True) as progress:
        progress(10, 100)
    assert "restoring frames.tif (frames)" in capsys.readouterr().err


def test_long_operations_report_their_progress(place):
    """Each loop begins at 0 and ends at its number of steps."""
    reported = []

    def units(work):
        reported.clear()
        with listening(lambda *state: reported.append(state)):
            result = work()
        begun = [unit for done, _, unit in reported if done == 0]
        assert begun == [unit for done, total, unit in reported if done == total]
        return result, set(begun)

    frames, found = units(lambda: rsv.read_stack(place / "long.tif"))
    assert found == {"frames"}
    detection, found = units(lambda: rsv.detect_vibration(frames, TIMING))
    assert found == {"pairs", "groups"}
    for method, unit in (("exact", "frames"), ("banded", "chunks"), ("richardson-lucy", "iterations")):
        restored, found = units(lambda m=method: rsv.restore(frames, TIMING, detection, method=m, check=False))
        assert unit in found
    _, found = units(lambda: rsv.judge_restoration(frames, restored, TIMING, detection))
    assert found == {"pairs of frames"}
    far = rsv.Vibration(1.0, 50.0, image_motion=(9e3, 0.0))  # no pair has anything in common
    _, found = units(lambda: refuses(lambda: rsv.judge_restoration(frames, frames, TIMING, far), "nothing in common"))
    assert found == {"pairs of frames"}


def test_warnings_are_in_the_json_and_printed_quietly(place, config, tmp_path, capsys):
    warning = "no vibration was found that can be removed: the frames are written unchanged"
    for option in ("--json", "-q"):
        assert rsvib("run", place / "still.tif", tmp_path / option, *config, option, "--report") == 0
        shown = capsys.readouterr()
        assert shown.err == f"rsvib: warning: {warning}\n"
        assert shown.out == "" if option == "-q" else json.loads(shown.out)["warnings"] == [warning]
    assert rsvib("run", place / "none.tif", tmp_path / "c", *config, "-q") == 2
    assert capsys.readouterr().err.count("\n") == 1
