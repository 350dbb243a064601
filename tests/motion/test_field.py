"""Motions with roll and zoom: components, signs in row order, displacement of columns, simulated frames."""

import numpy as np
import pytest
import torch
from field_truth import FieldMotion, take_field_frames
from hypothesis import given
from hypothesis import strategies as st
from truth import draw_scene

from rsvib_torch import FreeMotion, SensorTiming, Vibration, simulate_frames
from rsvib_torch.imaging.trajectory import places, places_at_rest, recorded_offsets
from rsvib_torch.motion.camera import displacement_at, largest_in_frame
from rsvib_torch.motion.motion import ColumnMotion

TIMING = SensorTiming(row_time=8e-5, exposure_rows=20, frame_rows=300)
ORIENTATIONS = [(-2, "forward"), (-2, "reverse"), (-1, "forward"), (-1, "reverse")]


@given(st.tuples(*[st.floats(-3, 3)] * 4), st.floats(-200, 200), st.floats(-100, 100), st.sampled_from(ORIENTATIONS))
def test_row_order_is_a_reflection_of_the_field(values, x, y, orientation):
    """The displacement of a turned point by the turned motion is the turned displacement."""
    timing = SensorTiming(8e-5, 20, 300, scan_axis=orientation[0], readout_direction=orientation[1])

    def turned(point):
        right, down = point
        right, down = (down, right) if orientation[0] == -1 else (right, down)
        return torch.tensor([right, -down if orientation[1] == "reverse" else down], dtype=torch.float64)

    steady = Vibration(0.0, 0.0, image_motion=(0.0, 0.0))
    scaled = torch.tensor([1.0, 1.0, 1e-3, 1e-3]) * torch.tensor(values)
    motion = FreeMotion(scaled[:, None].repeat(1, 4), 0.0, 0.1)
    assert motion.num_axes == 4
    assert steady.num_axes == 2
    time = torch.tensor(0.05)
    where = torch.tensor([x, y], dtype=torch.float64)
    expected = turned(displacement_at(motion.displacement(time), *where))
    rowwise = motion.to_row_order(timing)
    torch.testing.assert_close(displacement_at(rowwise.displacement(time), *turned(where)), expected, atol=1e-9, rtol=0)
    back = rowwise.from_row_order(timing)
    torch.testing.assert_close(back.coefficients, motion.coefficients)


def test_column_motion():
    """The displacement of a column against that of its rows, each at its position and time."""
    truth = FieldMotion()
    timing, columns = TIMING.in_row_order(), torch.tensor([-90.0, 0.0, 120.0], dtype=torch.float64)
    motion = ColumnMotion.of_columns(truth.vibration().expanded(1), columns, timing, 2, 200)
    starts = timing.row_starts(2, 200)[:, 20::40]
    moved = motion.displacement(starts.expand(3, -1, -1))
    for index, column in enumerate(columns.tolist()):
        x, y, roll, zoom = truth.components(starts.numpy())
        row = np.arange(20, 200, 40) - 99.5
        height = (row - y - roll * column) / (1 + zoom)
        np.testing.assert_allclose(moved[index, ..., 0], x - roll * height + zoom * column, atol=1e-9)
        np.testing.assert_allclose(moved[index, ..., 1], y + roll * column + zoom * height, atol=1e-9)
    bound = motion.largest_displacement(0.0, 0.05)
    assert bool((moved.abs().amax((1, 2)) <= bound).all())
    assert bool((bound <= largest_in_frame(torch.tensor(truth.amplitude).double(), 240, 202) + 1e-9).all())


@pytest.mark.parametrize(("scan_axis", "direction"), ORIENTATIONS)
def test_simulated_frames(scan_axis, direction):
    """Simulated frames against a camera that samples every pixel at its own position and time."""
    timing = SensorTiming(8e-5, 20, 300, scan_axis=scan_axis, readout_direction=direction)
    truth = FieldMotion((2.0, 3.0, 2e-3, 1e-3))
    scene = draw_scene(200, 224, 3, blur=1.3)
    expected = take_field_frames(scene, timing, truth, (128, 148))
    found = simulate_frames(torch.from_numpy(scene), timing, truth.vibration(4), 2, frame_size=(128, 148)).numpy()
    inner = (slice(None), slice(6, -6), slice(6, -6))
    without = simulate_frames(torch.from_numpy(scene), timing, truth.vibration(2), 2, frame_size=(128, 148)).numpy()
    assert np.std((found - expected)[inner]) < 3e-4
    assert np.std((without - expected)[inner]) > 5 * np.std((found - expected)[inner])


def test_places_at_rest_are_the_inverse_of_where_pixels_were_recorded():
    timing = SensorTiming(row_time=50e-6, exposure_rows=10, frame_rows=400)
    vibration = Vibration([8.0, 6.0, 0.02, 0.01], [60.0, 80.0, 50.0, 70.0], [0.3, 1.0, 2.0, 0.0])
    offsets, weights = recorded_offsets(vibration, timing, (120, 160))
    recorded = places(offsets, weights, timing, (120, 160), np.float64)[:, ::20, ::20].reshape(2, -1).T
    row, column = np.mgrid[:120:20, :160:20].reshape(2, -1)
    centre = np.array([79.5, 59.5])
    still = places_at_rest(vibration, recorded - centre, recorded[:, 1] * timing.row_time, timing.exposure_time)
    assert np.abs(recorded - np.stack([column, row], -1)).max() > 5
    np.testing.assert_allclose(still + centre, np.stack([column, row], -1), atol=1e-3)
