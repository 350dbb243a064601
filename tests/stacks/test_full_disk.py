"""Full file systems: a one-line error, no incomplete output, and the run can be resumed when there is space."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from small_stack import CONFIG, WINDOWS, process_small, write_small

TRIALS = [
    ["out.tif", 20, {}],  # its space is allocated first
    ["out.tif", 55, {}],  # enough for the frames, not for the journal
    ["out.zarr", 20, {}],
    ["out.npy", 30, {"bad_frames": "skip"}],  # windows are stored in separate files
    ["out.npy", 70, {"bad_frames": "skip"}],  # all of these fit, the stack does not
]
MORE_TRIALS = [
    [name, pages, options]
    for name, options in (
        ("out.tif", {}),
        ("out.tif", {"bad_frames": "skip"}),
        ("packed.tif", {"compression": "zlib"}),
        ("out.zarr", {}),
        ("out.h5", {}),
        ("out.raw", {}),
        ("frames", {}),
    )
    for pages in (2, 5, 9, 14, 23, 37, 52, 58, 61, 80)
]


@pytest.fixture(scope="module", name="mount")
def find_how_to_mount():
    """A command that runs a shell in a mount namespace of its own."""
    for options in ("-m", "-rm"):
        command = ["unshare", options, "sh", "-c"]
        if shutil.which("unshare") is None:
            break
        trial = subprocess.run([*command, "mount -t tmpfs -o size=64k none /mnt"], capture_output=True, check=False)
        if trial.returncode == 0:
            return command
    pytest.skip("file systems cannot be mounted here")


@pytest.fixture(scope="module", name="whole")
def process_whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    write_small(folder / "frames.tif")
    (folder / "camera.toml").write_text(CONFIG)
    return folder


def run_on_full_disks(mount, whole, folder, trials):
    for name, options in {name: options for name, _, options in trials}.items():
        if not (whole / name).exists():
            process_small(whole / "frames.tif", whole / name, **options)
    (folder / "disk").mkdir()
    shell = f'mount -t tmpfs -o size=1m,mode=755 none "{folder / "disk"}" && exec "$@"'
    program = [sys.executable, str(Path(__file__).with_name("small_disk.py"))]
    arguments = [str(whole / "frames.tif"), str(whole), str(folder / "disk"), json.dumps(trials)]
    done = subprocess.run(
        [*mount, shell, "sh", *program, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    for trial, run in zip(trials, found["runs"], strict=True):
        if run["message"] != "done":
            assert "No space left on device" in run["message"], trial
            assert "\n" not in run["message"]
            assert not run["output_exists"], trial
            assert set(run["files"]) <= {f".{trial[0]}.rsvib"}, trial
            kept = f"{run['resumed']} windows are complete, resume the run to continue"
            assert (kept in run["message"]) == (run["resumed"] > 0), trial
        assert run["same"], trial
        companion = {"out.raw.json"} if trial[0] == "out.raw" else set()
        assert set(run["names"]) == {trial[0], f"{trial[0]}.manifest.json"} | companion, trial
    return found, done.stderr


def test_full_disk_is_a_one_line_error_and_the_run_can_be_resumed(mount, whole, tmp_path):
    found, shown = run_on_full_disks(mount, whole, tmp_path, TRIALS)
    runs = found["runs"]
    assert all(run["message"] != "done" for run in runs)
    assert runs[0]["files"] == []
    assert runs[0]["resumed"] == 0 < runs[1]["resumed"] < WINDOWS
    assert 0 < runs[2]["resumed"] < WINDOWS
    assert 0 < runs[3]["resumed"] < WINDOWS
    assert runs[4]["resumed"] == WINDOWS
    assert found["codes"] == [2, 0]
    assert {"out.zarr", "manifest.json"} < set(found["names"])
    lines = [line for line in shown.splitlines() if "DeprecationWarning" not in line and line[:1] != " "]  # numcodecs
    assert [line.startswith("rsvib: error: ") for line in lines] == [True]


@pytest.mark.slow
def test_disks_that_are_full_at_different_moments(mount, whole, tmp_path):
    found, _ = run_on_full_disks(mount, whole, tmp_path, MORE_TRIALS)
    stopped = [run["resumed"] for run in found["runs"] if run["message"] != "done"]
    assert len(stopped) > len(MORE_TRIALS) // 2
    assert len(set(stopped)) > 3
