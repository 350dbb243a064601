"""Errors of the program that no check foresaw, names of files with control characters, and figures that fail."""

import json
import os
import subprocess
import sys
import warnings

import pytest
from program import refused, rsvib
from small_stack import CONFIG, TIMING, write_small

from rsvib_torch import process_stack
from rsvib_torch.commands.shared_options import check_new
from rsvib_torch.commands.terminal import current_output, running
from rsvib_torch.io import formats
from rsvib_torch.text import printable

ONE_WINDOW = CONFIG.partition("[stack]")[0]


@pytest.fixture
def camera(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "camera.toml").write_text(ONE_WINDOW)
    write_small(tmp_path / "frames.tif", 3)
    return ["--config", "camera.toml"]


@pytest.fixture
def failing(tmp_path, monkeypatch):
    """Makes a file whose format has a reader that raises an error, after a warning."""

    def make(error, warning=None):
        def fail(_):
            if warning is not None:
                warnings.warn(warning, UserWarning, stacklevel=1)
            raise error

        monkeypatch.setitem(formats.FORMATS, ".fail", formats.StackFormat("failing", (".fail",), fail))
        (tmp_path / "frames.fail").write_bytes(b"")
        return tmp_path / "frames.fail"

    return make


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ZeroDivisionError("division by zero"), "unexpected ZeroDivisionError: division by zero"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "not enough memory"),
    ],
)
def test_unforeseen_errors_are_one_line(error, line, camera, failing, capsys):
    failing(error)
    assert refused(capsys, "detect", "frames.fail", "--out", "found", *camera).startswith(f"rsvib: error: {line}")
    assert rsvib("detect", "frames.fail", "--out", "found", "--debug", *camera) == 2
    shown = capsys.readouterr().err
    assert "Traceback (most recent call last)" in shown
    assert shown.splitlines()[-1].startswith(f"rsvib: error: {line}")


def test_warnings_are_one_line(camera, failing, capsys):
    failing(ValueError("stopped here"), "the displacement within a row time\nis large")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert rsvib("run", "frames.fail", "out", *camera) == 2
    assert capsys.readouterr().err == (
        "rsvib: warning: the displacement within a row time is large\nrsvib: error: stopped here\n"
    )


def test_functions_raise_errors_of_the_program_unchanged(tmp_path, failing):
    with pytest.raises(KeyError, match="row"):
        process_stack(failing(KeyError("row")), tmp_path / "b.npy", TIMING)


def test_names_of_files_are_escaped_and_kept(camera, capsysbinary):
    name = os.fsdecode(b"a\xff\xfe it's $HOME" + "red\x1b[31m line\nbreak \u202etxt".encode())
    os.rename("frames.tif", f"{name}.tif")
    assert rsvib("run", f"{name}.tif", f"{name} results", "--output", f"{name} new.tif", *camera) == 0
    text, errors = capsysbinary.readouterr()
    assert os.path.isfile(os.path.join(f"{name} results", f"{name} new.tif"))
    for shown in (text, errors):
        lines = shown.decode()  # UTF-8
        assert printable(lines, lines=True) == lines
    assert printable(name) in text.decode().splitlines()[0]
    assert rsvib("detect", f"{name}.tif", "--out", "found", "--json", *camera) == 0
    printed = capsysbinary.readouterr().out
    assert printed.isascii()
    answer = json.loads(printed)
    assert answer["open_first"] == "found/offsets.png"
    assert all(printable(step, lines=True) == step for step in answer["next_steps"])
    assert rsvib("detect", f"{name}.missing.tif", "--out", "other", *camera) == 2
    assert capsysbinary.readouterr().err.count(b"\n") == 1


def test_a_too_long_name_leaves_nothing(camera, capsys):
    before = sorted(os.listdir())
    for output in ("x" * 245 + ".tif", "x" * 400 + ".tif"):
        assert "its name has" in refused(capsys, "run", "frames.tif", "results", "--output", output, *camera)
    assert sorted(os.listdir()) == before


def test_links_without_target_are_not_replaced_and_names_are_shown_as_they_are(tmp_path):
    (tmp_path / "out.tif").symlink_to(tmp_path / "none.tif")
    with pytest.raises(FileExistsError, match=r"out.tif; choose another name, or replace them with --overwrite"):
        check_new([tmp_path / "out.tif"], overwrite=False, inputs=[])
    with running(["a\u202eb\x1b.tif"]):
        assert current_output().command == r"rsvib 'a\u202eb\x1b.tif'"


def test_an_answer_whose_reader_has_ended_is_an_error_in_one_line():
    reader, writer = os.pipe()
    os.close(reader)
    try:
        command = [sys.executable, "-m", "rsvib_torch", "cameras", "iphone"]
        done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    finally:
        os.close(writer)
    message = "the answer cannot be written to standard output (Broken pipe); the files are complete"
    assert (done.returncode, done.stderr) == (2, f"rsvib: error: {message}\n")
