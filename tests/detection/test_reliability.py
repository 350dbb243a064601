"""Each reason for which a detected vibration is not reliable."""

import math

import pytest
import torch

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.detection.reliability import judge
from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.motion.vibration import VibrationStd

TIMING = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=2048)


def verdict(
    amplitude=3.0,
    frequency=30.0,
    *,
    std=(0.01, 0.01),
    displacement_std=0.01,
    own_std=None,
    offsets=None,
    fitted=None,
    visible=None,
    **options,
):
    """Verdict on a vibration along x (y: 2 px at 50 Hz) with 40 bands."""
    vibration = Vibration([amplitude, 2.0], [frequency, 50.0])
    size = torch.tensor([[std[0]], [0.01]], dtype=torch.float64)
    hertz = torch.tensor([[std[1]], [0.01]], dtype=torch.float64)
    curve = torch.sin(torch.linspace(0, 12, 40, dtype=torch.float64))[:, None] * torch.tensor([3.0, 2.0])
    arguments = {
        "offsets": curve.double() if offsets is None else offsets(curve.double()),
        "fitted": curve.double() if fitted is None else fitted(curve.double()),
        "intervals": torch.tensor([0.04096], dtype=torch.float64),
        "displacement": torch.tensor([amplitude, 2.0]) / 2**0.5,
        "own_std": torch.tensor([displacement_std if own_std is None else own_std, 0.01]),
        "timing": TIMING,
    }
    std_of_tones = VibrationStd(
        amplitude=size,
        frequency=hertz,
        phase=hertz,
        period=size,
        image_motion=torch.zeros(2),
        image_acceleration=torch.zeros(2),
        displacement=torch.tensor([displacement_std, 0.01]),
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
        ({"std": (0.0, 0.01)}, "uncertainty of the tone of 30 Hz is unknown"),
        ({"std": (0.01, math.inf)}, "uncertainty of the tone of 30 Hz is unknown"),
        ({"displacement_std": 0.52}, None),
        ({"displacement_std": 0.54}, "must be at most 25 % of the displacement"),
        ({"displacement_std": 0.084, "own_std": 0.02}, None),  # 4 % of the displacement
        ({"displacement_std": 0.086, "own_std": 0.02}, "uncertain: 2.1 ± 0.086 px, because the frames also agree"),
        ({"displacement_std": 0.09, "own_std": 0.061}, None),
        ({"displacement_std": 0.09, "own_std": 0.059}, "agree with other tones"),
        ({"amplitude": 0.05, "std": (0.001, 0.01), "displacement_std": 0.0075, "own_std": 0.001}, None),
        ({"max_tones": 1}, "1 tones do not explain the motion"),
        ({"amplitude": 0.002, "std": (1e-5, 0.01)}, "too small"),
        ({"frequency": 1 / 0.04096, "std": (1e-3, 1e-3)}, "nearly blind"),
        ({"frequency": 1 / 0.04096, "std": (1e-3, 1e-3)}, "equals the frame rate of 24.414 Hz"),
        ({"frequency": 2 / 0.04096 + 0.01, "std": (1e-3, 1e-2)}, "equals 2 times the frame rate"),
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


def other_motion(unexplained=0.0, correlated=0.0, differential=0.0, measured=1.0, blur=(1.2, 0.1, 0.05), size=1.0):
    """Residual motion along x only, beside tones with offsets of ``size`` px along both axes."""
    axes = (torch.tensor([value, 0.0]) for value in (unexplained, correlated, differential))
    return OtherMotion(torch.full((2,), size), *axes, torch.tensor(measured), torch.tensor(blur))


@pytest.mark.parametrize(
    ("residual", "against"),
    [
        ({"unexplained": 0.02, "correlated": 0.005, "differential": 0.02}, (0, 0)),
        ({"unexplained": 0.3}, (1, 0)),
        ({"correlated": 0.1}, (1, 0)),
        ({"differential": 0.3}, (0, 1)),  # along x: a zoom, which displaces rows along y
        ({"unexplained": 0.3, "differential": 0.3}, (1, 1)),
        ({"measured": 0.4}, (1, 1)),
        ({"blur": (0.5, 0.1, 0.05)}, (1, 1)),
        ({"blur": (0.5, 0.2, 0.05)}, (0, 0)),
        ({"blur": (4.0, 0.5, 0.05)}, (1, 1)),
        ({"blur": (4.0, 0.7, 0.05)}, (0, 0)),
        ({"blur": (4.0, 0.5, 0.003)}, (0, 0)),
        ({"blur": (-0.2, 0.1, 0.05)}, (1, 1)),
        ({"blur": (-0.4, 0.1, 0.05)}, (0, 0)),  # no exposure time has a negative ratio
        ({"blur": (0.3, 0.01, 0.3)}, (0, 0)),  # the second order does not describe so much blur
    ],
)
def test_residual_motion_makes_axes_unreliable(residual, against):
    """Differential motion along one axis affects the verdict of the other."""
    reliable, reasons = verdict(other_motion=other_motion(**residual))
    assert tuple(len(axis) for axis in reasons) == against
    assert reliable.tolist() == [count == 0 for count in against]


@pytest.mark.parametrize(
    ("residual", "axis", "allowed"),
    [("unexplained", 0, (0.05, 0.12)), ("correlated", 0, (0.01, 0.05)), ("differential", 1, (0.035, 0.18))],
)
@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_residual_motion_is_compared_with_errors_of_interpolation_and_the_offsets(residual, axis, allowed, factor):
    for size, limit in zip((0.3, 20.0), allowed, strict=True):
        reliable, _ = verdict(other_motion=other_motion(**{residual: factor * limit, "size": size}))
        assert bool(reliable[axis]) == (factor < 1)
        assert bool(reliable[1 - axis])


def test_the_displacement_by_several_tones_must_be_known_better():
    tones = Vibration([[2.0, 1.0], [2.0, 0.0]], [[30.0, 45.0], [50.0, 50.0]])
    small = torch.tensor([[0.01, 0.01], [0.01, 0.0]], dtype=torch.float64)
    curve = torch.sin(torch.linspace(0, 12, 40, dtype=torch.float64))[:, None].expand(-1, 2)
    for ratio in (0.03, 0.05):
        std = VibrationStd(small, small, small, small, torch.zeros(2), torch.zeros(2), torch.full((2,), 1.5 * ratio))
        reliable, reasons = judge(
            tones,
            std,
            offsets=curve,
            fitted=curve,
            visible=torch.ones(40, dtype=torch.bool),
            intervals=torch.tensor([0.04096], dtype=torch.float64),
            displacement=torch.tensor([1.5, 1.5]),
            own_std=std.displacement,
            timing=TIMING,
        )
        assert reliable.tolist() == [ratio < 0.04, True], reasons


def test_bands_are_not_judged_where_rows_were_measured():
    """Missing bands, large residuals of bands and condition (24) concern fits to bands only."""
    options = {"amplitude": 60.0, "frequency": 300.0, "fitted": lambda curve: 0.3 * curve}
    assert not verdict(**options)[0][0]
    assert not verdict(offsets=missing(30))[0][0]
    assert verdict(**options, offsets=missing(30), other_motion=other_motion())[0].all()
