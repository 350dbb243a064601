"""The reproduction of the paper: its MTF compared with formulas, its statistics, and a small run."""

import math

import numpy as np
import pytest
from benchmark import parsed
from benchmarks import reproduction
from benchmarks.reproduction import straight_edge_mtf
from edge_truth import draw_edge, gaussian, through_pixels


@pytest.mark.parametrize("angle", [-6.0, 5.0])
def test_straight_edge_mtf(angle):
    frequency = np.linspace(0.0, 0.5, 51)
    for levels in ((0.1, 0.9), (0.9, 0.1)):
        roi = draw_edge(angle, 0.5, levels=levels)
        truth = through_pixels(gaussian(0.5), angle)(frequency)
        found = straight_edge_mtf(roi, frequency)
        np.testing.assert_allclose(found, truth, rtol=0, atol=0.012)
    bent = np.stack([np.roll(row, round(3 * math.sin(i / 12))) for i, row in enumerate(roi)])
    assert straight_edge_mtf(bent, frequency)[25] < 0.7 * truth[25]


def test_small_run():
    options = parsed(["--only", "reproduction", "--quick"])
    results = reproduction.rows(options)
    found = reproduction.chosen(results, part="detection", method=reproduction.DEFAULT)
    assert len(found) == 4
    assert max(abs(row[f"{quantity}_error"]) for row in found for quantity in ("period", "amplitude")) < 0.3
    for target in reproduction.TARGETS:
        of_target = reproduction.chosen(results, target=target, part="restoration")
        for method, least, most in ((reproduction.DEGRADED, 0, 20), (reproduction.DEFAULT, 36, 60)):
            assert all(least < row["psnr"] < most for row in reproduction.chosen(of_target, method=method))
    text = "\n".join(reproduction.lines(results, options))
    assert len(reproduction.detection_cells(results)) == 12
    assert len(reproduction.restoration_cells(results)) == 12
    assert "nan" not in text
