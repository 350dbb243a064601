"""Detection of slanted edges: all edges of a chart, and no others."""

import numpy as np
import pytest
import torch
from edge_truth import draw_edge, gaussian, mtf50_of
from scipy.ndimage import rotate

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields, resolution_chart


def test_every_edge_of_the_chart_is_found_and_measures_the_optics():
    chart = resolution_chart(640, 512, sigma=0.7)
    edges = rsv.find_slanted_edges(chart)
    assert len(edges) >= 16
    truth = gaussian(0.7)
    for edge in edges:
        assert abs(edge.angle) == pytest.approx(5.0, abs=0.02)
        assert edge.contrast == pytest.approx(0.5, abs=0.06)  # 0.62 - 0.12 and 0.74 - 0.20
        curve = rsv.slanted_edge_mtf(edge.crop(chart))
        assert curve.angle == pytest.approx(edge.angle, abs=0.02)
        assert curve.near_vertical == edge.near_vertical
        assert float(curve.mtf50) == pytest.approx(mtf50_of(truth), rel=1e-3)
        assert float(curve.at(0.4)) == pytest.approx(truth(0.4), abs=1e-3)
    kinds = {(edge.near_vertical, edge.angle > 0, edge.bright_side) for edge in edges}
    assert len(kinds) == 8


def test_rotated_and_noisy_chart():
    turn = -8.0  # degrees
    chart = rotate(resolution_chart(512, 512).numpy(), turn, reshape=False, order=3, mode="nearest")
    chart = torch.from_numpy(chart + 0.01 * np.random.default_rng(0).standard_normal(chart.shape).astype(np.float32))
    longest = [edge for edge in rsv.find_slanted_edges(chart, min_length=45) if edge.contrast < 0.56]
    expected_angles = {round(abs(turn - 5)), round(abs(turn + 5))}
    squares = [edge for edge in longest if round(abs(edge.angle)) in expected_angles]
    assert len(squares) >= 8
    for edge in squares:
        curve = rsv.slanted_edge_mtf(edge.crop(chart))
        assert curve.angle == pytest.approx(edge.angle, abs=0.4)
        assert 0.26 < float(curve.mtf50) < 0.33  # 0.312 before rotation


@pytest.mark.parametrize("turned", [False, True])
def test_position_polarity_and_scale(turned):
    image = np.full((150, 200), 400.0)
    image[20:130, 60:140] = draw_edge(-4.0, 0.7, (110, 80), (400.0, 900.0), (0.0, 0.0))
    image[20:130, 140:] = image[20:130, 139:140]
    image = torch.from_numpy(np.ascontiguousarray(image.T if turned else image))
    (edge,) = [edge for edge in rsv.find_slanted_edges(image) if edge.near_vertical is not turned]
    assert edge.bright_side == ("bottom" if turned else "right")
    assert edge.contrast == pytest.approx(500, rel=0.01)
    assert abs(edge.angle) == pytest.approx(4.0, abs=0.02)
    begin, size = (edge.left, edge.height) if turned else (edge.top, edge.width)
    assert begin >= 20
    assert edge.crop(image).shape == (edge.height, edge.width)
    assert edge.crop(torch.stack([image, image])).shape == (2, edge.height, edge.width)
    assert size > 30
    assert rsv.find_slanted_edges(-image)[0].bright_side == ("top" if turned else "left")


def test_no_edge_is_found_in_images_without_edges():
    assert rsv.find_slanted_edges(city_and_fields(300, 300, seed=3)) == []
    assert rsv.find_slanted_edges(torch.zeros(100, 100)) == []
    assert rsv.find_slanted_edges(torch.zeros(8, 100)) == []
    noise = torch.randn(200, 200, generator=torch.Generator().manual_seed(0))
    assert rsv.find_slanted_edges(noise) == []
    upright = torch.zeros(100, 100)
    upright[:, 50:] = 1.0
    assert rsv.find_slanted_edges(upright) == []
