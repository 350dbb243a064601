"""A vibration that changes is followed from frame to frame, window by window, in stacks of any format."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from program import rsvib
from refusals import refuses
from small_stack import stop_after
from truth import Curve, crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch.stacks import detect_stack, read_manifest

TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=12, frame_rows=500)
CAMERA = ["--row-time", "100us", "--exposure", "1.2ms", "--frame-rate", "20"]
FRAMES, DECAY = 30, 1.2  # s
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
    """A folder with a satellite pass, and the output of a run that follows its vibration."""
    folder = tmp_path_factory.mktemp("pass")
    np.save(folder / "frames.npy", take_frames(SCENE, TIMING, Curve(decaying), FRAMES, noise=0.003).astype(np.float32))
    follow(folder, folder / "out.npy")
    return folder


def follow(folder, sink, **options):
    options = {"restoration": {"method": "dewarp"}} | options
    return rsv.process_stack(folder / "frames.npy", sink, TIMING, follow=True, **options)


def test_every_frame_of_a_vibration_that_decays_is_restored(place):
    taken, restored = (np.load(place / name) for name in ("frames.npy", "out.npy"))
    before, after = ([decibel(frame, STILL) for frame in stack] for stack in (taken, restored))
    assert np.mean(np.subtract(after, before)) > 5
    assert min(np.subtract(after, before)) > 0
    manifest = read_manifest(place / "out.npy.manifest.json")
    assert sum(record.restored_frames for record in manifest.windows) == FRAMES
    assert {record.outcome for record in manifest.windows} <= {"helps", "partly"}
    assert manifest.settings["follow"] is True


def test_the_report_states_how_many_frames_were_left_as_taken(place, tmp_path):
    frames = np.load(place / "frames.npy")
    frames[5] = 0.5
    np.save(tmp_path / "frames.npy", frames)
    report = follow(tmp_path, tmp_path / "out.npy")
    assert report.as_taken == 1
    assert f"{report.windows} restored (1 frame of these as taken)" in report.summary()


def errors_of(found, start, first=0):
    """(T, 2) px, rms error of the displacement of the rows of frames from ``first`` on; time origin at ``start``."""
    rows = np.arange(128) * TIMING.row_time + 0.5 * TIMING.exposure_time
    errors = []
    for number in range(len(found.times)):
        times = (first + number) * TIMING.frame_period + rows
        vibration = found.vibration[number]
        amplitude, frequency, phase = (getattr(vibration, name).numpy() for name in ("amplitude", "frequency", "phase"))
        turned = 2 * np.pi * frequency * (times - start)[:, None, None] + phase
        error = (amplitude * np.sin(turned)).sum(-1) - decaying(times)
        errors.append(np.sqrt(np.square(error - error.mean(0)).mean(0)))
    return np.array(errors)


def scores(found, name, expected):
    """Errors over standard deviations of the tone of each axis in reliable frames; ``expected`` is (T, 2) or (2,)."""
    values, stds = (getattr(part, name)[..., 0].numpy() for part in (found.vibration, found.std))
    return ((values - expected) / stds)[found.reliable.numpy()]


def test_each_frame_has_the_vibration_at_its_time(place):
    frames = np.load(place / "frames.npy")
    found = rsv.follow_vibration(frames, TIMING)
    assert found.vibration.amplitude.shape == (FRAMES, 2, 1)
    errors, reliable = errors_of(found, 0.0), found.reliable.numpy()
    assert (reliable & (errors < 0.01)).all(1).sum() >= FRAMES - 4
    assert not (reliable & (errors > 3 * found.std.displacement.numpy())).any()
    table = found.table()
    assert len(table["axis"]) == 2 * FRAMES
    assert table["middle_time_s"][-1] == pytest.approx((FRAMES - 1) * TIMING.frame_period + 0.5 * (127e-4 + 1.2e-3))
    restored = rsv.restore(frames, TIMING, found, method="dewarp").numpy()
    assert min(decibel(restored[index], STILL) - decibel(frames[index], STILL) for index in range(0, 30, 5)) > 4
    refuses(lambda: rsv.restore(frames[:8], TIMING, found), "pass the frames that it was detected in")


def test_the_frames_before_a_vibration_stops_are_restored(tmp_path):
    """It stops in the middle of a frame, whose rows no tones explain; the frames behind are at rest."""
    stop = 11.3 * TIMING.frame_period
    frames = take_frames(SCENE, TIMING, Curve(lambda t: decaying(t) * (t < stop)[..., None]), 20, noise=0.003)
    np.save(tmp_path / "frames.npy", frames.astype(np.float32))
    follow(tmp_path, tmp_path / "out.npy")
    restored = np.load(tmp_path / "out.npy")
    assert min(decibel(restored[index], STILL) - decibel(frames[index], STILL) for index in range(11)) > 5
    np.testing.assert_array_equal(restored[12:], frames[12:].astype(np.float32))
    found = rsv.follow_vibration(frames, TIMING)
    assert found.reliable.sum(0).tolist() == [11, 11]
    assert [one.code for one in found.findings[15][0]] == ["no_tone"]


def test_a_change_of_frequency_within_the_record_is_refused():
    """No tones explain a motor that changes its speed within frame 10."""

    def moved(times):
        turned = 2 * np.pi * np.where(times < 10.4 * TIMING.frame_period, 0.0, [[-28.3], [-9.0]]).T
        return AMPLITUDE * np.sin(turned * times[..., None] + 2 * np.pi * FREQUENCY * times[..., None] + PHASE)

    found = rsv.follow_vibration(take_frames(SCENE, TIMING, Curve(moved), 20, noise=0.003), TIMING)
    assert not found.reliable.any()


def test_a_frame_at_rest_contradicts_the_tones_of_the_others():
    """The rows of seven frames outweigh those of the last one, which restoration would make worse by 20 dB."""
    stop = 7 * TIMING.frame_period - 1e-3
    moved = Curve(lambda t: steady(t) * (t < stop)[..., None])
    found = rsv.detect_vibration(take_frames(SCENE, TIMING, moved, 8, noise=0.003), TIMING)
    assert not found.reliable.any()
    assert all("rows_unexplained" in [one.code for one in of_axis] for of_axis in found.findings)


def test_a_large_vibration_that_decays_fast_is_followed():
    """The first frame is known to one tracker, half a frame period from the pair that it is measured in."""
    moved = Curve(lambda t: 2.5 * np.exp(-2.5 * t[..., None]) * steady(t))
    found = rsv.follow_vibration(take_frames(SCENE, TIMING, moved, 12, noise=0.003), TIMING)
    reliable = found.reliable.numpy()
    assert reliable.sum() > 20
    assert reliable[0].all()
    middles = np.arange(12)[:, None] * TIMING.frame_period + 64e-4 + 0.5 * TIMING.exposure_time
    assert np.abs(scores(found, "amplitude", 2.5 * AMPLITUDE * np.exp(-2.5 * middles))).max() < 4


def test_frequencies_of_a_sweep_are_within_their_standard_deviations():
    """A tracker is late; the one that runs backwards is early."""
    start, rate = np.array([31.0, 52.0]), 1.5  # Hz, Hz/s
    turned = Curve(lambda t: AMPLITUDE * np.sin(2 * np.pi * (start + 0.5 * rate * t[..., None]) * t[..., None] + PHASE))
    found = rsv.follow_vibration(take_frames(SCENE, TIMING, turned, 30, noise=0.003), TIMING)
    frequency = start + rate * (np.arange(30)[:, None] * TIMING.frame_period + 64e-4)
    z = scores(found, "frequency", frequency)
    assert len(z) > 40
    assert np.abs(z).max() < 3
    assert 0.2 < np.sqrt(np.square(z).mean()) < 1.2


def test_two_steady_tones_near_the_frame_rate_are_not_reliable_and_wrong():
    """Of frames that do not determine two tones of each axis, no frame is wrong."""
    sizes, hertz = np.array([[0.97, 0.94], [2.11, 0.57]]), np.array([[29.7, 48.4], [80.9, 72.8]])

    def moved(times):
        return (sizes * np.sin(2 * np.pi * hertz * times[..., None, None])).sum(-1)

    frames = take_frames(SCENE, TIMING, Curve(moved), 24, noise=0.003)
    found = rsv.follow_vibration(frames, TIMING)
    rows = np.arange(128) * TIMING.row_time + 0.5 * TIMING.exposure_time
    for number, axis in np.argwhere(found.reliable.numpy()):
        times = number * TIMING.frame_period + rows
        shown = found.vibration[int(number)].translation().displacement(torch.from_numpy(times))
        assert np.std(shown.numpy()[:, axis] - moved(times)[:, axis]) < 0.1


def test_windows_state_the_vibration_of_their_frames(place, tmp_path):
    detect_stack(place / "frames.npy[0:20]", tmp_path / "manifest.json", TIMING, window=14, follow=True)
    manifest = read_manifest(tmp_path / "manifest.json")
    assert len(manifest.detections()) == 20
    assert [frame for record in manifest.windows for frame in record.followed] == list(range(20))
    table = manifest.table()
    assert (table["first_frame"][-1], table["last_frame"][-1]) == (19, 19)
    assert table["middle_time_s"][-1] == pytest.approx(manifest.times()[-1])
    assert np.mean(table["reliable"]) > 0.9


def test_result_does_not_depend_on_interruptions_windows_at_once_or_workers(place, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        follow(place, tmp_path / "out.npy", progress=stop_after(12))
    with pytest.raises(ValueError, match=r'cannot resume: settings\.follow was true, now it is "auto"'):
        rsv.process_stack(place / "frames.npy", tmp_path / "out.npy", TIMING, resume=True)
    report = follow(place, tmp_path / "out.npy", resume=True, workers=3)
    assert 0 < report.resumed < report.windows
    assert (tmp_path / "out.npy").read_bytes() == (place / "out.npy").read_bytes()
    expected = json.loads((place / "out.npy.manifest.json").read_text())
    assert json.loads((tmp_path / "out.npy.manifest.json").read_text()) == expected


def test_bad_frames_are_written_as_taken_and_the_others_followed(place, tmp_path):
    frames = np.load(place / "frames.npy")[:24]
    frames[17] = np.float32(0.5)  # constant
    np.save(tmp_path / "frames.npy", frames)
    report = follow(tmp_path, tmp_path / "out.npy")
    assert (report.bad_frames, report.restored) == (1, report.windows)
    restored = np.load(tmp_path / "out.npy")
    np.testing.assert_array_equal(restored[17], frames[17])
    assert min(decibel(restored[index], STILL) for index in (16, 18, 19)) > 36


def test_run_follows_a_vibration_that_changes_without_an_option(place, tmp_path, capsys):
    assert rsvib("run", place / "frames.npy", tmp_path / "run", *CAMERA, "--report") == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "the tones change within" in shown
    assert "followed from frame to frame" in shown
    manifest = read_manifest(tmp_path / "run" / "manifest.json")
    right, wrong = 0, 0
    for record in manifest.windows:
        if record.followed is None:
            continue
        parts = [record.detection[number] for number in range(len(record.followed))]
        found = SimpleNamespace(vibration=[one.vibration for one in parts], times=record.followed)
        errors = errors_of(found, record.start_time, record.first)
        reliable = np.array([one.reliable.numpy() for one in parts])
        right += (reliable & (errors < 0.01)).all(1).sum()
        stds = np.array([one.std.displacement.numpy() for one in parts])
        wrong += (reliable & (errors > np.maximum(3 * stds, 0.01))).sum()
    assert right >= FRAMES - 4
    assert wrong == 0
    rows = list(csv.DictReader((tmp_path / "run" / "tones.csv").read_text().splitlines()))
    sizes = [
        float(row["amplitude_px"]) for row in rows if row["axis"] == "x" and row["first_frame"] == row["last_frame"]
    ]
    assert sizes[0] > 3 * sizes[-1]
    restored = rsv.read_stack(tmp_path / "run" / "restored.tif").numpy()
    assert sum(decibel(restored[index], STILL) > 40 for index in range(FRAMES)) >= FRAMES - 4
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "followed from frame to frame, and removed, by rsvib run" in page


def test_following_is_refused_where_it_is_switched_off(place, tmp_path, capsys):
    part = place / "frames.npy[0:12]"
    assert rsvib("run", part, tmp_path / "steady", *CAMERA, "--no-follow") == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "0 restored" in shown
    assert "--follow" in shown
    assert "follow_vibration" not in shown


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
    refuses(lambda: follow(place, tmp_path / "out.npy", **options), message)
