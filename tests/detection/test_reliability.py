"""Each reason for which a detected vibration is not reliable."""

import math

import pytest
import torch

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.detection.reliability import judge
from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.motion.vibration import VibrationStd

TIMING = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=2048)


def verdict(amplitude=3.0, frequency=30.0, *, std=(0.01, 0.01), offsets=None, fitted=None, visible=None, **options):
    """Verdict on a vibration along x (y: 2 px at 50 Hz) with 40 bands."""
    vibration = Vibration([amplitude, 2.0], [frequency, 50.0])
    size = torch.tensor([[std[0]], [0.01]], dtype=torch.float64)
    hertz = torch.tensor([[std[1]], [0.01]], dtype=torch.float64)
    curve = torch.sin(torch.linspace(0, 12, 40, dtype=torch.float64))[:, None] * torch.tensor([3.0, 2.0])
    arguments = {
        "offsets": curve.double() if offsets is None else offsets(curve.double()),
        "fitted": curve.double() if fitted is None else fitted(curve.double()),
        "intervals": torch.tensor([0.04096], dtype=torch.float64),
        "duration": 0.08,
        "timing": TIMING,
    }
    std_of_tones = VibrationStd(
        amplitude=size,
        frequency=hertz,
        phase=hertz,
        period=size,
        image_motion=torch.zeros(2),
        image_acceleration=torch.zeros(2),
    )
    visible = torch.ones(40, dtype=torch.bool) if visible is None else visible
    return judge(vibration, std_of_tones, visible=visible, **{**arguments, **options})


def missing(count):
    def change(curve):
        curve = curve.clone()
        curve[:count] = math.nan
        return curve

    return change


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({}, None),
        ({"offsets": missing(20)}, None),
        ({"offsets": missing(21)}, "only 48% of 40 row bands"),
        ({"amplitude": 0.0}, "no significant tone"),
        ({"std": (2.0, 0.01)}, "not significant"),
        ({"std": (0.01, 2.9)}, None),
        ({"std": (0.01, 3.1)}, "Hz"),
        ({"amplitude": 0.002, "std": (1e-5, 0.01)}, "too small"),
        ({"frequency": 1 / 0.04096, "std": (1e-3, 1e-3)}, "nearly blind"),
        ({"duration": 0.034}, None),
        ({"duration": 0.033}, "has a period of 33.3 ms, longer than the record of 33 ms"),
        ({"frequency": 2600.0}, "above 1/T_e = 2500 Hz"),
        ({"fitted": lambda curve: curve + 0.5}, None),
        ({"fitted": lambda curve: 0.3 * curve}, "does not explain the offset curve"),
        ({"amplitude": 60.0, "frequency": 300.0}, "within a row time"),
        ({"amplitude": 24.0, "frequency": 30.0}, None),
    ],
)
def test_reasons_for_an_unreliable_tone(options, reason):
    reliable, reasons = verdict(**options)
    assert reliable.tolist()[0] == (reason is None), reasons
    if reason is not None:
        assert any(reason in text for text in reasons[0]), reasons


@pytest.mark.parametrize(
    ("unexplained", "slant", "expected"), [(0.02, 0.02, 0), (0.3, 0.0, 1), (0.0, 0.3, 1), (0.3, 0.3, 2)]
)
def test_residual_motion_makes_an_axis_unreliable(unexplained, slant, expected):
    other = OtherMotion(torch.tensor([unexplained, 0.0]), torch.tensor([slant, 0.0]))
    reliable, reasons = verdict(other_motion=other)
    assert len(reasons[0]) == expected
    assert reliable.tolist() == [expected == 0, True]


@pytest.mark.parametrize(("unexplained", "accepted"), [(0.029, True), (0.031, False)])
def test_residual_motion_of_a_small_tone_is_compared_with_errors_of_interpolation(unexplained, accepted):
    other = OtherMotion(torch.tensor([unexplained, 0.0]), torch.zeros(2))
    reliable, _ = verdict(0.3, other_motion=other)
    assert bool(reliable[0]) == accepted
