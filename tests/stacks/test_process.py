"""Stacks of any length: correct, and identical for all ways of processing."""

import itertools
import threading

import numpy as np
import pytest
import tifffile
import torch
from small_stack import FRAMES, HEIGHT, MOTION, OPTIONS, STILL, TIMING, WIDTH, process_small, write_with_gaps
from truth import Motion, decibel, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch.io import open_stack, write_stack
from rsvib_torch.options import RestorationOptions, StackOptions
from rsvib_torch.stacks import cut_windows, first_detection, read_manifest, restore_trusted
from rsvib_torch.stacks.memory import memory_limit


@pytest.mark.parametrize(("frames", "window"), [(1, 2), (2, 2), (9, 8), (25, 3), (100, 8), (101, 8), (7, 100)])
def test_windows_contain_every_pair_once_and_write_every_frame_once(frames, window):
    windows = cut_windows(frames, window)
    pairs = [pair for w in windows for pair in itertools.pairwise(w.frames)]
    assert pairs == list(itertools.pairwise(range(frames)))
    assert [frame for w in windows for frame in w.written] == list(range(frames))
    sizes = [len(w.frames) for w in windows]
    assert max(sizes) <= window
    assert max(sizes) - min(sizes) <= 1
    assert [w.alone for w in windows] == [len(windows) == 1] * len(windows)


def test_every_frame_of_a_long_stack_is_restored(whole):
    raw, restored = (tifffile.imread(whole / name) / 4095 for name in ("frames.tif", "out.tif"))
    assert restored.shape == (FRAMES, HEIGHT, WIDTH)
    before, after = ([decibel(frame, STILL, 12) for frame in stack] for stack in (raw, restored))
    assert max(before) < 27
    assert min(after) > 30
    assert np.median(np.subtract(after, before)) > 16
    manifest = read_manifest(whole / "out.tif.manifest.json")
    for record in manifest.windows:
        found = record.detection.vibration
        assert float(found.amplitude[0, 0]) == pytest.approx(MOTION.amplitude[0], rel=0.06)
        assert float(found.frequency[1, 0]) == pytest.approx(MOTION.frequency[1], rel=0.03)
        # the phase refers to the time origin of the window
        turn = 2 * np.pi * MOTION.frequency[0] * record.start_time + MOTION.phase[0] - float(found.phase[0, 0])
        assert abs(np.angle(np.exp(1j * turn))) < 0.2
    outputs = {name + ending for name in ("out.npy", "out.tif") for ending in ("", ".manifest.json")}
    assert {path.name for path in whole.iterdir()} == {"frames.tif", *outputs}


def test_window_equals_detection_and_restoration_of_its_frames(whole):
    frames = rsv.read_stack(whole / "frames.tif", full_scale=4095)[8:11]
    found = rsv.detect_vibration(frames, TIMING, **OPTIONS["detection"])
    expected = rsv.restore(frames[:2], TIMING, found.vibration, method="dewarp", check=False)
    restored = rsv.read_stack(whole / "out.tif")
    torch.testing.assert_close(restored[8:10], expected.clamp(0, 1), atol=0.6 / 4095, rtol=0)


@pytest.mark.parametrize("options", [{"workers": 3}, {"memory": "900MB", "workers": 8}])
def test_result_does_not_depend_on_workers_memory_or_staging(whole, tmp_path, options):
    threads = torch.get_num_threads()
    process_small(whole / "frames.tif", tmp_path / "out.tif", **options)
    assert (tmp_path / "out.tif").read_bytes() == (whole / "out.tif").read_bytes()
    old, new = (read_manifest(folder / "out.tif.manifest.json") for folder in (whole, tmp_path))
    assert new.to_dict()["windows"] == old.to_dict()["windows"]
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize("ending", [".h5", ""])
def test_output_is_the_same_in_every_format(whole, tmp_path, ending):
    sink = tmp_path / f"restored{ending}"
    process_small(whole / "frames.tif", sink)
    reader = open_stack(sink)
    frames = np.stack([reader.frame(index) for index in range(FRAMES)])
    np.testing.assert_array_equal(frames, tifffile.imread(whole / "out.tif"))
    assert reader.info.full_scale == 4095
    reader.close()
    assert {path.name for path in tmp_path.iterdir()} == {sink.name, f"{sink.name}.manifest.json"}


def test_detection_in_the_first_window_has_its_offset_curve(whole):
    options = {name: OPTIONS[name] for name in ("window", "detection", "restoration", "workers")}
    found = first_detection(whole / "frames.tif", TIMING, StackOptions(full_scale=4095, **options))
    stored = read_manifest(whole / "out.tif.manifest.json").windows[0].detection
    assert torch.equal(found.vibration.amplitude, stored.vibration.amplitude)
    assert found.offsets.offsets.shape[-1] == 2
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("rsvib")]


def test_stack_is_restored_with_detections_of_an_earlier_run(whole, tmp_path):
    manifest = read_manifest(whole / "out.tif.manifest.json")
    process_small(whole / "frames.tif", tmp_path / "out.tif", given=manifest.detections(), detection=None)
    assert (tmp_path / "out.tif").read_bytes() == (whole / "out.tif").read_bytes()
    with pytest.raises(ValueError, match="given has 8 detections for 6 windows of at most 4 frames"):
        process_small(whole / "frames.tif", tmp_path / "other.tif", given=manifest.detections(), window=4)


def test_bad_frames_are_listed_and_the_others_restored(whole, tmp_path):
    counts = tifffile.imread(whole / "frames.tif").astype(np.float32) / 4095
    counts[5] = 0.5  # constant
    counts[9, 4, 5] = 3e38
    counts[12, 3, 4] = np.inf
    counts[14] = np.nan
    np.save(tmp_path / "frames.npy", counts)
    with (tmp_path / "frames.npy").open("r+b") as file:
        file.truncate((tmp_path / "frames.npy").stat().st_size - 100)  # the last frame
    report = process_small(tmp_path / "frames.npy", tmp_path / "out.npy", window=9)
    manifest = read_manifest(report.manifest)
    assert list(manifest.bad_frames) == ["5", "9", "12", "14", "16"]
    assert "constant" in manifest.bad_frames["5"]
    assert "reach 3e+38" in manifest.bad_frames["9"]
    assert "frame 12 must be finite, but pixel (3, 4) is inf" in manifest.bad_frames["12"]
    assert "0.0% of pixels" in manifest.bad_frames["14"]
    assert "frame 16 lies beyond the end of the file" in manifest.bad_frames["16"]
    out = np.load(tmp_path / "out.npy")
    good = [index for index in range(FRAMES) if str(index) not in manifest.bad_frames]
    np.testing.assert_array_equal(out[[5, 9, 12, 14]], counts[[5, 9, 12, 14]])
    assert np.isnan(out[16]).all()
    assert report.bad_frames == 5
    assert report.failed == 0
    assert min(decibel(frame, STILL, 12) for frame in out[good]) > 28


def test_window_without_two_usable_frames_is_written_unchanged(whole, tmp_path):
    counts = tifffile.imread(whole / "frames.tif")
    counts[5:8] = 7
    np.save(tmp_path / "frames.npy", counts)
    report = process_small(tmp_path / "frames.npy", tmp_path / "out.npy")
    assert report.failed == 2
    out = np.load(tmp_path / "out.npy")
    np.testing.assert_array_equal(out[4:8], counts[4:8])
    assert (out[:4] != counts[:4]).any()
    records = read_manifest(report.manifest).windows
    assert [record.frames for record in records].index("as taken") == 2
    for record, frame in zip(records[2:4], (5, 6), strict=True):
        assert (record.frames, record.detection) == ("as taken", None)
        assert record.error.startswith(f"frame {frame} is constant")


def test_stack_without_detection_leaves_no_files(tmp_path):
    np.save(tmp_path / "frames.npy", np.full((40, 64, 64), 9, np.uint8))
    with pytest.raises(ValueError, match="frame 0 is constant"):
        rsv.process_stack(tmp_path / "frames.npy", tmp_path / "new" / "deep" / "out.npy", TIMING, window=3)
    assert [path.name for path in tmp_path.iterdir()] == ["frames.npy"]


def test_frame_times_of_the_file_are_used_and_kept(tmp_path):
    kept = [index for index in range(FRAMES) if index not in (3, 10, 11)]  # dropped frames
    start = 100.25  # s
    times = write_with_gaps(tmp_path, kept, start)
    for name in ("out.h5", "out.tif"):
        report = process_small(tmp_path / "frames.h5", tmp_path / name)
        info = rsv.read_stack_info(tmp_path / name)
        assert info.frame_times == pytest.approx(times)
    records = read_manifest(report.manifest).windows
    assert [r.start_time for r in records] == pytest.approx([times[r.first] for r in records])
    restored = rsv.read_stack(tmp_path / "out.tif").numpy()
    assert sorted(decibel(frame, STILL, 12) for frame in restored)[1] > 38  # also next to the gaps
    for record in records:
        found = record.detection.vibration
        turn = 2 * np.pi * MOTION.frequency[0] * (record.start_time - start) + MOTION.phase[0]
        turn -= float(found.phase[0, 0])
        assert abs(np.angle(np.exp(1j * turn))) < 0.2
        assert float(found.amplitude[0, 0]) == pytest.approx(MOTION.amplitude[0], rel=0.1)


def test_memory_sizes_are_parsed():
    assert [memory_limit(text) for text in ("2GB", "1.5 GiB", "500 MB", 4096)] == [2 * 10**9, 3 << 29, 5 * 10**8, 4096]
    for text in ("much", "-1GB", "0", "2 GBB", ""):
        with pytest.raises(ValueError, match="memory must be like '2GB'"):
            memory_limit(text)


def test_colour_and_axis_order_are_kept(whole, tmp_path):
    grey = tifffile.imread(whole / "frames.tif")[:5]
    colour = np.stack([grey, grey // 2, grey // 4], axis=-1)
    tifffile.imwrite(tmp_path / "colour.tif", colour, photometric="rgb", metadata=None, resolution=(300, 300))
    process_small(tmp_path / "colour.tif", tmp_path / "out.tif")
    process_small(tmp_path / "colour.tif", tmp_path / "out.h5")
    process_small(tmp_path / "colour.tif", tmp_path / "out.npy")
    out = tifffile.imread(tmp_path / "out.tif")
    assert out.shape == colour.shape
    reader = open_stack(tmp_path / "out.h5")
    np.testing.assert_array_equal(np.moveaxis(out[3], -1, 0), reader.frame(3))
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), np.moveaxis(out, -1, 1))
    write_stack(tmp_path / "one.tif", torch.rand(2, 1, 8, 9), dtype="float32")
    assert tifffile.imread(tmp_path / "one.tif").size == 144


@pytest.mark.parametrize("joint", [False, 3, True])
def test_motions_are_undone_and_unchanged_frames_have_the_shape_of_restored_ones(joint):
    """The frames as taken replace restored ones if nothing moves, or if these are worse; joint: the middle frame."""
    timing, motion = rsv.SensorTiming(2e-5, 20, 256), Motion(amplitude=(2.0, 3.0), frequency=(120.0, 90.0))
    frames = torch.from_numpy(take_frames(draw_scene(208, 208, 3), timing, motion, 3)).float()
    frames[:, 20, 30] = torch.nan
    vibration, options = motion.vibration(), {"joint": joint}
    opposite = rsv.Vibration(vibration.amplitude, vibration.frequency, vibration.phase + torch.pi)
    taken = frames[1:2] if joint is True else frames
    for given, force, restored, outcome in (
        (vibration, False, True, "helps"),
        (opposite, False, False, "worse"),
        (opposite, True, True, "worse"),
        (rsv.Vibration.still(), True, False, None),
    ):
        found = restore_trusted(frames, timing, given, RestorationOptions(**options), force=force)
        assert found.restored == restored
        assert (None if found.verdict is None else found.verdict.overall) == outcome
        assert found.frames.shape == taken.shape
        assert torch.equal(found.frames.nan_to_num(), taken.nan_to_num()) != restored
    assert torch.isnan(found.frames).sum() == len(taken)
