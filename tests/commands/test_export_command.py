"""``rsvib export``: files for other programs from a vibration.json."""

import json

import numpy as np
import pytest
import torch
from program import refused, rsvib

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

TIMING = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
VIBRATION = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), TIMING, VIBRATION, num_frames=2)
    rsv.write_stack(folder / "frames.tif", frames, dtype="uint16", full_scale=4095)
    detected = rsv.detect_vibration(frames, TIMING)
    assert detected.reliable.all()
    detected.save(folder / "vibration.json")
    return folder, detected, tuple(frames.shape[-2:])


def test_gcsv_with_a_focal_length(place, tmp_path, capsys):
    folder, detected, size = place
    out = tmp_path / "clip.gcsv"
    frames = ("--frames", folder / "frames.tif")
    assert rsvib("export", folder / "vibration.json", out, *frames, "--focal-length", 900, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["size"], answer["num_frames"]) == (list(size), 2)
    first = out.read_text().split("t,gx,gy,gz\n")[1].splitlines()[0]
    tone = detected.vibration
    rate = float(tone.amplitude[1, 0] * 2 * np.pi * tone.frequency[1, 0] * torch.cos(tone.phase[1, 0])) / 900
    assert float(first.split(",")[1]) * 1e-9 == pytest.approx(rate, rel=1e-3)
    assert "require the focal length in px" in refused(
        capsys, "export", folder / "vibration.json", tmp_path / "other.gcsv", *frames
    )


def test_axes_that_are_not_reliable_are_left_out(place, tmp_path, capsys):
    folder, _, _ = place
    data = json.loads((folder / "vibration.json").read_text())
    path, blind = tmp_path / "doubtful.json", {"code": "of a later version", "text": "blind"}
    options = ("--frames", folder / "frames.tif[0:1]", "--focal-length", 900)

    def pitch(out):  # about x, from the motion along y
        return np.loadtxt(out.read_text().split("t,gx,gy,gz\n")[1].splitlines(), delimiter=",")[:, 1]

    path.write_text(json.dumps(data | {"reliable": [True, False], "findings": [[], [blind]]}))
    assert rsvib("export", path, tmp_path / "rates.gcsv", *options) == 0
    assert "y is not exported: its vibration is not reliable (blind)" in " ".join(capsys.readouterr().err.split())
    assert np.abs(pitch(tmp_path / "rates.gcsv")).max() == 0
    assert rsvib("export", path, tmp_path / "forced.gcsv", *options, "--force") == 0
    assert np.abs(pitch(tmp_path / "forced.gcsv")).max() > 0
    path.write_text(json.dumps(data | {"reliable": [False, False], "findings": [[blind], [blind]]}))
    assert "--overwrite" in refused(capsys, "export", path, tmp_path / "rates.gcsv", *options, "--force")
    assert "nothing to export" in refused(capsys, "export", path, tmp_path / "none.gcsv", *options)
    assert not (tmp_path / "none.gcsv").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("vibration.json", "clip.xyz", "--frames", "frames.tif"), "ends with .gcsv"),
        (("vibration.json", "vibration.json", "--frames", "frames.tif"), "it is the input"),
        (("vibration.json", "clip.gcsv", "--focal-length", "900"), "Missing option '--frames'"),
    ],
)
def test_errors_are_one_line(place, monkeypatch, capsys, arguments, message):
    folder, _, _ = place
    monkeypatch.chdir(folder)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    error = refused(capsys, "export", *arguments)
    assert message in error
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
