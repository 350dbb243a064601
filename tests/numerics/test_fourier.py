"""Boundary extension of rows and fast lengths."""

import pytest
import torch

from rsvib_torch.numerics.fourier import extend_rows, extended_length


@pytest.mark.parametrize("hold", [0.0, 0.25])
@pytest.mark.parametrize(("width", "length"), [(100, 160), (40, 200), (9, 64)])
def test_extended_rows_close_smoothly_into_a_period(width, length, hold):
    """The image is unchanged, and no step of the extension is steeper than the reflected image allows."""
    places = torch.arange(width, dtype=torch.float64)
    rows = torch.stack([0.05 * places, torch.sin(0.2 * places), 3.0 - 0.02 * places])
    period = extend_rows(rows, length, hold)
    assert period.shape == (3, length)
    assert torch.equal(period[:, :width], rows)
    steps = (period.roll(-1, -1) - period).abs()
    assert bool((steps[:, width - 1 :].amax(-1) < 0.25 + 0.2 * (rows[:, -1] - rows[:, 0]).abs()).all())
    slope = rows[:, -1] - rows[:, -2]
    torch.testing.assert_close(period[:, width] - rows[:, -1], slope, rtol=0, atol=0.02)


def test_held_share_of_the_gap_contains_one_end_only():
    """Content of the opposite end appears beyond a quarter of the gap only."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.rand(1, 64, generator=generator)
    other = rows.clone()
    other[:, :20] = 5.0
    length = extended_length(64, 8)
    quarter = (length - 64) // 4
    assert quarter >= 16
    held, changed = (extend_rows(images, length) for images in (rows, other))
    assert torch.equal(held[:, 64 : 64 + quarter], changed[:, 64 : 64 + quarter])
    assert not torch.equal(held[:, 64 + 2 * quarter :], changed[:, 64 + 2 * quarter :])
    assert extend_rows(rows, 64) is rows
