"""The reproduction: its camera compared with analytic waves, its MTF with formulas, its statistics, and a small run."""

import json
import math
import re

import numpy as np
import pytest
import reproduce
from benchmarks.independent_camera import Shake, fine_rows
from edge_truth import draw_edge, gaussian, through_pixels
from reproduction.esfr import crossing, straight_edge_mtf
from reproduction.paper import AMPLITUDE, DETECTED, PERIOD, RESTORED
from reproduction.scenes import PITCH, Scene, shake_of, take_frames
from reproduction.trials import GlobalShutter, detection_values

import rsvib_torch as rsv


@pytest.mark.parametrize("wave", [(9, 0), (0, 11), (-40, 31)])
@pytest.mark.parametrize("row_time", [2e-4, 0.0])
def test_frames_of_the_camera_equal_the_integral_of_a_wave(wave, row_time):
    margin, size = (20, 16), (40, 36)
    whole = [PITCH * (s + 2 * m) for s, m in zip(size, margin, strict=True)]
    y, x = np.meshgrid(*(np.arange(n) for n in whole), indexing="ij")
    turn = 2 * np.pi * np.array([wave[0] / whole[1], wave[1] / whole[0]])
    samples = 0.5 + 0.3 * np.cos(turn[0] * x + turn[1] * y)
    down, across = (PITCH * m for m in margin)
    still = samples[down:-down:PITCH, across:-across:PITCH]
    shake = Shake(
        np.array([[1.3], [2.1]]), np.array([[50.0], [30.0]]), np.array([[0.4], [1.3]]), np.array([40.0, -30.0])
    )
    timing = GlobalShutter(row_time, 8e-4, 0.012)
    frames = take_frames(Scene(samples, fine_rows(samples, 4), still, margin), shake, timing, 2)
    assert frames.shape == (2, *size)
    rows, columns = np.arange(size[0]), np.arange(size[1])
    for p in range(2):
        times = p * 0.012 + rows[:, None] * row_time + (np.arange(400) + 0.5) / 400 * 8e-4
        moved = [
            a * np.sin(2 * np.pi * f * times + phase) + v * times
            for a, f, phase, v in ((1.3, 50.0, 0.4, 40.0), (2.1, 30.0, 1.3, -30.0))
        ]
        place = [down + PITCH * (rows[:, None] - moved[1]), across - PITCH * moved[0]]
        angle = (turn[1] * place[0] + turn[0] * place[1])[:, None, :]
        angle = angle + (turn[0] * PITCH * columns)[None, :, None]
        expected = 0.5 + 0.3 * np.cos(angle).mean(-1)
        np.testing.assert_allclose(frames[p], expected, rtol=0, atol=3e-5)
        assert np.abs(frames[p] - still).max() > 0.02


@pytest.mark.parametrize("angle", [-6.0, 5.0])
def test_straight_edge_mtf(angle):
    frequency = np.linspace(0.0, 0.5, 51)
    for levels in ((0.1, 0.9), (0.9, 0.1)):
        roi = draw_edge(angle, 0.5, levels=levels)
        truth = through_pixels(gaussian(0.5), angle)(frequency)
        found = straight_edge_mtf(roi, frequency)
        np.testing.assert_allclose(found, truth, rtol=0, atol=0.012)
        assert crossing(frequency, found) == pytest.approx(crossing(frequency, truth), rel=0.01)
    bent = np.stack([np.roll(row, round(3 * math.sin(i / 12))) for i, row in enumerate(roi)])
    assert straight_edge_mtf(bent, frequency)[25] < 0.7 * truth[25]
    assert math.isnan(crossing(frequency, np.ones(51)))


def test_errors_are_signed_and_phases_wrapped():
    shake = shake_of(4)
    phase = shake.phase[:, 0]
    found = rsv.Vibration([3.1 * 1.02, 5.2 * 0.99], [50.0 / 1.001, 30.0], phase + np.array([0.02, -2.01]) * np.pi)
    result = type("Result", (), {"vibration": found, "reliable": [True, False]})()
    values = detection_values(result, shake)
    assert values["x"]["amplitude_error"] == pytest.approx(2.0)
    assert values["x"]["period_error"] == pytest.approx(0.1)
    assert values["x"]["phase_error"] == pytest.approx(0.02)
    assert values["y"]["amplitude_error"] == pytest.approx(-1.0)
    assert values["y"]["phase_error"] == pytest.approx(-0.01)
    assert (values["x"]["reliable"], values["y"]["reliable"]) == (True, False)


def test_percentages_of_the_paper_agree_with_its_values():
    for lines in DETECTED.values():
        for axis, line in lines.items():
            assert line.period_error == pytest.approx(100 * abs(line.period / PERIOD[axis] - 1), abs=0.015)
            assert line.amplitude_error == pytest.approx(100 * abs(line.amplitude / AMPLITUDE[axis] - 1), abs=0.015)
    for lines in RESTORED.values():
        for line in lines.values():
            for before, after, gain in zip(line.degraded, line.restored, line.improvement, strict=True):
                assert gain == pytest.approx(100 * (after / before - 1), abs=0.05)


def test_small_run(tmp_path, capsys):
    out = tmp_path / "reproduction"
    reproduce.main(["--tiny", "--out", str(out)])
    assert str(out) in capsys.readouterr().out
    data = json.loads((out / "reproduction.json").read_text(encoding="utf-8"))
    cells = data["cells"]
    assert len(cells) == 2 * 4 + 16 + 8
    errors = [cell for cell in cells if cell["row"].startswith("error")]
    assert all(cell["default_better_worst"] for cell in errors)
    assert all(cell["ours"]["default"]["worst"] < 0.3 for cell in errors)
    for trials in data["trials"].values():
        (trial,) = trials
        for before, after in zip(trial["degraded"]["psnr"], trial["restoration"]["default"]["psnr"], strict=True):
            assert before < 20
            assert after > 36
    for axis, true in (("x", 2.409), ("y", 6.205)):  # 50 and 30 Hz less multiples of 23.795 Hz
        assert data["global_shutter"]["found"][axis] == pytest.approx(true, abs=0.02)
    text = (out / "reproduction.md").read_text(encoding="utf-8")
    for title in ("Table 2", "Table 3", "Table 4", "MTF", "Push-scan", "50 Hz from 24 frames per second"):
        assert re.search(rf"^## {title}", text, re.MULTILINE)
    assert "nan" not in text
    for name in ("detection_errors", "global_shutter"):
        assert (out / f"{name}.png").stat().st_size > 5000
