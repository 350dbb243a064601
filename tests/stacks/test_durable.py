"""Interrupted runs on damaged disks and in hostile folders: frames are verified, links are not followed."""

import functools
import json
import os
import re
import shutil
import stat

import pytest
from small_stack import WINDOWS, process_small, write_small

from rsvib_torch.stacks.output import Journal, Sink, work_folder

KINDS = {
    "out.tif": {},
    "out.npy": {},
    "out.raw": {},
    "out.h5": {},
    "out.zarr": {},
    "frames": {},
    "skipped.npy": {"bad_frames": "skip"},
}


@pytest.fixture(scope="module", name="whole")
def process_whole(tmp_path_factory):
    """A stack, and the output of an uninterrupted run in every format."""
    folder = tmp_path_factory.mktemp("whole")
    write_small(folder / "frames.tif")
    return folder


def whole_output(whole, name):
    if not (whole / name).exists():
        process_small(whole / "frames.tif", whole / name, **KINDS[name])
    return content(whole / name)


@pytest.fixture(scope="module", name="interrupted")
def interrupt_once(whole, tmp_path_factory):
    """A function that makes a folder with an interrupted run; each format is computed once and then copied."""
    folder = tmp_path_factory.mktemp("interrupted")

    def stop(done, total):
        if done > 8:
            raise KeyboardInterrupt

    def copy(name, target):
        place = folder / name.replace(".", "_")
        if not place.exists():
            place.mkdir()
            with pytest.raises(KeyboardInterrupt):
                process_small(whole / "frames.tif", place / name, progress=stop, **KINDS[name])
        shutil.copytree(place, target, dirs_exist_ok=True)
        return work_folder(target / name)

    return copy


def content(path):
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def part_of_frame(work, name, index):
    """The file of a frame in a work folder, and the position of a pixel of the frame in it."""
    if name == "out.zarr":
        return work / name / "c" / str(index) / "0" / "0", 40
    if name == "frames":
        return work / name / f"frame_{index:04d}.png", 60
    if name == "skipped.npy":
        return work / "windows" / f"{index // 2:06d}.npy", 200
    path, size = work / name, 96 * 64 * 2
    start = {"out.npy": 128, "out.raw": 0}.get(name)
    if start is None:
        start = path.stat().st_size - 17 * size if name == "out.h5" else 256
    return path, start + index * size + 1000


def resume(whole, folder, name):
    report = process_small(whole / "frames.tif", folder / name, resume=True, **KINDS[name])
    assert content(folder / name) == whole_output(whole, name)
    assert not work_folder(folder / name).exists()
    return report.resumed


@pytest.mark.parametrize("name", KINDS)
def test_a_damaged_window_is_computed_again(whole, interrupted, tmp_path, name):
    work = interrupted(name, tmp_path)
    done = (work / "journal.jsonl").read_bytes().count(b"\n")
    path, position = part_of_frame(work, name, 3)
    data = bytearray(path.read_bytes())
    data[position] ^= 4
    path.write_bytes(data)
    assert resume(whole, tmp_path, name) == done - 1


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("out.tif", lambda path: path.unlink()),
        ("out.tif", lambda path: os.truncate(path, 30_000)),
        ("out.npy", lambda path: path.write_bytes(b"")),
        ("out.raw", lambda path: path.with_name("out.raw.json").unlink()),
        ("out.h5", lambda path: path.write_bytes(bytes(2000) + path.read_bytes()[2000:])),
        ("out.zarr", lambda path: (path / "zarr.json").unlink()),
        ("out.zarr", lambda path: shutil.rmtree(path / "c" / "2")),
        ("frames", lambda path: (path / "frame_0001.png").unlink()),
        ("frames", lambda path: (path / "frame_0001.png").rename(path / "frame_0002.png")),
        ("skipped.npy", lambda path: (path.parent / "windows" / "000001.npy").write_bytes(b"")),
    ],
)
def test_missing_and_truncated_parts_are_computed_again(whole, interrupted, tmp_path, name, damage):
    work = interrupted(name, tmp_path)
    damage(work / name)
    assert resume(whole, tmp_path, name) < WINDOWS


@pytest.mark.parametrize("name", ["out.tif", "out.raw", "out.h5", "out.zarr", "frames", "skipped.npy"])
def test_frames_are_synchronised_before_their_window_is_entered(whole, tmp_path, monkeypatch, name):
    synchronised, checked = set(), []

    def record(real, file):
        real(file)
        synchronised.add((os.fstat(file).st_ino, os.fstat(file).st_size))

    for call in ("fsync", "fdatasync"):
        monkeypatch.setattr(os, call, functools.partial(record, getattr(os, call)))
    add = Journal.add

    def check(journal, record, stored):
        for path in [journal.folder.place, *journal.folder.place.rglob("*")]:
            status = path.stat()
            if path.name not in ("lock", "journal.jsonl"):
                assert (status.st_ino, status.st_size) in synchronised, path
        checked.append(record["window"])
        add(journal, record, stored)

    monkeypatch.setattr(Journal, "add", check)
    process_small(whole / "frames.tif", tmp_path / "new" / name, **KINDS[name])
    assert checked == list(range(WINDOWS))
    assert tmp_path.stat().st_ino in {number for number, _ in synchronised}  # it contains the new folder's name


def listing(folder):
    return {str(path.relative_to(folder)): stat.S_IFMT(path.lstat().st_mode) for path in folder.rglob("*")}


def test_work_folder_that_is_a_link_is_refused(whole, tmp_path):
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "precious.txt").write_text("precious")
    work_folder(tmp_path / "out.tif").symlink_to(victim)
    before = listing(tmp_path)
    for options in ({}, {"resume": True}):
        with pytest.raises(FileExistsError, match=r"\.rsvib is a link, which no run has made; delete it, or choose"):
            process_small(whole / "frames.tif", tmp_path / "out.tif", **options)
    assert listing(tmp_path) == before


@pytest.mark.parametrize("target", ["lock", "run.json", "journal.jsonl", "out.tif"])
@pytest.mark.parametrize("link", [os.link, os.symlink])
def test_links_in_a_work_folder_are_refused(whole, interrupted, tmp_path, target, link):
    work = interrupted("out.tif", tmp_path)
    (tmp_path / "precious.txt").write_text("precious")
    (work / target).unlink()
    link(tmp_path / "precious.txt", work / target)
    before = listing(tmp_path)
    with pytest.raises(FileExistsError, match=f"{re.escape(target)} is "):
        process_small(whole / "frames.tif", tmp_path / "out.tif", resume=True)
    assert listing(tmp_path) == before
    assert (tmp_path / "precious.txt").read_text() == "precious"


def test_a_folder_of_the_user_in_place_of_the_work_folder_is_not_deleted(whole, tmp_path):
    work = work_folder(tmp_path / "out.tif")
    work.mkdir()
    (work / "precious.txt").write_text("precious")
    with pytest.raises(FileExistsError, match=r"precious\.txt was not made by a run"):
        process_small(whole / "frames.tif", tmp_path / "out.tif")
    assert listing(tmp_path) == {work.name: stat.S_IFDIR, f"{work.name}/precious.txt": stat.S_IFREG}


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs the open files of Linux")
def test_work_folder_that_is_replaced_during_a_run_is_not_followed(whole, tmp_path):
    victim, place = tmp_path / "victim", tmp_path / "place"
    for folder in (victim, place):
        folder.mkdir()
    work = work_folder(place / "out.tif")

    def replace(done, total):
        if done > 4 and not work.is_symlink():
            work.rename(place / "moved")
            work.symlink_to(victim)

    process_small(whole / "frames.tif", place / "out.tif", progress=replace)
    assert list(victim.iterdir()) == []
    assert content(place / "out.tif") == whole_output(whole, "out.tif")


def _with_value(lines, number, **values):
    changed = json.dumps({**json.loads(lines[number]), **values}).encode() + b"\n"
    return [*lines[:number], changed, *lines[number + 1 :]]


@pytest.mark.parametrize(
    "change",
    [
        lambda lines: _with_value(lines, 0, window=-1),
        lambda lines: _with_value(lines, 1, first=1),
        lambda lines: _with_value(lines, 0, written=10**30),
        lambda lines: _with_value(lines, 2, more=1),
        lambda lines: _with_value(lines, 0, digests=[]),
        lambda lines: [b"[" * 100_000 + b"\n", *lines],
        lambda lines: [lines[0], *lines],
        lambda lines: [*lines, b"{}\n"],
        lambda lines: [bytes(100) + b"\n", *lines],
    ],
)
def test_damaged_journals_are_refused_in_one_line(whole, interrupted, tmp_path, change):
    work = interrupted("out.tif", tmp_path)
    path = work / "journal.jsonl"
    path.write_bytes(b"".join(change(path.read_bytes().splitlines(keepends=True))))
    before = content(tmp_path)
    with pytest.raises(ValueError, match=r"journal\.jsonl: line \d is damaged; delete") as raised:
        process_small(whole / "frames.tif", tmp_path / "out.tif", resume=True)
    assert "\n" not in str(raised.value)
    assert content(tmp_path) == before


def test_a_line_that_was_not_completely_on_the_disk_is_ignored(whole, interrupted, tmp_path):
    work = interrupted("out.tif", tmp_path)
    with (work / "journal.jsonl").open("ab") as file:
        file.write(bytes(300) + b'"}\n')  # a file system may enlarge a file before it writes its content
    assert resume(whole, tmp_path, "out.tif") > 2


@pytest.mark.parametrize("text", ["", "[]", "[" * 100_000, '{"input": {}}', "\0"])
def test_damaged_headers_are_refused_in_one_line(whole, interrupted, tmp_path, text):
    work = interrupted("out.tif", tmp_path)
    (work / "run.json").write_text(text)
    with pytest.raises(ValueError, match=r"is damaged|cannot resume") as raised:
        process_small(whole / "frames.tif", tmp_path / "out.tif", resume=True)
    assert "\n" not in str(raised.value)


def test_run_that_stopped_after_its_output_was_moved_is_completed(whole, interrupted, tmp_path, monkeypatch):
    for name in ("out.raw", "frames"):
        interrupted(name, tmp_path)
        finish = Sink.finish

        def stop(sink, count, finish=finish):
            finish(sink, count)
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(Sink, "finish", stop)
            with pytest.raises(KeyboardInterrupt):
                process_small(whole / "frames.tif", tmp_path / name, resume=True)
        assert content(tmp_path / name) == whole_output(whole, name)
        assert resume(whole, tmp_path, name) == WINDOWS


def test_windows_are_computed_again_where_the_first_ones_and_the_output_are_missing(whole, interrupted, tmp_path):
    """The windows that are entered are not the first ones if damaged windows were computed again before."""
    work = interrupted("out.tif", tmp_path)
    lines = (work / "journal.jsonl").read_bytes().splitlines(keepends=True)
    (work / "journal.jsonl").write_bytes(b"".join(lines[1:]))
    (work / "out.tif").unlink()
    process_small(whole / "frames.tif", tmp_path / "out.tif", resume=True)
    assert content(tmp_path / "out.tif") == whole_output(whole, "out.tif")
