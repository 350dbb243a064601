"""A vibration that changes is followed from frame to frame, window by window, in stacks of any format."""

import csv
import json

import numpy as np
import pytest
from program import refused, rsvib
from truth import Curve, crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch.stacks import detect_stack, read_manifest

TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=12, frame_rows=500)
CAMERA = ["--row-time", "100us", "--exposure", "1.2ms", "--frame-rate", "20"]
FRAMES, DECAY = 40, 1.2  # s
AMPLITUDE, FREQUENCY = np.array([2.3, 1.7]), np.array([66.3, 47.0])  # px, Hz
PHASE = np.array([0.5, 1.2])
SCENE = draw_scene(208, 208, seed=2)
STILL = crop(SCENE)


def decaying(times):
    turned = 2 * np.pi * FREQUENCY * times[..., None] + PHASE
    return AMPLITUDE * np.exp(-times / DECAY)[..., None] * np.sin(turned)


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    """A folder with a satellite pass, and the output of a run that follows its vibration."""
    folder = tmp_path_factory.mktemp("pass")
    np.save(folder / "frames.npy", take_frames(SCENE, TIMING, Curve(decaying), FRAMES, noise=0.003).astype(np.float32))
    follow(folder, folder / "out.npy")
    return folder


def follow(folder, sink, **options):
    return rsv.process_stack(folder / "frames.npy", sink, TIMING, follow=True, **options)


def test_every_frame_is_restored_whose_motion_is_known(place):
    taken, restored = (np.load(place / name) for name in ("frames.npy", "out.npy"))
    before, after = ([decibel(frame, STILL) for frame in stack] for stack in (taken, restored))
    assert np.mean(np.subtract(after, before)) > 10
    assert min(np.subtract(after, before)) >= 0
    unchanged = [index for index in range(FRAMES) if np.array_equal(taken[index], restored[index])]
    assert set(unchanged) <= {0, 1}  # the vibration is detected in them
    manifest = read_manifest(place / "out.npy.manifest.json")
    assert sum(record.restored_frames for record in manifest.windows) == FRAMES - len(unchanged)
    assert {record.outcome for record in manifest.windows} <= {"helps", "partly"}
    assert manifest.settings["follow"]


def test_each_window_states_the_vibration_at_its_middle_frame(place, tmp_path):
    detect_stack(place / "frames.npy", tmp_path / "manifest.json", TIMING, follow=True, window=4)
    manifest = read_manifest(tmp_path / "manifest.json")
    errors = []
    for record in manifest.windows:
        found, std = record.detection.vibration, record.detection.std
        middle = record.middle * TIMING.frame_period + 0.5 * (127 * TIMING.row_time + TIMING.exposure_time)
        size = AMPLITUDE * np.exp(-middle / DECAY)
        for axis in np.flatnonzero(record.detection.reliable.numpy()):
            amplitude, frequency, phase = (
                float(values[axis, 0]) for values in (found.amplitude, found.frequency, found.phase)
            )
            assert frequency == pytest.approx(FREQUENCY[axis], abs=5 * float(std.frequency[axis, 0]), rel=0.05)
            assert abs(amplitude - size[axis]) < max(5 * float(std.amplitude[axis, 0]), 0.05 * size[axis])
            turn = 2 * np.pi * FREQUENCY[axis] * record.start_time + PHASE[axis] - phase
            assert abs(np.angle(np.exp(1j * turn))) < 5 * float(std.phase[axis, 0])
            errors.append(abs(amplitude / size[axis] - 1))
    assert len(errors) > 1.8 * len(manifest.windows)  # of two axes
    assert np.median(errors) < 0.02
    times = manifest.table()["middle_time_s"]
    assert times[-1] == pytest.approx(middle)


def test_result_does_not_depend_on_interruptions_windows_at_once_or_workers(place, tmp_path):
    def stop(done, total):
        if done > 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        follow(place, tmp_path / "out.npy", progress=stop)
    with pytest.raises(ValueError, match=r"cannot resume: settings\.follow was true, now it is false"):
        rsv.process_stack(place / "frames.npy", tmp_path / "out.npy", TIMING, resume=True)
    report = follow(place, tmp_path / "out.npy", resume=True, workers=3)
    assert 0 < report.resumed < report.windows
    assert (tmp_path / "out.npy").read_bytes() == (place / "out.npy").read_bytes()
    expected = json.loads((place / "out.npy.manifest.json").read_text())
    assert json.loads((tmp_path / "out.npy.manifest.json").read_text()) == expected


def test_bad_frames_are_written_as_taken_and_the_others_followed(place, tmp_path):
    frames = np.load(place / "frames.npy")
    frames[17] = np.float32(0.5)  # constant
    np.save(tmp_path / "frames.npy", frames)
    report = follow(tmp_path, tmp_path / "out.npy")
    assert (report.bad_frames, report.restored) == (1, report.windows)
    restored = np.load(tmp_path / "out.npy")
    np.testing.assert_array_equal(restored[17], frames[17])
    assert min(decibel(restored[index], STILL) for index in (16, 18, 19)) > 40


def test_run_names_follow_where_a_vibration_changes_and_follows_it(place, tmp_path, capsys):
    assert rsvib("run", place / "frames.npy", tmp_path / "steady", *CAMERA) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "0 restored" in shown
    assert "use follow=True (--follow) if the vibration changes" in shown
    assert rsvib("run", place / "frames.npy", tmp_path / "followed", *CAMERA, "--follow", "--window", 4) == 0
    assert "frames restored" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "followed" / "tones.csv").read_text().splitlines()))
    assert len(rows) == 2 * 13  # axes, windows
    sizes = [float(row["amplitude_px"]) for row in rows if row["axis"] == "x"]
    assert sizes[0] > 4 * sizes[-1]
    assert rsvib("detect", place / "frames.npy", "--out", tmp_path / "detected", *CAMERA, "--follow") == 0
    assert "--follow" in capsys.readouterr().out  # the next step
    manifest = tmp_path / "detected" / "manifest.json"
    again = ("restore", place / "frames.npy", tmp_path / "again.npy", *CAMERA, "--vibration", manifest)
    assert "repeat rsvib run --follow" in refused(capsys, *again)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(
            ({"restoration": {name: value}}, f"{name} is not available for frames that are followed one by one")
            for name, value in (("joint", 3), ("scale", 2), ("mosaic", "RGGB"), ("optics", rsv.Optics(sigma=0.4)))
        ),
        ({"detection": {"tones": 1}}, "follow=True has no options of detection"),
        ({"given": [None]}, "follow=True has no options of detection, and no given detections"),
    ],
)
def test_options_that_frames_one_by_one_do_not_have_are_refused(place, tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        follow(place, tmp_path / "out.npy", **options)
