"""Interrupted runs: no frame is missing, repeated or incomplete after they are resumed."""

import itertools
import json
import os
import random
import resource
import signal
import threading
import time

import numpy as np
import pytest
import tifffile
import torch
from small_stack import CONFIG, FRAMES, OPTIONS, WINDOWS, fork_server, process_small, write_small

from rsvib_torch.commands.main import run_command
from rsvib_torch.stacks import read_manifest
from rsvib_torch.stacks.output import work_folder

_FILE_CALLS = ("write", "pwrite", "replace", "fsync", "fdatasync", "ftruncate", "unlink", "mkdir", "rmdir", "rename")


@pytest.fixture(scope="module", name="forks")
def start_fork_server():
    return fork_server()


@pytest.fixture(scope="module", name="whole")
def process_whole(tmp_path_factory):
    """A stack and the output of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("whole")
    write_small(folder / "frames.tif")
    for name in ("out.tif", "out.npy"):
        process_small(folder / "frames.tif", folder / name)
    return folder


@pytest.fixture(scope="module", name="whole_zarr")
def process_whole_zarr(whole):
    """The same, with Zarr output."""
    process_small(whole / "frames.tif", whole / "out.zarr")
    return whole


def _count_file_calls(die_at):
    """Kill this process with SIGKILL at its n-th call that changes a file; returns the number of calls so far."""
    count = itertools.count()
    lock = threading.Lock()
    done = [0]

    def wrap(real):
        def call(*args, **kwargs):
            with lock:
                done[0] = next(count) + 1
                if done[0] == die_at:
                    os.kill(os.getpid(), signal.SIGKILL)
            return real(*args, **kwargs)

        return call

    for name in _FILE_CALLS:
        setattr(os, name, wrap(getattr(os, name)))
    return done


def _run(source, sink, options, die_at, counted):
    torch.set_num_threads(1)
    done = _count_file_calls(die_at)
    process_small(source, sink, **options)
    if counted is not None:
        counted.value = done[0]


def run_in_process(forks, source, sink, *, die_at=0, seconds=None, counted=None, **options):
    """Process the stack in a separate process, which is killed at a file call or after some time."""
    process = forks.Process(target=_run, args=(source, sink, options, die_at, counted))
    process.start()
    process.join(timeout=seconds)
    if seconds is not None and process.exitcode is None:
        process.kill()
    process.join(timeout=60)
    return process.exitcode


def content(path):
    """All files below a path."""
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    return {str(file.relative_to(path.parent)): file.read_bytes() for file in files}


def check_whole(whole, folder, name):
    """The result is identical to that of the uninterrupted run, and there are no other files."""
    assert content(folder / name) == content(whole / name)
    manifest = f"{name}.manifest.json"
    assert json.loads((folder / manifest).read_text()) == json.loads((whole / manifest).read_text())
    assert {path.name for path in folder.iterdir()} == {name, manifest}


def check_interrupted(whole, folder, name):
    """A killed run has left no output, or the complete one."""
    if (folder / name).exists():
        assert content(folder / name) == content(whole / name)
    if (folder / f"{name}.manifest.json").exists():
        assert (folder / name).exists()


def kill_and_resume(forks, whole, folder, name, **how):
    folder.mkdir()
    code = run_in_process(forks, whole / "frames.tif", folder / name, **how)
    assert code in (-signal.SIGKILL, 0)
    check_interrupted(whole, folder, name)
    options = {key: value for key, value in how.items() if key not in ("die_at", "seconds")}
    report = process_small(whole / "frames.tif", folder / name, resume=True, **options)
    assert (report.frames, report.windows) == (FRAMES, WINDOWS)
    check_whole(whole, folder, name)
    return report.resumed


def test_killed_runs_resume_to_the_same_bytes(forks, whole, tmp_path):
    counted = forks.Value("i", 0)
    (tmp_path / "count").mkdir()
    assert run_in_process(forks, whole / "frames.tif", tmp_path / "count" / "out.tif", counted=counted) == 0
    total = counted.value
    assert total > 5 * WINDOWS
    resumed = [
        kill_and_resume(forks, whole, tmp_path / str(die_at), "out.tif", die_at=die_at)
        for die_at in (total // 2, total - 4)
    ]
    assert 1 < resumed[0] < WINDOWS
    assert resumed[1] == WINDOWS


@pytest.mark.slow
def test_kill_at_twenty_random_moments(forks, whole_zarr, tmp_path):
    whole = whole_zarr
    for name in ("first", "timed"):  # the first run takes longer
        (tmp_path / name).mkdir()
        start = time.perf_counter()
        assert run_in_process(forks, whole / "frames.tif", tmp_path / name / "out.tif", workers=2) == 0
        duration = time.perf_counter() - start
    choice = random.Random(6)
    resumed = []
    for trial in range(20):
        name = ("out.tif", "out.npy", "out.zarr")[trial % 3]
        moment = choice.uniform(0.05, 1.2) * duration
        resumed.append(kill_and_resume(forks, whole, tmp_path / f"{trial}", name, seconds=moment, workers=2))
    assert len(set(resumed)) > 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["out.tif", "out.zarr", "skip.npy"])
def test_kill_at_many_file_calls(forks, whole_zarr, tmp_path, name):
    whole = whole_zarr
    options = {}
    if name == "skip.npy":  # stored window by window, then assembled
        name, options = "out.npy", {"bad_frames": "skip"}
        process_small(whole / "frames.tif", whole / "skip" / "out.npy", **options)
        whole = whole / "skip"
        write_small(whole / "frames.tif")
        (whole / "out.npy").unlink()
        process_small(whole / "frames.tif", whole / "out.npy", **options)
    counted = forks.Value("i", 0)
    (tmp_path / "count").mkdir()
    assert run_in_process(forks, whole / "frames.tif", tmp_path / "count" / name, counted=counted, **options) == 0
    for die_at in {*range(1, 12, 2), *range(12, counted.value, 11), *range(counted.value - 12, counted.value + 1)}:
        kill_and_resume(forks, whole, tmp_path / f"{die_at}", name, die_at=die_at, **options)


def _command(arguments, die_at):
    torch.set_num_threads(1)
    _count_file_calls(die_at)
    assert run_command(arguments) == 0


def test_folder_of_a_command_killed_at_its_first_check_is_removed_by_the_next(forks, whole, tmp_path):
    (tmp_path / "camera.toml").write_text(CONFIG)
    arguments = ["run", str(whole / "frames.tif"), str(tmp_path / "out"), "--config", str(tmp_path / "camera.toml")]
    process = forks.Process(target=_command, args=(arguments, 2))
    process.start()
    process.join(timeout=60)
    assert process.exitcode == -signal.SIGKILL
    left = [path for path in tmp_path.iterdir() if path.name.startswith(".out.")]
    assert [path.suffix for path in left] == [".part"]
    assert run_command([*arguments, "--resume"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"camera.toml", "out"}
    assert (tmp_path / "out" / "restored.tif").read_bytes() == (whole / "out.tif").read_bytes()


@pytest.fixture(name="interrupted")
def interrupt_a_run(forks, whole, tmp_path):
    """A folder with a run that was killed."""
    write_small(tmp_path / "frames.tif")
    assert run_in_process(forks, tmp_path / "frames.tif", tmp_path / "out.tif", die_at=30) == -signal.SIGKILL
    assert work_folder(tmp_path / "out.tif").is_dir()
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


def test_damaged_journal_is_refused_and_an_incomplete_last_line_is_ignored(whole, interrupted):
    lines = work_folder(interrupted / "out.tif") / "journal.jsonl"
    good = lines.read_bytes()
    lines.write_bytes(b'{"window": 7}\n' + good)
    with pytest.raises(ValueError, match="line 1 is damaged; delete"):
        process_small(interrupted / "frames.tif", interrupted / "out.tif", resume=True)
    lines.write_bytes(good[:-30])
    report = process_small(interrupted / "frames.tif", interrupted / "out.tif", resume=True)
    assert report.resumed == good.count(b"\n") - 1
    assert (interrupted / "out.tif").read_bytes() == (whole / "out.tif").read_bytes()


def test_two_runs_cannot_write_the_same_output(forks, whole, tmp_path):
    started = forks.Process(target=_run, args=(whole / "frames.tif", tmp_path / "out.tif", {}, 0, None))
    started.start()
    while not (work_folder(tmp_path / "out.tif") / "journal.jsonl").exists():
        assert started.is_alive()
        time.sleep(0.01)
    with pytest.raises(BlockingIOError, match="another run is writing it"):
        process_small(whole / "frames.tif", tmp_path / "out.tif", resume=True)
    started.join(timeout=60)
    check_whole(whole, tmp_path, "out.tif")


def test_resuming_a_complete_run_changes_nothing(whole, tmp_path):
    process_small(whole / "frames.tif", tmp_path / "out.npy")
    before = (tmp_path / "out.npy").stat().st_mtime_ns
    report = process_small(whole / "frames.tif", tmp_path / "out.npy", resume=True)
    assert (report.resumed, report.frames) == (WINDOWS, FRAMES)
    with pytest.raises(ValueError, match=r"cannot resume: settings\.window was 3, now it is 5"):
        process_small(whole / "frames.tif", tmp_path / "out.npy", resume=True, window=5)
    assert (tmp_path / "out.npy").stat().st_mtime_ns == before


def _run_with_small_disk(source, sink, limit, message, options):
    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        process_small(source, sink, **options)
    except OSError as error:
        message.put(str(error))
    else:
        message.put("done")


def run_on_small_disk(forks, source, sink, limit, **options):
    message = forks.SimpleQueue()
    process = forks.Process(target=_run_with_small_disk, args=(source, sink, limit, message, options))
    process.start()
    process.join(timeout=60)
    assert process.exitcode == 0
    return message.get()


def test_full_disk_is_an_error_before_the_computation(forks, whole, tmp_path):
    message = run_on_small_disk(forks, whole / "frames.tif", tmp_path / "new" / "out.npy", 100_000)
    assert "File too large" in message
    assert list(tmp_path.iterdir()) == []


def test_disk_that_fills_up_keeps_complete_windows(forks, whole, tmp_path):
    # the files of single windows fit, the stack does not
    message = run_on_small_disk(forks, whole / "frames.tif", tmp_path / "out.npy", 100_000, bad_frames="skip")
    assert f"File too large; {WINDOWS} windows are complete, resume the run to continue" in message
    assert not (tmp_path / "out.npy").exists()
    report = process_small(whole / "frames.tif", tmp_path / "out.npy", bad_frames="skip", resume=True)
    assert report.resumed == WINDOWS
    assert (tmp_path / "out.npy").read_bytes() == (whole / "out.npy").read_bytes()


def test_keyboard_interrupt_keeps_complete_windows(whole, tmp_path):
    def stop(done, total):
        if done > FRAMES // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        process_small(whole / "frames.tif", tmp_path / "out.tif", progress=stop, workers=2)
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("rsvib")]
    assert not (tmp_path / "out.tif").exists()
    report = process_small(whole / "frames.tif", tmp_path / "out.tif", resume=True)
    assert 2 < report.resumed < WINDOWS
    check_whole(whole, tmp_path, "out.tif")


def test_incomplete_chunks_of_zarr_are_removed(whole_zarr, tmp_path):
    def stop(done, total):
        if done > 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        process_small(whole_zarr / "frames.tif", tmp_path / "out.zarr", progress=stop)
    chunk = next((work_folder(tmp_path / "out.zarr") / "out.zarr" / "c").iterdir())
    (chunk / "0" / "0.1003c751a7d14a53b4832d1c3c0beb81.partial").write_bytes(b"incomplete")  # as the store leaves it
    process_small(whole_zarr / "frames.tif", tmp_path / "out.zarr", resume=True)
    check_whole(whole_zarr, tmp_path, "out.zarr")


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
