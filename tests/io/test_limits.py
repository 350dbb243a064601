"""Files that would exhaust memory or disk are refused with one line."""

import resource

import h5py
import numpy as np
import pytest
import torch
from refusals import refuses

import rsvib_torch as rsv
from rsvib_torch.commands.main import run_command
from rsvib_torch.config import read_config
from rsvib_torch.io import read_stack, read_stack_info

TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=104)
COUNTS = np.random.default_rng(2).integers(0, 4096, (4, 16, 16)).astype(np.uint16)


@pytest.mark.parametrize("several", [False, True])
def test_stack_that_does_not_fit_is_refused_before_it_is_read(tmp_path, set_free, several):
    path = tmp_path / "a.npy"
    np.save(path, COUNTS.astype(np.float32))
    paths = [path, path] if several else path
    needed = (4 if not several else 12) * COUNTS.size + 24 * COUNTS[0].size
    set_free(needed)
    assert len(read_stack(paths)) == 4 * (1 + several)
    set_free(needed - 1)
    refuses(lambda: read_stack(paths), r"a.npy: 4 frames of 16 x 16 px need .* KB .*; process the stack in windows")
    refuses(lambda: rsv.detect_vibration(paths, TIMING), r"need .* of memory")


def test_a_chunk_of_hdf5_may_exceed_a_short_recording_but_not_by_much(tmp_path):
    layout = {"maxshape": (None, None, None), "compression": 1}
    for name, chunks in (("short.h5", (64, 16, 16)), ("huge.h5", (8, 3000, 3000))):
        with h5py.File(tmp_path / name, "w") as file:
            file.create_dataset("frames", COUNTS.shape, "u2", chunks=chunks, **layout)[...] = COUNTS
    assert len(read_stack(tmp_path / "short.h5", full_scale=4095)) == len(COUNTS)
    refuses(lambda: read_stack_info(tmp_path / "huge.h5"), "a chunk of 144 MB holds a stack of 2.05 KB")


def test_video_frames_that_do_not_fit(tmp_path, set_free):
    rsv.write_stack(tmp_path / "a.mkv", np.zeros((2, 64, 64), np.float32), dtype="uint8")
    set_free(10**5)
    with pytest.raises(ValueError, match=r"not a readable video stack: .* 64 x 64 px need 197 KB of memory"):
        read_stack_info(tmp_path / "a.mkv")


def test_a_full_disk_is_named_with_the_output(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    frames = torch.rand(4, 64, 64, generator=torch.Generator().manual_seed(0))
    info = rsv.StackInfo((4, 64, 64), "uint8", 255.0, frame_rate=30.0)
    writers = {
        "a.mkv": lambda path: rsv.write_stack(path, frames, dtype="uint8", like=info),
        "a.json": rsv.Vibration([1.0, 2.0], [50.0, 60.0]).save,
    }
    for name in ("a.h5", "a.tif", "a.npy"):
        writers[name] = lambda path: rsv.write_stack(path, frames)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, before[1]))
    try:
        for name, write in writers.items():
            with pytest.raises(OSError, match=f"(File too large|No space left on device): '{tmp_path / name}'$"):
                write(tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_messages_have_at_most_twenty_lines(tmp_path):
    (tmp_path / "b.toml").write_text("".join(f"a{n} = 1\n" for n in range(1000)))
    with pytest.raises(ValueError, match="mistakes") as caught:
        read_config(tmp_path / "b.toml")
    assert len(str(caught.value).splitlines()) == 21


@pytest.mark.parametrize("option", ["--row-time", "--frame-rate"])
def test_messages_do_not_repeat_long_options(tmp_path, capsys, option):
    (tmp_path / "a.toml").write_text(f"[sensor]\n{'key' * 10**5} = [{'1, ' * 10**5}]\nrow_time = '{'1' * 10**5}'\n")
    assert run_command(["init", str(tmp_path / "a.tif"), option, "1" * 10**5]) == 2
    assert run_command(["detect", "a.tif", "--out", str(tmp_path / "b"), "--config", str(tmp_path / "a.toml")]) == 2
    assert all(len(line) < 1100 for line in capsys.readouterr().err.splitlines())
