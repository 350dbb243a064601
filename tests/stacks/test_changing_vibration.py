"""A vibration that changes is measured without tones, window by window, in stacks of any format."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from program import rsvib
from small_stack import stop_after
from truth import Curve, crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch.stacks import read_manifest

TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=12, frame_rows=500)
CAMERA = ["--row-time", "100us", "--exposure", "1.2ms", "--frame-rate", "20"]
FRAMES, DECAY = 16, 0.6  # s
AMPLITUDE, FREQUENCY = np.array([2.3, 1.7]), np.array([66.3, 47.0])  # px, Hz
PHASE = np.array([0.5, 1.2])
SCENE = draw_scene(208, 208, seed=2)
STILL = crop(SCENE)


def steady(times):
    return AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * times[..., None] + PHASE)


def decaying(times):
    return np.exp(-times / DECAY)[..., None] * steady(times)


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    """A folder with a satellite pass, and the restored frames of a run."""
    folder = tmp_path_factory.mktemp("pass")
    np.save(folder / "frames.npy", take_frames(SCENE, TIMING, Curve(decaying), FRAMES, noise=0.003).astype(np.float32))
    process(folder, folder / "out.npy")
    return folder


def process(folder, sink, **options):
    options = {"restoration": {"method": "dewarp"}} | options
    return rsv.process_stack(folder / "frames.npy", sink, TIMING, **options)


def test_every_frame_of_a_vibration_that_decays_is_restored(place):
    taken, restored = (np.load(place / name) for name in ("frames.npy", "out.npy"))
    before, after = ([decibel(frame, STILL) for frame in stack] for stack in (taken, restored))
    assert np.mean(np.subtract(after, before)) > 10
    assert min(after) > 37  # of which the constant displacement, which no window knows, leaves most
    manifest = read_manifest(place / "out.npy.manifest.json")
    assert {record.outcome for record in manifest.windows} == {"helps"}


def test_windows_state_equivalent_tones_and_their_motion(place):
    manifest = read_manifest(place / "out.npy.manifest.json")
    table = manifest.table()
    assert all(table["reliable"])
    assert all(table["equivalent"])
    assert all("tones along" in str(one) for record in manifest.windows for one in record.detection.assumptions)
    assert "no steady tones explain all windows" in " ".join(manifest.summary().split())
    envelope = np.exp(-np.array(table["middle_time_s"]) / DECAY)
    windows = len(manifest.windows)
    np.testing.assert_allclose(table["amplitude_px"], np.tile(AMPLITUDE, windows) * envelope, rtol=0.1)
    np.testing.assert_allclose(table["frequency_Hz"], np.tile(FREQUENCY, windows), atol=1.0)
    rows = (np.arange(128) + 0.5 * TIMING.exposure_rows) * TIMING.row_time
    for record, motion in zip(manifest.windows, manifest.detections(), strict=True):
        torch.testing.assert_close(record.detection.gain, record.detection.vibration.gain(TIMING.frame_period))
        times = np.arange(record.last - record.first + 1)[:, None] * TIMING.frame_period + rows
        error = motion.displacement(torch.from_numpy(times)).numpy() - decaying(times + record.start_time)
        assert np.std(error - error.mean(0)) < 0.02  # of what differs between frames
        assert np.std(error.mean(0) - error.mean((0, 1))) < 0.4  # of what six frames with gaps have in common


def test_the_motions_of_a_manifest_restore_the_same_frames(place, tmp_path):
    given = read_manifest(place / "out.npy.manifest.json").detections()
    process(place, tmp_path / "out.npy", given=given)
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), np.load(place / "out.npy"))


def test_detect_names_the_command_that_measures_a_vibration_that_changes(place, tmp_path, capsys):
    assert rsvib("detect", place / "frames.npy[0:8]", *CAMERA, "--out", tmp_path / "out") == 0
    assert "measure a vibration that changes, and restore the frames:\n    rsvib run" in capsys.readouterr().out


def test_windows_of_a_vibration_that_changes_are_restored_jointly(place, tmp_path):
    np.save(tmp_path / "frames.npy", np.load(place / "frames.npy")[:8])
    found = None
    for joint in (True, 3):
        process(tmp_path, tmp_path / f"{joint}.npy", restoration={"joint": joint}, given=found)
        assert min(decibel(frame, STILL) for frame in np.load(tmp_path / f"{joint}.npy")) > 37
        found = read_manifest(tmp_path / f"{joint}.npy.manifest.json").detections()


def test_the_frames_around_a_sudden_stop_are_restored(tmp_path):
    """It stops in the middle of frame 4; no tones explain its rows, and frames behind it are at rest."""
    stop = 4.3 * TIMING.frame_period
    frames = take_frames(SCENE, TIMING, Curve(lambda t: decaying(t) * (t < stop)[..., None]), 8, noise=0.003)
    np.save(tmp_path / "frames.npy", frames.astype(np.float32))
    process(tmp_path, tmp_path / "out.npy")
    restored = np.load(tmp_path / "out.npy")
    assert min(decibel(restored[index], STILL) - decibel(frames[index], STILL) for index in range(4)) > 4
    assert min(decibel(restored[index], STILL) for index in range(5, 8)) > 37


def test_a_change_of_frequency_within_a_window_is_measured(tmp_path):
    """A motor changes its speed within frame 4."""

    def moved(times):
        turned = 2 * np.pi * np.where(times < 4.4 * TIMING.frame_period, 0.0, [[-28.3], [-9.0]]).T
        return AMPLITUDE * np.sin(turned * times[..., None] + 2 * np.pi * FREQUENCY * times[..., None] + PHASE)

    frames = take_frames(SCENE, TIMING, Curve(moved), 8, noise=0.003)
    np.save(tmp_path / "frames.npy", frames.astype(np.float32))
    process(tmp_path, tmp_path / "out.npy")
    restored = np.load(tmp_path / "out.npy")
    gains = [decibel(restored[index], STILL) - decibel(frames[index], STILL) for index in range(8)]
    assert min(gains) > 3  # of the frame whose displacement jumps
    assert np.mean(gains) > 6


def test_a_frame_at_rest_contradicts_the_tones_of_the_others():
    """The rows of seven frames outweigh those of the last one, which restoration would make worse by 20 dB."""
    stop = 7 * TIMING.frame_period - 1e-3
    moved = Curve(lambda t: steady(t) * (t < stop)[..., None])
    found = rsv.detect_vibration(take_frames(SCENE, TIMING, moved, 8, noise=0.003), TIMING)
    assert not found.reliable.any()
    assert all("rows_unexplained" in [one.code for one in of_axis] for of_axis in found.findings)


def test_result_does_not_depend_on_interruptions_windows_at_once_or_workers(place, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        process(place, tmp_path / "out.npy", progress=stop_after(6))
    report = process(place, tmp_path / "out.npy", resume=True, workers=3)
    assert 0 < report.resumed < report.windows
    assert (tmp_path / "out.npy").read_bytes() == (place / "out.npy").read_bytes()
    expected = json.loads((place / "out.npy.manifest.json").read_text())
    assert json.loads((tmp_path / "out.npy.manifest.json").read_text()) == expected


def test_bad_frames_are_written_as_taken_and_the_others_restored(place, tmp_path):
    frames = np.load(place / "frames.npy")[:8]
    frames[5] = np.float32(0.5)  # constant
    np.save(tmp_path / "frames.npy", frames)
    report = process(tmp_path, tmp_path / "out.npy")
    assert (report.bad_frames, report.restored) == (1, report.windows)
    restored = np.load(tmp_path / "out.npy")
    np.testing.assert_array_equal(restored[5], frames[5])
    assert min(decibel(restored[index], STILL) for index in (4, 6, 7)) > 36


def test_run_restores_a_vibration_that_changes_without_an_option(place, tmp_path, capsys):
    frames = f"{place / 'frames.npy'}[0:11]"
    assert rsvib("run", frames, tmp_path / "run", *CAMERA, "--method", "dewarp", "--report") == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "no steady tones explain all windows" in shown
    rows = list(csv.DictReader((tmp_path / "run" / "tones.csv").read_text().splitlines()))
    sizes = [float(row["amplitude_px"]) for row in rows if row["axis"] == "x"]
    assert sizes[0] > 1.4 * sizes[-1]  # by the decay 1.5
    restored = rsv.read_stack(tmp_path / "run" / "restored.tif").numpy()
    assert min(decibel(frame, STILL) for frame in restored) > 37
    assert (tmp_path / "run" / "windows.png").exists()
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "The vibration changes; it was measured and removed by rsvib run." in page


def test_windows_are_measured_with_tones_only_if_options_of_detection_are_given(place, tmp_path):
    report = rsv.process_stack(place / "frames.npy[0:8]", tmp_path / "out.npy", TIMING, detection={"tones": "auto"})
    assert report.restored == 0
    (record,) = read_manifest(report.manifest).windows
    assert record.motion is None
    assert "detect_motion (rsvib motion) if the vibration changes" in str(record.left_alone[0])


@pytest.mark.parametrize("decay", [math.inf, 0.5])
def test_a_motion_near_the_frame_rate_is_not_restored_by_a_part_of_it(tmp_path, decay):
    """All frames have most of it in common: 0.2 and 0.6 px instead of 2.5 px were reliable."""
    timing = rsv.SensorTiming(row_time=1e-4, exposure_rows=12, frame_rows=160)  # 62.5 frames per second

    def moved(times):
        x = np.exp(-times / decay) * np.sin(2 * np.pi * 62.2 * times + 0.4)
        return 2.5 * np.stack([x, np.exp(-2 * times) * np.sin(2 * np.pi * 110.0 * times)], -1)

    frames = take_frames(SCENE, timing, Curve(moved), 8, noise=0.004)
    np.save(tmp_path / "frames.npy", frames.astype(np.float32))
    rsv.process_stack(tmp_path / "frames.npy", tmp_path / "out.npy", timing, restoration={"method": "dewarp"})
    (record,) = read_manifest(tmp_path / "out.npy.manifest.json").windows
    amplitude = float(record.detection.vibration.amplitude[0, 0])
    assert not bool(record.detection.reliable[0]) or amplitude == pytest.approx(2.5, rel=0.1)


def test_windows_that_agree_with_another_timing_are_not_measured_without_tones(tmp_path):
    """A motion of any shape explains frames with a wrong timing as well, and restored them with it."""
    frames = take_frames(SCENE, TIMING, Curve(steady), 8, noise=0.003)
    wrong = replace(TIMING, frame_rows=TIMING.frame_rows * 0.9)
    np.save(tmp_path / "frames.npy", frames.astype(np.float32))
    rsv.process_stack(tmp_path / "frames.npy", tmp_path / "out.npy", wrong, restoration={"method": "dewarp"})
    (record,) = read_manifest(tmp_path / "out.npy.manifest.json").windows
    assert "other_frame_rows" in record.detection.codes((0,))
    assert record.motion is None


def test_frames_after_a_lost_one_are_taken_a_frame_period_later(tmp_path):
    """Frame 9 of 14 is lost: the second window agrees with it, and all frames are restored."""
    frames = np.delete(take_frames(SCENE, TIMING, Curve(steady), 14, noise=0.003), 9, axis=0)
    np.save(tmp_path / "frames.npy", frames.astype(np.float32))
    process(tmp_path, tmp_path / "out.npy")
    manifest = read_manifest(tmp_path / "out.npy.manifest.json")
    assert [record.lost_before for record in manifest.windows] == [None, 9]
    assert all(bool(record.detection.reliable.all()) for record in manifest.windows)
    assert "a frame is lost before frame 9 (window 1)" in manifest.summary()
    assert [given is None for given in manifest.detections()] == [False, True]
    assert min(decibel(frame, STILL) for frame in np.load(tmp_path / "out.npy")) > 37


def test_commands_name_lost_frames_and_rows(tmp_path, capsys):
    """A run of few frames and ``rsvib restore`` name them as a run in windows does; only a run restores all frames."""
    frames = np.delete(take_frames(SCENE, TIMING, Curve(steady), 7, noise=0.003), 3, axis=0).astype(np.float32)
    frames[1, 60:100] = 0
    np.save(tmp_path / "frames.npy", frames)
    assert rsvib("run", tmp_path / "frames.npy", tmp_path / "out", *CAMERA, "--method", "dewarp") == 0
    shown = " ".join(capsys.readouterr().out.split())
    lost = "rows of one value in frame 1 (40 in all)"
    assert "a frame is lost before frame 3" in shown
    assert lost in shown
    assert rsvib("detect", tmp_path / "frames.npy", "--out", tmp_path / "found", *CAMERA) == 0
    shown = capsys.readouterr().out
    assert "rsvib run" in shown
    assert "rsvib motion" not in shown[shown.index("Next") :]
    np.save(tmp_path / "before.npy", frames[:3])
    vibration = tmp_path / "out" / "vibration.json"
    options = ("--vibration", vibration, *CAMERA, "--method", "dewarp")
    assert rsvib("restore", tmp_path / "before.npy", tmp_path / "restored.npy", *options) == 0
    assert lost in " ".join(capsys.readouterr().out.split())
    assert read_manifest(tmp_path / "restored.npy.manifest.json").windows[0].lost_rows == {"1": 40}
