"""``rsvib known`` with the log of a gyroscope."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import rsvib_torch as rsv
from rsvib_torch.commands.main import run_command
from rsvib_torch.evaluation.scenes import city_and_fields

CONFIG = "[sensor]\nrow_time = 8e-5\nexposure_rows = 10\nframe_rows = 420\n"
FOCAL_LENGTH = 400.0


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    """Frames of a camera that turns about all axes, and the log of its gyroscope, whose clock is 0.2 s ahead."""
    place = tmp_path_factory.mktemp("place")
    times = np.arange(-0.05, 0.2, 1e-3)
    angles = [
        a * np.sin(2 * np.pi * f * times + p) for a, f, p in ((5e-3, 8.3, 0.2), (4e-3, 11.9, 1.0), (6e-3, 7.1, 2.0))
    ]
    vectors = np.stack(angles, -1)
    turned = Rotation.from_rotvec(vectors)
    rates = (turned[:-2].inv() * turned[2:]).as_rotvec() / 2e-3
    moved = np.stack([-FOCAL_LENGTH * vectors[:, 1], FOCAL_LENGTH * vectors[:, 0], -vectors[:, 2]], -1)
    camera = rsv.Camera(FOCAL_LENGTH)
    motion = rsv.FreeMotion.from_samples(torch.from_numpy(times), torch.from_numpy(moved), spacing=1e-3, camera=camera)
    timing = rsv.SensorTiming(row_time=8e-5, exposure_rows=10, frame_rows=420)
    noise = rsv.SensorNoise(read_noise=0.004)
    rsv.write_stack(
        place / "frames.npy", rsv.simulate_frames(city_and_fields(224, 240, seed=2), timing, motion, 3, noise=noise)
    )
    (place / "camera.toml").write_text(CONFIG)
    head = ["GYROFLOW IMU LOG", "version,1.3", "id,test", "orientation,XYZ", "tscale,1e-6", "gscale,1e-6", "t,gx,gy,gz"]
    rows = [
        f"{1e6 * (time + 0.2):.0f},{x * 1e6:.0f},{z * 1e6:.0f},{-y * 1e6:.0f}"
        for time, (x, y, z) in zip(times[1:-1], rates, strict=True)
    ]
    (place / "clip.gcsv").write_text("\n".join([*head, *rows]))
    return place


def known(place, target, *options):
    paths = [place / "frames.npy", target, "--config", place / "camera.toml", "--motion", place / "clip.gcsv"]
    return run_command(["known", *map(str, paths), "--device", "cpu", *options])


def test_gyroscope_log_restores_the_frames(place, tmp_path, capsys):
    assert known(place, tmp_path / "restored.npy", "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["alignment"]["orientation"] == "XzY"
    assert data["alignment"]["offset"] == pytest.approx(0.2, abs=1e-3)
    assert data["alignment"]["focal_length"] == pytest.approx(FOCAL_LENGTH, rel=0.02)
    frames, restored = (rsv.read_stack(folder) for folder in (place / "frames.npy", tmp_path / "restored.npy"))
    before, after = ((images[1] - images[0])[20:-20, 20:-20].square().mean().sqrt() for images in (frames, restored))
    assert float(after) < 0.3 * float(before)


def test_options_of_tables_are_refused(place, tmp_path, capsys):
    assert known(place, tmp_path / "restored.npy", "--offset", "0") == 2
    assert "axes and clock of a gyroscope are estimated from the frames" in capsys.readouterr().err
    assert not (tmp_path / "restored.npy").exists()
