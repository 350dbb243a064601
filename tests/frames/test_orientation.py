import itertools

import pytest
import torch

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.core.reason import Reason
from rsvib_torch.frames.orientation import (
    findings_from_row_order,
    frames_from_row_order,
    frames_to_row_order,
    magnitudes_from_row_order,
    offsets_from_row_order,
    sequence_from_row_order,
)

ORIENTATIONS = list(itertools.product((-2, -1), ("forward", "reverse")))
VIBRATION = Vibration(
    [[3.1, 0.5], [5.2, 0.2]], [[50.0, 90.0], [30.0, 120.0]], [[0.4, 2.9], [1.3, -3.0]], [120.0, -40.0]
)


def timing(scan_axis, direction):
    return SensorTiming(20e-6, 20, 2048, scan_axis=scan_axis, readout_direction=direction)


@pytest.mark.parametrize(("scan_axis", "direction"), ORIENTATIONS)
def test_rows_in_read_order(scan_axis, direction):
    """The row that is read first is the first row of the frame."""
    image = torch.arange(12.0).reshape(3, 4)
    rows = frames_to_row_order(image, timing(scan_axis, direction))
    index = -1 if direction == "reverse" else 0
    assert torch.equal(rows[0], image[index] if scan_axis == -2 else image[:, index])
    assert torch.equal(frames_from_row_order(rows, timing(scan_axis, direction)), image)


@pytest.mark.parametrize(("scan_axis", "direction"), ORIENTATIONS)
def test_displacements_turn_with_the_frames(scan_axis, direction):
    """A point moved in the image and a point moved in the turned image are the same point."""
    camera = timing(scan_axis, direction)
    for x, y in ((2, 1), (-1, 2), (0, -2)):
        image = torch.zeros(9, 11)
        moved = torch.zeros(9, 11)
        image[4, 5] = 1
        moved[4 + y, 5 + x] = 1
        before, after = (frames_to_row_order(part, camera).nonzero()[0] for part in (image, moved))
        in_rows = (after - before).flip(-1).double()
        assert offsets_from_row_order(in_rows, camera).tolist() == [x, y]
        constant = Vibration(0.0, 0.0, image_motion=[float(x), float(y)])
        assert constant.to_row_order(camera).image_motion.tolist() == in_rows.tolist()


@pytest.mark.parametrize(("scan_axis", "direction"), ORIENTATIONS)
def test_vibration_and_offsets_agree(scan_axis, direction):
    camera = timing(scan_axis, direction)
    times = torch.linspace(0, 0.1, 33, dtype=torch.float64)
    turned = VIBRATION.to_row_order(camera)
    torch.testing.assert_close(
        offsets_from_row_order(turned.displacement(times), camera), VIBRATION.displacement(times), rtol=0, atol=1e-12
    )
    if (scan_axis, direction) != (-2, "forward"):
        assert (turned.displacement(times) - VIBRATION.displacement(times)).abs().max() > 1.0
    back = turned.from_row_order(camera)
    for name in ("amplitude", "frequency", "phase", "image_motion"):
        torch.testing.assert_close(getattr(back, name), getattr(VIBRATION, name), rtol=0, atol=1e-12)
    assert bool((turned.amplitude >= 0).all())


@pytest.mark.parametrize(("scan_axis", "direction"), ORIENTATIONS)
@pytest.mark.parametrize("num_axes", [2, 3, 4])
def test_values_without_a_sign_turn_with_the_displacements(scan_axis, direction, num_axes):
    camera = timing(scan_axis, direction)
    in_rows = torch.tensor([[3.0, 5.0, 7.0, 9.0], [2.0, 4.0, 6.0, 8.0]], dtype=torch.float64)[:, :num_axes]
    in_image = offsets_from_row_order(in_rows, camera).abs()
    assert torch.equal(magnitudes_from_row_order(in_rows, camera), in_image)
    of_tones = torch.stack([in_rows, 10 * in_rows], -1)
    assert torch.equal(magnitudes_from_row_order(of_tones, camera, axis=-2), torch.stack([in_image, 10 * in_image], -1))
    assert sequence_from_row_order(in_rows[0].tolist(), camera) == tuple(in_image[0].tolist())
    components = [f"component {axis}" for axis in range(num_axes)]
    expected = [1, 0, 2, 3] if scan_axis == -1 else [0, 1, 2, 3]
    assert sequence_from_row_order(components, camera) == tuple(components[axis] for axis in expected[:num_axes])
    names = ("x", "y", "roll", "zoom")[:num_axes]
    findings = [(Reason("no_tone", name), Reason("fit_not_converged")) for name in names]
    assert findings_from_row_order(findings, camera) == tuple(findings)  # the first image axis is "x" in every order
