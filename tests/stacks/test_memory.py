"""Memory limits of stacks: what does not fit is refused with the required size and a remedy that works."""

import re

import numpy as np
import psutil
import pytest
from program import refused, rsvib
from refusals import refuses
from small_stack import CAMERA, TIMING

import rsvib_torch as rsv
from rsvib_torch.io import StackInfo
from rsvib_torch.options import ProcessStackOptions
from rsvib_torch.stacks.memory import memory_limit, memory_needed, windows_at_once

LARGE = StackInfo((100, 4096, 4096), "uint16", 4095.0)
GB = 10**9


def at_once(info, window, memory, workers, device="cpu"):
    options = {"window": window, "restoration": {}, "memory": memory, "workers": workers, "device": device}
    return windows_at_once(info, ProcessStackOptions(**options))


def test_default_limit_is_three_quarters_of_what_the_process_has_and_can_get(set_free):
    set_free(4 * GB)
    used = psutil.Process().memory_info().rss
    assert memory_limit(None) == pytest.approx(0.75 * (4 * GB + used), abs=5e6)
    assert memory_limit("2GB") == 2 * GB


def test_window_that_does_not_fit_the_free_memory_is_refused(set_free):
    set_free(5 * GB)
    with pytest.raises(ValueError, match="three quarters of the memory that is free") as caught:
        at_once(LARGE, 8, None, 4)
    message = str(caught.value)
    required = re.search(r"a window of 8 frames of 4096 x 4096 px takes about ([0-9.]+) GB", message)
    assert float(required[1]) == pytest.approx(memory_needed(LARGE, 8, {}) / GB, rel=0.01)
    fitting = int(re.search(r"at most ([0-9]+) frames at once \(--window\)", message)[1])
    assert at_once(LARGE, fitting, None, 4) == 1
    refuses(lambda: at_once(LARGE, fitting + 1, None, 4), "too little")
    assert at_once(LARGE, 8, "20GB", 4) == 1


def test_frames_that_are_stored_together_count(set_free):
    set_free(100 * GB)
    info = StackInfo((100, 512, 512), "uint16", 4095.0, decoding_bytes=3 * GB)
    with pytest.raises(ValueError, match=r"store each frame separately: 3 GB are needed to decode frames"):
        at_once(info, 2, "2GB", 1)
    assert at_once(info, 2, "4GB", 1) == 1


def test_gpu_needs_less_memory_of_the_machine(set_free):
    set_free(5 * GB)
    assert at_once(LARGE, 8, None, 1, "cuda") == 1


def test_a_stack_that_does_not_fit_is_refused_by_every_command(tmp_path, set_free, capsys):
    """A file of 6.3 GB that takes no space; no pixel is read."""
    with (tmp_path / "a.npy").open("wb") as file:
        header = {"descr": "<u2", "fortran_order": False, "shape": (96, 6000, 5500)}
        np.lib.format.write_array_header_1_0(file, header)
        file.truncate(file.tell() + 2 * 96 * 6000 * 5500)
    (tmp_path / "camera.toml").write_text(CAMERA.replace("frame_rows = 104", "frame_rows = 7000"))
    (tmp_path / "motion.csv").write_text("time,x,y\n" + "".join(f"{n / 100},0,0\n" for n in range(10000)))
    set_free(GB)
    camera = ("--config", tmp_path / "camera.toml")
    stack, out = tmp_path / "a.npy", tmp_path / "out"
    for arguments in (
        ("run", stack, out),
        ("detect", stack, "--out", out),
        ("motion", stack, "--out", tmp_path / "motion-out.csv"),
        ("restore", stack, f"{out}.tif", "--motion", tmp_path / "motion.csv", "--unit", "px", "--offset", 0),
    ):
        error = refused(capsys, *arguments, *camera)
        assert re.search(r"memory.*(takes about|need) [0-9.]+ GB|need [0-9.]+ GB of memory", error), error
        assert re.search("--window|--memory|rsvib run", error), error
    assert rsvib("calibrate", stack, "--frequency", "100", "--full-scale", 4095) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npy", "camera.toml", "motion.csv"]
    with pytest.raises(ValueError, match=r"96 frames of 6000 x 5500 px need 13.\d GB of memory, of which 1 GB"):
        rsv.read_stack(tmp_path / "a.npy", full_scale=4095)


def test_simulation_of_many_frames_is_refused(set_free):
    set_free(2 * GB)
    scene = np.random.default_rng(0).random((96, 96), np.float32)
    vibration = rsv.Vibration(2.0, 50.0)
    with pytest.raises(ValueError, match=r"num_frames=1000000000 frames of 64 x 64 px need .* GB of memory"):
        rsv.simulate_frames(scene, TIMING, vibration, 10**9, frame_size=(64, 64))
    refuses(lambda: rsv.simulate_frames(scene, TIMING, vibration, 2, frame_size=(10**9, 10**9)), "too small")


@pytest.mark.parametrize("method", ["exact", "banded", "dewarp", "richardson-lucy"])
def test_motion_beyond_the_frame_is_refused(method):
    frames = np.random.default_rng(0).random((2, 64, 48), np.float32)
    with pytest.raises(ValueError, match=r"the motion along the rows reaches 1e\+05 px .* size of 48 px"):
        rsv.restore(frames, TIMING, rsv.Vibration([1e5, 0.0], [50.0, 0.0]), method=method)
    with pytest.raises(ValueError, match=r"the motion across the rows reaches 65 px .* size of 64 px"):
        rsv.restore(frames, TIMING, rsv.Vibration([0.0, 65.0], [0.0, 50.0]), method=method)
    with pytest.raises(ValueError, match="motion along the rows"):
        rsv.restore(frames, TIMING, rsv.Vibration(1.0, 50.0, image_motion=[1e9, 0.0]), method=method)
    with pytest.raises(ValueError, match="motion along the rows"):
        rsv.visible_pixels(TIMING, rsv.Vibration([1e5, 0.0], [50.0, 0.0]), (64, 48), 2)
    fast = rsv.Vibration(1.0, 50.0, image_motion=[30.0 / TIMING.frame_period, 0.0])  # leaves the frame within two
    rsv.restore(frames, TIMING, fast, method=method, check=False)
