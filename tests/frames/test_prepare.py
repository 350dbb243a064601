"""Input preparation and the way back, for every layout, orientation and dtype."""

import itertools
import math

import numpy as np
import pytest
import torch

from rsvib_torch import SensorTiming
from rsvib_torch.frames.prepare import prepare_frames

ORIENTATIONS = list(itertools.product((-2, -1), ("forward", "reverse")))
LAYOUTS = [(2, 5, 7), (2, 3, 5, 7), (4, 2, 3, 5, 7)]


def sensor(scan_axis=-2, direction="forward"):
    return SensorTiming(20e-6, 20, 2048, scan_axis=scan_axis, readout_direction=direction)


@pytest.mark.parametrize(("scan_axis", "direction"), ORIENTATIONS)
@pytest.mark.parametrize("shape", LAYOUTS)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_round_trip(shape, scan_axis, direction, dtype):
    frames = torch.rand(shape, dtype=torch.float64).to(dtype)
    prepared = prepare_frames(frames, sensor(scan_axis, direction))
    height, width = (5, 7) if scan_axis == -2 else (7, 5)
    channels = 1 if len(shape) == 3 else 3
    assert prepared.images.shape == (4 if len(shape) == 5 else 1, 2, channels, height, width)
    assert prepared.images.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    row = frames.select(scan_axis, -1 if direction == "reverse" else 0)
    assert torch.equal(prepared.images[..., 0, :].flatten(), row.flatten().to(prepared.images.dtype))
    assert (prepared.timing.scan_axis, prepared.timing.readout_direction) == (-2, "forward")
    assert prepared.missing is prepared.saturated is None
    assert prepared.filled is prepared.images
    back = prepared.from_row_order(prepared.images)
    assert back.dtype == dtype
    assert torch.equal(back, frames)


def test_masks_follow_the_frames():
    """NaN, ignored and saturated pixels, in counts and floats, turned with the frames."""
    frames = torch.full((2, 3, 4, 6), 0.5)
    frames[0, 1, 2, 3] = math.nan
    frames[1, 2, 0, 5] = 0.9
    ignore = torch.zeros(4, 6, dtype=torch.bool)
    ignore[3, 0] = True
    frames[:, :, 3, 0] = math.inf  # ignored pixels may hold any value
    timing = sensor(-1, "reverse")
    prepared = prepare_frames(frames, timing, ignore=ignore, saturation=0.8)
    missing, saturated = (prepared.from_row_order(mask.float()) for mask in (prepared.missing, prepared.saturated))
    expected = torch.isnan(frames) | ignore
    assert torch.equal(missing, expected.float())
    assert torch.equal(saturated, ((frames > 0.8) & ~expected).float())
    assert bool((prepared.images[prepared.missing] == 0).all())
    assert torch.allclose(prepared.filled[prepared.missing], torch.tensor(0.5), atol=0.05)
    counts = torch.tensor([[[0, 255], [17, 3]]], dtype=torch.uint8)
    saturated = prepare_frames(counts, sensor(), saturation="auto").saturated
    assert saturated.flatten().tolist() == [False, True, False, False]
    assert prepare_frames(counts.float(), sensor(), saturation="auto").saturated is None
    assert prepare_frames(counts, sensor()).saturated is None
    deep = counts.to(torch.int32)
    for options in ({"saturation": "auto", "full_scale": 255}, {"saturation": 255, "full_scale": 255}):
        assert prepare_frames(deep, sensor(), **options).saturated.flatten().tolist() == [False, True, False, False]
    assert prepare_frames(deep, sensor(), saturation="auto", full_scale=300).saturated is None


@pytest.mark.parametrize(
    ("bits", "largest", "saturated"),
    [(12, 4095, True), (12, 4094, False), (10, 1023, True), (16, 65520, False), (4, 15, False)],
)
def test_saturation_of_fewer_bits_stored_left_aligned(bits, largest, saturated):
    """A camera of 12 bits in files of 16 bits has at most the count 65520; a drawing of 16 levels is not saturated."""
    counts = np.random.default_rng(0).integers(0, largest - 2, (2, 8, 8))
    counts[:, 0, 0], counts[:, 0, 1] = largest, largest // 2
    stored = (counts << (16 - bits)).astype(np.uint16)
    found = prepare_frames(stored, sensor(), saturation="auto", full_scale=65535).saturated
    assert (found is not None) == saturated
    if saturated:
        assert np.array_equal(found[0, :, 0].numpy(), counts == largest)


@pytest.mark.parametrize("shape", [(4, 6), (2, 4, 6), (2, 1, 6), (2, 3, 4, 6)])
def test_masks_that_broadcast(shape):
    ignore = torch.zeros(shape, dtype=torch.bool)
    ignore[..., 0, 2] = True
    prepared = prepare_frames(torch.rand(2, 3, 4, 6), sensor(), ignore=ignore.numpy())
    expected = ignore if len(shape) == 4 else ignore.expand(2, 4, 6)[:, None].expand(2, 3, 4, 6)
    assert torch.equal(prepared.missing[0], expected)
