"""Interrupted runs: no frame is missing, repeated or incomplete after they are resumed."""

import errno
import os
import resource
import shutil
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile
from attacks.small_runs import fork
from small_stack import FRAMES, OPTIONS, WINDOWS, process_small, stop_after

from rsvib_torch.io import read_stack_info
from rsvib_torch.io.array_stores import open_npy, write_npy
from rsvib_torch.io.formats import FORMATS, StackFormat
from rsvib_torch.stacks import read_manifest
from rsvib_torch.stacks.run_folder import work_folder


def process_with_limit(source, sink, limit, **options):
    """Process the stack where files have at most ``limit`` bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    process_small(source, sink, **options)


@pytest.fixture(name="interrupted")
def interrupt_a_run(whole, tmp_path):
    """A folder with a run that was interrupted."""
    shutil.copy(whole / "frames.tif", tmp_path)
    with pytest.raises(KeyboardInterrupt):
        process_small(tmp_path / "frames.tif", tmp_path / "out.tif", progress=stop_after(FRAMES // 2), workers=2)
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("rsvib")]
    assert work_folder(tmp_path / "out.tif").is_dir()
    assert not (tmp_path / "out.tif").exists()
    return tmp_path


def test_an_interrupted_run_is_not_overwritten_or_resumed_with_other_settings(interrupted):
    with pytest.raises(FileExistsError, match=r"a run was interrupted here after \d+ windows; resume it"):
        process_small(interrupted / "frames.tif", interrupted / "out.tif")
    for options, message in (
        ({"window": 4}, "settings.window was 3, now it is 4"),
        ({"detection": {**OPTIONS["detection"], "search": 7}}, "settings.detection.search was 6, now it is 7"),
        ({"restoration": {"method": "exact"}}, 'settings.restoration.method was "dewarp", now it is "exact"'),
        ({"force": True}, "settings.force was false, now it is true"),
    ):
        with pytest.raises(ValueError, match=f"cannot resume: {message}"):
            process_small(interrupted / "frames.tif", interrupted / "out.tif", resume=True, **options)
    counts = tifffile.imread(interrupted / "frames.tif")
    counts[10, 5, 5] ^= 1
    tifffile.imwrite(interrupted / "frames.tif", counts, photometric="minisblack", metadata=None)
    with pytest.raises(ValueError, match=r"cannot resume: input\.sha256_of_samples was"):
        process_small(interrupted / "frames.tif", interrupted / "out.tif", resume=True)
    assert not (interrupted / "out.tif").exists()


@pytest.mark.parametrize("change", [b"", b"{", bytes(100), "edited", "of another window", "of other settings"])
def test_a_window_whose_record_is_not_as_it_was_written_is_computed_again(interrupted, whole, change):
    folder = work_folder(interrupted / "out.tif")
    records = sorted(folder.glob("0*.json"))
    complete, content = len(records), records[1].read_bytes()
    if change == "of other settings":  # an edited file of settings changes nothing, the records have their hash
        settings = folder / "settings.json"
        settings.write_bytes(settings.read_bytes().replace(b'"window": 3', b'"window": 4'))
    else:
        edited = {"edited": content.replace(b'"restored"', b'"as taken"'), "of another window": records[0].read_bytes()}
        records[1].write_bytes(edited.get(change, change))
        complete -= 1
    report = process_small(interrupted / "frames.tif", interrupted / "out.tif", resume=True)
    assert 2 < report.resumed == complete < WINDOWS
    assert {path.name for path in interrupted.iterdir()} == {"frames.tif", "out.tif", "out.tif.manifest.json"}
    for name in ("out.tif", "out.tif.manifest.json"):
        assert (interrupted / name).read_bytes() == (whole / name).read_bytes()


def test_resuming_a_complete_run_changes_nothing(whole, tmp_path):
    process_small(whole / "frames.tif", tmp_path / "out.npy")
    before = (tmp_path / "out.npy").stat().st_mtime_ns
    report = process_small(whole / "frames.tif", tmp_path / "out.npy", resume=True)
    assert (report.resumed, report.frames) == (WINDOWS, FRAMES)
    with pytest.raises(ValueError, match=r"cannot resume: settings\.window was 3, now it is 5"):
        process_small(whole / "frames.tif", tmp_path / "out.npy", resume=True, window=5)
    assert (tmp_path / "out.npy").stat().st_mtime_ns == before


def test_a_link_to_itself_in_place_of_the_folder_of_a_complete_run_is_refused(whole, tmp_path):
    process_small(whole / "frames.tif", tmp_path / "out.npy")
    link = work_folder(tmp_path / "out.npy")
    link.symlink_to(link.name)
    with pytest.raises(FileExistsError, match="was not made by a run, it is a link"):
        process_small(whole / "frames.tif", tmp_path / "out.npy", resume=True)
    assert link.is_symlink()


def test_full_disk_is_an_error_before_the_computation(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=100_000))
    with pytest.raises(OSError, match=r"No space left on device: a run needs 418 KB, 100 KB are free"):
        process_small(whole / "frames.tif", tmp_path / "new" / "out.npy")
    assert list(tmp_path.iterdir()) == []


def test_a_format_is_one_entry_of_the_table(whole, tmp_path, monkeypatch):
    """It is read and written, and its size is that of its pixels."""
    monkeypatch.setitem(FORMATS, ".own", StackFormat("own", (".own",), open_npy, write_npy, uncompressed=True))
    process_small(whole / "frames.tif", tmp_path / "out.own")
    assert (tmp_path / "out.own").read_bytes() == (whole / "out.npy").read_bytes()
    assert read_stack_info(tmp_path / "out.own").shape[0] == FRAMES
    for uncompressed, needed in ((True, "418 KB"), (False, "209 KB")):
        form = StackFormat("own", (".own",), open_npy, write_npy, uncompressed=uncompressed)
        monkeypatch.setitem(FORMATS, ".own", form)
        monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=100_000))
        with pytest.raises(OSError, match=f"a run needs {needed}, 100 KB are free"):
            process_small(whole / "frames.tif", tmp_path / "other.own")


def test_disk_that_fills_up_keeps_complete_windows(whole, tmp_path):
    # the files of single windows fit, the stack does not
    _, message = fork(process_with_limit, whole / "frames.tif", tmp_path / "out.npy", 100_000)
    assert f"File too large; {WINDOWS} windows are complete, resume the run to continue" in message
    assert not (tmp_path / "out.npy").exists()
    report = process_small(whole / "frames.tif", tmp_path / "out.npy", resume=True)
    assert report.resumed == WINDOWS
    assert (tmp_path / "out.npy").read_bytes() == (whole / "out.npy").read_bytes()


def test_run_stops_if_the_input_is_removed_and_can_be_resumed(whole, tmp_path):
    frames = tifffile.imread(whole / "frames.tif")
    for index, frame in enumerate(frames):
        (tmp_path / "in").mkdir(exist_ok=True)
        tifffile.imwrite(tmp_path / "in" / f"{index:02d}.tif", frame, photometric="minisblack", metadata=None)

    def remove_input(done, total):
        if done == 4:
            (tmp_path / "in" / "12.tif").rename(tmp_path / "gone.tif")

    with pytest.raises(FileNotFoundError, match=r"12\.tif"):
        process_small(tmp_path / "in", tmp_path / "out.npy", progress=remove_input)
    assert not (tmp_path / "out.npy").exists()
    (tmp_path / "gone.tif").rename(tmp_path / "in" / "12.tif")
    report = process_small(tmp_path / "in", tmp_path / "out.npy", resume=True)
    assert report.resumed > 1
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), tifffile.imread(whole / "out.tif"))
    assert read_manifest(report.manifest).bad_frames == {}


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS])
def test_file_systems_without_locks_are_written_to_with_a_warning(whole, tmp_path, monkeypatch, number):
    def refuse(file, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.warns(UserWarning, match="the file system has no locks .*: start no other run with this output"):
        report = process_small(whole / "frames.tif", tmp_path / "out.tif")
    assert report.restored == report.windows
    assert (tmp_path / "out.tif").exists()
