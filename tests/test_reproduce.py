"""The reproduction: its MTF compared with formulas, its statistics, and a small run."""

import json
import math
import re

import numpy as np
import pytest
import reproduce
from edge_truth import draw_edge, gaussian, through_pixels
from reproduction.esfr import crossing, straight_edge_mtf
from reproduction.paper import AMPLITUDE, DETECTED, PERIOD, RESTORED
from reproduction.scenes import shake_of
from reproduction.trials import detection_values

import rsvib_torch as rsv


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
