"""Outputs that are, contain or lie in an input are refused under every name."""

import os
import stat
from pathlib import Path

import pytest
import torch
from small_stack import process_small, write_small

import rsvib_torch as rsv
from rsvib_torch.files.atomic import check_outputs


@pytest.fixture(name="place")
def make_place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pngs" / "deep").mkdir(parents=True)
    for name in ("frames.tif", "other.tif", "pngs/a.png"):
        (tmp_path / name).write_text(name)
    os.link("frames.tif", "hard.tif")
    os.link("pngs/a.png", "hard.png")
    os.symlink("frames.tif", "link.tif")
    os.symlink("missing.tif", "dangling.tif")
    os.symlink("pngs", "linked")
    os.symlink("other.tif", "pngs/b.tif")
    os.symlink("../other.tif", "pngs/c.tif")
    return tmp_path


@pytest.mark.parametrize(
    ("output", "source", "reason"),
    [
        ("frames.tif", "frames.tif", "it is the input "),
        ("link.tif", "frames.tif", "it is the input "),
        ("frames.tif", "link.tif", "it is the input "),
        ("hard.tif", "frames.tif", "it is the input "),
        ("missing.tif", "dangling.tif", "it is the input "),
        ("linked", "pngs", "it is the input "),
        ("pngs/new.tif", "pngs", "it lies inside the input "),
        ("linked/deep/new.tif", "pngs", "it lies inside the input "),
        ("pngs/b.tif", "pngs", "it lies inside the input "),
        ("hard.png", "pngs", "the same file as pngs/a.png of the input"),
        ("other.tif", "pngs", "the same file as pngs/c.tif of the input"),
        ("pngs", "pngs/a.png", "it contains the input"),
        (".", "pngs", "it contains the input"),
    ],
)
def test_outputs_that_change_an_input_are_refused(place, output, source, reason):
    with pytest.raises(ValueError, match=reason) as raised:
        check_outputs(["new.tif", output], [source])
    message = str(raised.value)
    assert message.startswith(f"cannot write {output}: ")
    assert source in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("output", "source"),
    [("other.tif", "frames.tif"), ("new.tif", "pngs"), ("frames.tif", "pngs"), ("pngs/x.tif", "pngs/a.png")],
)
def test_other_outputs_are_accepted(place, output, source):
    check_outputs([output], [source])
    check_outputs([Path(output).absolute()], [source], folder="out")


def test_folder_of_results_may_contain_an_input_file_but_not_an_input_folder(place):
    check_outputs(["restored.tif"], ["frames.tif"], folder=".")
    for folder in ("pngs", "pngs/out", "."):
        with pytest.raises(ValueError, match=f"cannot write into {folder}: .* choose another folder"):
            check_outputs([], ["pngs"], folder=folder)


def test_outputs_must_differ(place):
    for one, other in (("new.tif", "pngs/../new.tif"), ("frames.tif", "hard.tif"), ("out", "out/a.json")):
        with pytest.raises(ValueError, match=r"cannot write .* and .*; choose two names"):
            check_outputs([one, other], [])


@pytest.mark.parametrize(("name", "linked"), [("out.tif", True), ("out.h5", False), ("out", True)])
def test_pipes_are_not_replaced(tmp_path, name, linked):
    """A device or pipe in the place of an output stays as it is, and nothing is added to its folder."""
    source, pipe, output = tmp_path / "frames.tif", tmp_path / "pipe", tmp_path / "place" / name
    write_small(source)
    output.parent.mkdir()
    os.mkfifo(pipe)
    output.symlink_to(pipe) if linked else os.mkfifo(output)
    for write in (
        lambda: process_small(source, output),
        lambda: process_small(source, output, resume=True),
        lambda: process_small(source, tmp_path / "new.tif", manifest=output),
        lambda: rsv.write_stack(output, torch.rand(2, 8, 8)),
    ):
        with pytest.raises(OSError, match="device, pipe or socket; choose another name") as raised:
            write()
        assert "\n" not in str(raised.value)
    assert os.listdir(output.parent) == [name]
    assert output.is_symlink() == linked
    assert stat.S_ISFIFO(output.stat().st_mode)
    assert not (tmp_path / "new.tif").exists()
