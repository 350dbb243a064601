"""Alignment of a gyroscope with frames of an independent camera: axes, bias, clock, focal length, row time."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from gpmf_file import write_rates
from program import refused, rsvib
from refusals import refuses
from rotating_camera import BIAS, COUNT, FOCAL_LENGTH, OFFSET, TIMING, attitude, recorded, take, unrelated_rates

import rsvib_torch as rsv
from rsvib_torch.gyroscope.corner_tracks import CornerTracks, corner_tracks
from rsvib_torch.gyroscope.rotation_alignment import AlignOptions, align_rates
from rsvib_torch.gyroscope.rotation_search import ORIENTATIONS, search_orientations
from rsvib_torch.results.reason import Reason


@pytest.fixture(scope="module", name="frames")
def make_frames():
    return take(TIMING)


@pytest.fixture(scope="module", name="tracks")
def make_tracks(frames):
    starts = TIMING.frame_starts(len(frames)).tolist()
    return corner_tracks(((number, frame, None) for number, frame in enumerate(frames)), starts, TIMING)


def aligned(tracks, rates, camera=None, offsets=(OFFSET - 0.05, OFFSET + 0.05)):
    """``align_motion`` of frames whose corners were followed before; the clock is searched within these offsets."""
    return align_rates(tracks, TIMING, rates, AlignOptions(camera=camera, offsets=offsets))


def check(found, orientation, *, limit=4.0):
    """Values within ``limit`` standard deviations, and close."""
    assert found.reliable, found.reasons
    assert found.orientation == orientation
    assert abs(found.offset - OFFSET) < min(limit * found.offset_std, 1e-3)
    error = (found.bias - torch.tensor(BIAS, dtype=torch.float64)).abs()
    assert bool((error < (limit * found.bias_std).clamp(max=8e-3)).all()), (error, found.bias_std)
    assert abs(found.focal_length - FOCAL_LENGTH) <= min(limit * found.focal_length_std, 8.0)


def test_everything_from_the_frames(frames):
    found = rsv.align_motion(frames, TIMING, recorded("yZx"))
    check(found, "yZx")
    assert found.offset_std < 5e-4
    assert abs(found.scale - 1.0) < 4 * found.scale_std < 0.02
    assert found.measured.shape == (COUNT - 1, 3)
    assert float((found.measured - found.predicted)[:, :2].abs().max()) < 0.05  # px
    # the motion: content that is displaced by it comes to rest
    restored = rsv.restore(frames, TIMING, found.motion, check=False)
    before, after = (
        (images[1:] - images[:-1])[:, 20:-20, 20:-20].square().mean().sqrt() for images in (frames, restored)
    )
    assert float(after) < 0.25 * float(before)


def test_row_time(frames):
    start = replace(TIMING, row_time=6e-5, exposure_rows=10 * 8 / 6, frame_rows=420 * 8 / 6)
    camera = rsv.Camera(FOCAL_LENGTH)
    found = rsv.align_motion(frames, start, recorded("ZXY"), camera=camera, fit_row_time=True)
    assert found.reliable, found.reasons
    assert abs(found.row_time - 8e-5) < min(4 * found.row_time_std, 2e-6)
    assert found.focal_length == FOCAL_LENGTH
    assert found.focal_length_std == 0.0


def test_other_readout():
    timing = replace(TIMING, scan_axis="x", readout_direction="reverse")
    check(rsv.align_motion(take(timing), timing, recorded("XYZ")), "XYZ")


def test_fisheye_lens():
    """A lens that moves the corners by 9 px: without it, pans do not explain the displacements at the border."""
    lens = (-0.6, 0.2, 0.0, 0.0)
    frames, limits = take(TIMING, fisheye=lens), (OFFSET - 0.01, OFFSET + 0.01)
    camera = rsv.Camera(FOCAL_LENGTH, distortion=lens, fisheye=True)
    found = rsv.align_motion(frames, TIMING, recorded("yZx"), camera=camera, offsets=limits)
    check(found, "yZx")
    plain = rsv.align_motion(frames, TIMING, recorded("yZx"), offsets=limits)
    assert plain.corner_std > 1.5 * found.corner_std
    left = []
    for motion in (found.motion, plain.motion):
        restored = rsv.restore(frames, TIMING, motion, check=False, method="dewarp")[:, 6:-6, 6:-6]
        left.append(float((restored[1:] - restored[:-1]).square().mean().sqrt()))
    assert left[0] < 0.8 * left[1]


def test_search_finds_all_24_orientations(tracks):
    assert len(ORIENTATIONS) == 24
    for name in ORIENTATIONS:
        limits = (OFFSET - 0.02, OFFSET + 0.02)
        information = torch.eye(2, dtype=torch.float64).expand(len(tracks.pair), 2, 2)
        starts, _, mirrored = search_orientations(tracks, information, recorded(name), TIMING.row_time, limits, None)
        assert starts[0].orientation == name
        assert abs(starts[0].offset - OFFSET) < 2e-3
        assert starts[1].cost > 4 * starts[0].cost
        assert mirrored is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ORIENTATIONS)
def test_all_24_orientations(tracks, name):
    check(aligned(tracks, recorded(name)), name, limit=5.0)


def test_errors_contain_the_noise_of_the_rates(tracks):
    """It turns all corners of a row alike: as for errors of independent corners, one value was beyond 4."""
    clean, errors = recorded(), []
    for seed in range(3):
        noise = 0.02 * torch.randn(clean.rates.shape, generator=torch.Generator().manual_seed(seed)).double()
        found = aligned(tracks, replace(clean, rates=clean.rates + noise), rsv.Camera(FOCAL_LENGTH))
        errors += [(found.offset - OFFSET) / found.offset_std, (found.scale - 1.0) / found.scale_std]
    assert max(map(abs, errors)) < 3


@pytest.mark.parametrize("factor", [math.pi / 180, 180 / math.pi])
def test_a_wrong_unit_of_the_rates_is_named(tracks, factor):
    rates = recorded()
    found = aligned(tracks, replace(rates, rates=factor * rates.rates))
    assert not found.reliable
    assert any("check the unit of the rates" in reason for reason in found.reasons)


def test_dashboard_is_excluded():
    camera, limits = rsv.Camera(FOCAL_LENGTH), (OFFSET - 0.05, OFFSET + 0.05)
    found = rsv.align_motion(take(TIMING, dashboard=60), TIMING, recorded(), camera=camera, offsets=limits)
    assert found.orientation == "XYZ"
    assert abs(found.offset - OFFSET) < 1e-3
    assert float((found.bias - torch.tensor(BIAS, dtype=torch.float64)).abs().max()) < 0.02


def test_command_estimates_clock_and_row_time(frames, tmp_path, capsys):
    (tmp_path / "camera.toml").write_text("[sensor]\nrow_time = 7e-5\nexposure_rows = 11.4\nframe_rows = 480\n")
    rsv.write_stack(tmp_path / "frames.tif", frames)
    rates = recorded("ZXY")
    write_rates(tmp_path / "rates.csv", rates)
    known = ("restore", tmp_path / "frames.tif", tmp_path / "out.tif", "--config", tmp_path / "camera.toml")
    arguments = (*known, "--motion", tmp_path / "rates.csv", "--focal-length", 380, "--device", "cpu")
    log = "GYROFLOW IMU LOG\nversion,1.3\nid,test\norientation,XYZ\ntscale,1e-6\ngscale,1e-6\nt,gx,gy,gz\n"
    scaled = 1e6 * torch.cat([rates.times[:, None], rates.rates], 1)
    (tmp_path / "clip.gcsv").write_text(log + "\n".join(",".join(f"{v:.0f}" for v in row) for row in scaled.tolist()))
    (tmp_path / "right.toml").write_text("[sensor]\nrow_time = 8e-5\nexposure_rows = 10\nframe_rows = 420\n")
    of_log = (*known[:3], "--config", tmp_path / "right.toml", "--motion", tmp_path / "clip.gcsv", "--json")
    assert rsvib(*of_log) == 0
    found = json.loads(capsys.readouterr().out)["alignment"]
    assert (found["orientation"], found["offset"]) == ("ZXY", pytest.approx(0.35, abs=1e-3))
    assert found["focal_length"] == pytest.approx(FOCAL_LENGTH, rel=0.02)
    restored = rsv.read_stack(tmp_path / "out.tif")
    before, after = (float((one[1:] - one[:-1])[..., 20:-20, 20:-20].square().mean()) for one in (frames, restored))
    assert after < 0.1 * before
    alone = ("--offset", 0.35, "--overwrite")
    assert "axes and clock of a gyroscope are estimated from the frames" in refused(capsys, *arguments, *alone)


def test_rows_that_do_not_count(tmp_path, capsys):
    """A dashboard on two thirds of the frames hides the axes and the clock."""
    rsv.write_stack(tmp_path / "frames.tif", take(TIMING, dashboard=130))
    (tmp_path / "camera.toml").write_text("[sensor]\nrow_time = 8e-5\nexposure_rows = 10\nframe_rows = 420\n")
    write_rates(tmp_path / "rates.csv", recorded("ZXY"))
    known = ("restore", tmp_path / "frames.tif", tmp_path / "out.tif", "--config", tmp_path / "camera.toml")
    known += ("--motion", tmp_path / "rates.csv", "--device", "cpu", "--force", "--overwrite", "--json")
    found = []
    for more in ([], ["--ignore", "70:140,:", "--ignore", "140:"]):
        assert rsvib(*known, *more) == 0
        found.append(json.loads(capsys.readouterr().out)["alignment"])
    assert not found[0]["reliable"]
    assert (found[1]["orientation"], found[1]["offset"]) == ("ZXY", pytest.approx(OFFSET, abs=5e-4))
    assert "such as 400: or :60,500:, got '70'" in refused(capsys, *known, "--ignore", "70")
    assert "no pixel of frames of 200 rows and 216 columns" in refused(capsys, *known, "--ignore", "200:")


def test_mirrored_axes_are_refused(tracks):
    found = aligned(tracks, recorded(mirrored=-1.0))
    assert not found.reliable
    assert Reason("axes_mirrored", details={"axes": "xYZ"}) in found.findings


def test_recording_of_another_motion_is_refused(tracks):
    found = aligned(tracks, unrelated_rates(recorded().times), offsets=None)
    assert not found.reliable
    assert "recording_incomplete" in {reason.code for reason in found.findings}


def test_offset_outside_the_given_ones_is_refused(tracks):
    found = aligned(tracks, recorded(), rsv.Camera(FOCAL_LENGTH), (OFFSET + 0.004, OFFSET + 0.01))
    assert "offset_outside" in {reason.code for reason in found.findings}


def test_rest_is_refused():
    found = rsv.align_motion(take(TIMING, 0.002), TIMING, recorded(size=0.002), camera=rsv.Camera(FOCAL_LENGTH))
    assert not found.reliable
    assert "recorded_motion_too_small" in {reason.code for reason in found.findings}


def test_one_axis_alone_leaves_the_others_open(tracks):
    # the camera turns about its y axis only: the assignment of x and z, and their signs, are not determined
    rates = recorded()
    alone = torch.zeros_like(rates.rates)
    alone[:, 1] = rates.rates[:, 1] - BIAS[1]
    shifted = rsv.AngularRates(rates.times - OFFSET, alone)
    first, last = tracks.times(TIMING.row_time).unbind(-1)
    yaw = shifted.rotation(first, last)[:, 1]
    noise = 0.01 * torch.randn(len(yaw), 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    only_x = replace(tracks, offsets=torch.stack([-FOCAL_LENGTH * yaw, 0 * yaw], -1) + noise)
    found = aligned(only_x, rsv.AngularRates(rates.times, alone), rsv.Camera(FOCAL_LENGTH))
    assert not found.reliable
    assert "axes_ambiguous" in {reason.code for reason in found.findings}


def test_arguments(frames):
    rates = recorded()
    motion = rsv.FreeMotion.from_samples(torch.linspace(0, 1, 20), torch.zeros(20, 2))
    refuses(lambda: rsv.align_motion(frames, TIMING, motion), "recorded must be AngularRates", TypeError)
    with pytest.raises(ValueError, match=r"the recording of 0\.01 s is shorter than the frames"):
        rsv.align_motion(frames, TIMING, rsv.AngularRates(rates.times[:11], rates.rates[:11]))
    ramp = torch.linspace(0, 1, frames.shape[-1]).expand_as(frames) + 0.01 * torch.arange(COUNT)[:, None, None]
    refuses(lambda: rsv.align_motion(ramp, TIMING, rates), "only 0 of 3 pairs of frames have 12 corners")
    refuses(lambda: rsv.AngularRates(rates.times.flip(0), rates.rates), "times must increase")


def test_translation_of_the_camera_is_no_bias():
    # Corners of a pinhole camera at random distances, two fifths of them near, a quarter fixed to the camera.
    random = np.random.default_rng(3)
    axes, speed = "XYZ", (0.1, -0.05, 0.6)  # m/s
    pairs, corners, row_time = 20, 240, 5e-5  # s
    timing = rsv.SensorTiming(row_time, 1, 660)
    pair = np.repeat(np.arange(pairs), corners)
    place = random.uniform((-320, -240), (320, 240), (len(pair), 2))
    distance = np.where(
        random.random(len(pair)) < 0.4, random.uniform(1, 3, len(pair)), random.uniform(6, 60, len(pair))
    )
    ray = np.concatenate([place / 500.0, np.ones((len(pair), 1))], -1)
    start = pair * timing.frame_period
    moved = place.copy()
    for _ in range(5):  # the row in the later frame depends on the displacement
        t = np.stack(
            [start + (place[:, 1] + 239.5) * row_time, start + timing.frame_period + (moved[:, 1] + 239.5) * row_time]
        )
        first, last = (attitude(one + 0.5 * timing.exposure_time, 3.0) for one in t)  # of a vehicle on a rough road
        point = first.apply(ray * distance[:, None]) - (t[1] - t[0])[:, None] * first.apply(np.array(speed))
        seen = last.inv().apply(point)
        moved = 500.0 * seen[:, :2] / seen[:, 2:]
    rows = np.stack([place[:, 1], moved[:, 1]], -1) + 239.5
    offsets = moved - place + 0.03 * random.standard_normal(place.shape)
    fixed = place[:, 1] > 120
    offsets[fixed] = 0.03 * random.standard_normal(place.shape)[fixed]
    cell = ((place[:, 1] + 240) // 80 * 8 + (place[:, 0] + 320) // 80).astype(int)
    tables = (torch.from_numpy(values) for values in (pair, cell, rows, place, offsets))
    starts = timing.frame_period * torch.arange(pairs + 1, dtype=torch.float64).unfold(0, 2, 1)
    tracks = CornerTracks(*tables, starts=starts, size=(480, 640), exposure_time=timing.exposure_time)
    found = align_rates(
        tracks, replace(timing, row_time=4.5e-5), recorded(axes, 3.0, count=22), AlignOptions(fit_row_time=True)
    )
    assert found.reliable, found.reasons
    assert found.orientation == axes
    assert abs(found.offset - OFFSET) < min(4 * found.offset_std, 3e-4)
    assert abs(found.focal_length - 500.0) < min(4 * found.focal_length_std, 5.0)
    assert abs(found.row_time - row_time) < min(4 * found.row_time_std, 1e-6)
    error = (found.bias - torch.tensor(BIAS, dtype=torch.float64)).abs()
    assert bool((error < (4 * found.bias_std).clamp(max=5e-3)).all()), (error, found.bias_std)
    mean = found.translation.mean(0).numpy()
    assert mean @ speed > 0.97 * np.linalg.norm(mean) * np.linalg.norm(speed)
