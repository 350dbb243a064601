"""Push-broom parallax pairs: two lines record the same ground with a delay shorter than the image."""

import pytest
import torch
from truth import MARGIN, Motion, crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv

LINES, WIDTH, LINE_TIME = 900, 192, 1e-4
JITTER = Motion(amplitude=(1.4, 0.9), frequency=(31.0, 44.0), phase=(0.4, 1.3))


def images(scene, delay_lines, motion=JITTER, noise=0.005):
    """Images of two lines with a delay of ``delay_lines``, which is the frame period of the simulator."""
    lines = rsv.SensorTiming(row_time=LINE_TIME, exposure_rows=4, frame_rows=delay_lines)
    return torch.from_numpy(take_frames(scene, lines, motion, 2, noise)).float()


@pytest.fixture(scope="module", name="ground")
def make_ground():
    return draw_scene(LINES + 2 * MARGIN, WIDTH + 2 * MARGIN, 9)


@pytest.mark.parametrize("delay_lines", [73, 260])
def test_jitter_is_measured_and_removed(ground, delay_lines):
    timing = rsv.SensorTiming.line_sensors(LINE_TIME, [0.0, delay_lines * LINE_TIME], LINES, 4)
    taken = images(ground, delay_lines)
    found = rsv.detect_vibration(taken, timing)
    assert found.reliable.all()
    assert found.vibration.frequency[:, 0].tolist() == pytest.approx(JITTER.frequency, rel=3e-3)
    assert found.vibration.amplitude[:, 0].tolist() == pytest.approx(JITTER.amplitude, rel=0.03)
    assert found.vibration.phase[:, 0].tolist() == pytest.approx(JITTER.phase, abs=0.06)
    restored = rsv.restore(taken, timing, found, joint=True)
    assert decibel(restored.numpy(), crop(ground)) > decibel(taken.numpy(), crop(ground)) + 12
