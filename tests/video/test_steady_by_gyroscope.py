"""Videos steadied by a gyroscope, against an independent camera that turns: a subject fills most of its frame."""

import json

import numpy as np
import pytest
import torch
from gpmf_file import add_track, packet, write_rates
from program import refused, rsvib
from rotating_camera import FOCAL_LENGTH, OFFSET, TIMING, recorded, take, unrelated_rates
from scipy.spatial.transform import Rotation
from small_video import shifts, sound_of, write_sharp

import rsvib_torch as rsv
from rsvib_torch.video import process_video
from rsvib_torch.video.recorded_rotation import RecordedRotation
from rsvib_torch.video.steadying import steady_shifts

COUNT, SHAKING = 24, 2.0
OPTIONS = {"restoration": {"method": "dewarp"}, "workers": 2, "steady": 1 / 3}
CAMERA = ("--row-time", "80us", "--exposure", "0.8ms", "--frame-rate", str(1 / TIMING.frame_period))
STRIP = (slice(6, 44), slice(16, -16))  # of the distant scene, above the subject


def walk(times):
    return np.stack([60 * times - 20, -4 * np.abs(np.sin(2 * np.pi * 1.9 * times))], -1)


def rates_of_clip():
    return recorded("yZx", SHAKING, count=COUNT)


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    """A clip with a subject that moves by itself, and the rates of the gyroscope."""
    place = tmp_path_factory.mktemp("place")
    write_clip(place / "clip.mp4", take(TIMING, SHAKING, subject=walk, count=COUNT))
    write_rates(place / "rates.csv", rates_of_clip())
    return place


def write_clip(path, frames):
    counts = np.repeat(np.clip(np.round(255 * frames.numpy()), 0, 255).astype(np.uint8)[..., None], 3, -1)
    write_sharp(path, counts, np.arange(len(counts)) * TIMING.frame_period, sound="aac")


def steady_command(clip, folder):
    steadied = ("--video", "--steady", "0.333", "--method", "dewarp", "--device", "cpu")
    return ("run", clip, folder / "out", *CAMERA, *steadied)


def shaking(path):
    """Rms displacement (px) of the distant scene from frame to frame."""
    strips = rsv.read_stack(path).double().mean(1).numpy()[:, *STRIP]
    return np.sqrt(np.square(shifts(strips)[2:-2]).sum(-1).mean())


@pytest.mark.slow
def test_the_scene_behind_a_large_subject_becomes_steady(place, tmp_path):
    report = process_video(
        place / "clip.mp4", tmp_path / "steady.mp4", TIMING, gyroscope=place / "rates.csv", **OPTIONS
    )
    assert shaking(place / "clip.mp4") > 4
    assert shaking(tmp_path / "steady.mp4") < 0.15
    assert (report.frames, report.restored) == (COUNT, 1)
    found = rsv.read_manifest(report.manifest).gyroscope
    assert found["orientation"] == "yZx"
    assert found["offset"] == pytest.approx(OFFSET, abs=1e-3)
    assert found["focal_length"] == pytest.approx(FOCAL_LENGTH, rel=0.03)
    assert sound_of(tmp_path / "steady.mp4") == sound_of(place / "clip.mp4")


@pytest.mark.slow
def test_a_fisheye_lens(place, tmp_path, capsys):
    lens = {"camera_matrix": [[2 * FOCAL_LENGTH, 0, 215.5], [0, 2 * FOCAL_LENGTH, 199.5], [0, 0, 1]]}
    lens["distortion_coeffs"] = [-0.6, 0.2, 0.0, 0.0]  # moves the corners by 9 px
    profile = {"calib_dimension": {"w": 432, "h": 400}, "fisheye_params": lens}  # of frames that are twice as large
    (tmp_path / "lens.json").write_text(json.dumps(profile))
    write_clip(tmp_path / "clip.mp4", take(TIMING, SHAKING, count=16, fisheye=lens["distortion_coeffs"]))
    steadied = (*steady_command(tmp_path / "clip.mp4", tmp_path), "--lens-profile", tmp_path / "lens.json")
    assert "--lens-profile belongs to a gyroscope: give gyroscope as well" in refused(capsys, *steadied)
    assert rsvib(*steadied, "--gyroscope", place / "rates.csv") == 0
    assert shaking(tmp_path / "out" / "restored.mp4") < 0.15  # 0.54 without, or the alignment is refused
    assert rsv.read_manifest(tmp_path / "out" / "manifest.json").gyroscope["focal_length"] == FOCAL_LENGTH


def test_the_track_of_the_clip_itself(place, tmp_path, capsys):
    rates = rates_of_clip()
    clip = tmp_path / "clip.mp4"
    clip.write_bytes((place / "clip.mp4").read_bytes())
    arguments = (*steady_command(clip, tmp_path), "--gyroscope", "auto", "--json")
    assert "without a GPMF track" in refused(capsys, *arguments)
    assert not (tmp_path / "out").exists()
    firsts = range(0, len(rates.times) - 299, 300)  # samples of 1 ms
    add_track(clip, [packet(rates.rates[first : first + 300].numpy(), total=first + 300) for first in firsts])
    assert rsvib(*arguments) == 0
    data = json.loads(capsys.readouterr().out)
    assert shaking(tmp_path / "out" / "restored.mp4") < 0.15
    before, after = data["shaking"]["frame_to_frame"]
    assert 0 < after < 1.1 * before + 0.1
    assert not (tmp_path / "out" / "windows.png").exists()  # it would be empty: no tones are searched for


def test_rates_of_another_camera_are_refused(place, tmp_path, capsys):
    write_rates(tmp_path / "other.csv", unrelated_rates(rates_of_clip().times))
    arguments = steady_command(place / "clip.mp4[0:10]", tmp_path)
    assert "does not fit the video" in refused(capsys, *arguments, "--gyroscope", tmp_path / "other.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["other.csv"]


def test_a_pan_of_any_angle_is_kept():
    # A camera that pans by 230 degrees and is tilted; its shaking is about an axis that the pan turns.
    times = np.arange(120) / 30
    pan = Rotation.from_euler("xy", np.stack([0.4 + 0 * times, times], -1))
    angle = 0.01 * np.sin(2 * np.pi * 3 * times)
    shaken = pan * Rotation.from_rotvec(angle[:, None] * [1.0, 0.0, 2.0])
    rates = rsv.AngularRates(torch.arange(8.0), torch.zeros(8, 3))
    path = RecordedRotation(rates, rsv.Camera(500.0), times, shaken)
    moved = steady_shifts(times, path.path, 0.5, (360, 640), 0.1, path.of_frames)[30:-30]
    expected = angle[30:-30, None] * [0.0, 500.0, -2.0, 0.0]
    assert np.abs(expected).max() > 4  # px
    assert np.abs((moved - expected) * [1, 1, 300, 1]).max() < 0.1  # px, at the border of the frame
