"""Each reason for which a detected vibration is not reliable."""

import math

import numpy as np
import pytest
import torch

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.detection.measurements import OtherMotion
from rsvib_torch.detection.verdict import compared_bands, judged
from rsvib_torch.motion.vibration import VibrationStd

TIMING = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=2048)


def verdict(amplitude=3.0, frequency=30.0, *, std=(0.01, 0.01), displacement_std=0.01, known_std=None, **options):
    """Reasons against a vibration along x (y: 2 px at 50 Hz) with 40 bands, or with the motion of ``rows``."""
    vibration = Vibration([[[amplitude], [2.0]]], [[[frequency], [50.0]]])
    size, hertz = (torch.tensor([[[value], [0.01]]], dtype=torch.float64) for value in std)
    curve, nothing = np.sin(np.linspace(0, 12, 40))[:, None] * np.array([3.0, 2.0]), torch.zeros(1, 2)
    offsets, fitted = (options.pop(name, lambda same: same)(curve)[None] for name in ("offsets", "fitted"))
    bands = compared_bands(offsets, fitted, np.ones((1, 40), dtype=bool))
    (findings,) = judged(
        vibration,
        VibrationStd(size, hertz, size, hertz, nothing, nothing, torch.tensor([[displacement_std, 0.01]])),
        options.pop("rows", bands),
        intervals=np.array([0.04096]),
        displacement=np.array([[amplitude, 2.0]]) / 2**0.5,
        known_std=np.array([[displacement_std if known_std is None else known_std, 0.01]]),
        timing=TIMING.in_row_order(),
        **options,
    )
    return findings


def codes(findings):
    return [[reason.code for reason in of_axis] for of_axis in findings]


def missing(count):
    def change(curve):
        curve = curve.copy()
        curve[:count] = math.nan
        return curve

    return change


@pytest.mark.parametrize(
    ("options", "code", "value", "limit"),
    [
        ({}, None, None, None),
        ({"offsets": missing(20)}, None, None, None),
        ({"offsets": missing(21)}, "rows_not_registered", 19 / 40, 0.5),
        ({"amplitude": 0.0}, "no_tone", None, None),
        ({"std": (2.0, 0.01)}, None, None, None),  # a slow tone whose displacement is known
        ({"std": (0.0, 0.01)}, "tone_uncertainty_unknown", None, None),
        ({"std": (0.01, math.inf)}, "tone_uncertainty_unknown", None, None),
        ({"displacement_std": 0.52}, None, None, None),
        ({"displacement_std": 0.54}, "displacement_uncertain", 0.54, 0.25 * 3 / 2**0.5),
        ({"displacement_std": 0.084, "known_std": 0.02}, None, None, None),  # 4 % of the displacement
        ({"displacement_std": 0.086, "known_std": 0.02}, "displacement_ambiguous", 0.086, 0.04 * 3 / 2**0.5),
        ({"displacement_std": 0.09, "known_std": 0.061}, None, None, None),
        ({"displacement_std": 0.09, "known_std": 0.059}, "displacement_ambiguous", 0.09, 0.04 * 3 / 2**0.5),
        ({"amplitude": 0.05, "std": (0.001, 0.01), "displacement_std": 0.0075, "known_std": 0.001}, None, None, None),
        ({"max_tones": 1}, "too_many_tones", 1, 1),
        ({"amplitude": 0.002, "std": (1e-5, 0.01)}, "tone_too_small", 0.002633, 0.01),
        ({"frequency": 1 / 0.04096, "std": (1e-3, 1e-3)}, "tone_blind", 0.0, 0.3),
        ({"frequency": 2 / 0.04096 + 0.01, "std": (1e-3, 1e-2)}, "tone_blind", 0.00257, 0.3),
        ({"frequency": 2600.0}, "tone_averaged_out", 2600.0, 2500.0),
        ({"fitted": lambda curve: curve + 0.5}, None, None, None),
        ({"fitted": lambda curve: 0.3 * curve}, "bands_unexplained", 1.1205, 0.5795),
        ({"amplitude": 60.0, "frequency": 300.0}, "motion_within_row_time", 2.262, 0.1),
        ({"amplitude": 24.0, "frequency": 30.0}, None, None, None),
    ],
)
def test_reasons_for_an_unreliable_tone(options, code, value, limit):
    findings = verdict(**options)
    if code is None:
        assert codes(findings)[0] == []
        return
    (reason,) = [reason for reason in findings[0] if reason.code == code]
    assert reason.axis == (None if code == "rows_not_registered" else "x")
    compared = [number for number in (reason.value, reason.limit) if number is not None]
    assert compared == pytest.approx([number for number in (value, limit) if number is not None], rel=2e-3, abs=1e-6)


@pytest.mark.parametrize(("turns", "multiple"), [(1, ""), (2, "2 times "), (2.01, None)])
def test_a_blind_tone_at_a_multiple_of_the_frame_rate_may_be_caused_by_frame_rows(turns, multiple):
    findings = verdict(frequency=turns / 0.04096, std=(1e-3, 1e-3))
    (blind,) = (reason for reason in findings[0] if reason.code == "tone_blind")
    assert blind.details.get("multiple") == multiple
    assert ("check that frame_rows" in str(blind)) == (multiple is not None)


def rows_of(unexplained=0.0, correlated=0.0, differential=0.0, measured=1.0, blur=(1.2, 0.1, 0.05), size=1.0):
    """Residual motion along x only, beside tones with offsets of ``size`` px along both axes."""
    axes = (np.array([[value, 0.0]]) for value in (unexplained, correlated, differential))
    return OtherMotion(np.full((1, 2), size), *axes, np.array([measured]), np.array([blur]))


@pytest.mark.parametrize(
    ("residual", "against"),
    [
        ({"unexplained": 0.02, "correlated": 0.005, "differential": 0.02}, [[], []]),
        ({"unexplained": 0.3}, [["rows_unexplained"], []]),
        ({"correlated": 0.1}, [["neighbours_unexplained"], []]),
        ({"correlated": 0.02}, [["neighbours_unexplained"], []]),
        ({"correlated": 0.02, "size": 9.0}, [[], []]),  # errors of interpolation increase with the displacement
        ({"differential": 0.1}, [[], ["halves_apart"]]),  # along x: a zoom, which displaces rows along y
        ({"differential": 0.3}, [["halves_apart"]] * 2),  # two motions along x
        ({"unexplained": 0.3, "differential": 0.1}, [["rows_unexplained"], ["halves_apart"]]),
        ({"measured": 0.4}, [["rows_not_registered"]] * 2),
        ({"blur": (0.5, 0.1, 0.05)}, [["blur_contradicts_exposure"]] * 2),
        ({"blur": (0.5, 0.2, 0.05)}, [[], []]),
        ({"blur": (4.0, 0.5, 0.05)}, [["blur_contradicts_exposure"]] * 2),
        ({"blur": (4.0, 0.8, 0.05)}, [[], []]),
        ({"blur": (4.0, 0.5, 0.0005)}, [[], []]),
        ({"blur": (900.0, 150.0, 0.00002)}, [["blur_contradicts_exposure"]] * 2),  # stated 30 times too short
        ({"blur": (0.1, 1.4, 0.0005)}, [[], []]),  # the expected difference is too small to be missed
        ({"blur": (-0.2, 0.1, 0.05)}, [["blur_contradicts_exposure"]] * 2),
        ({"blur": (-0.4, 0.1, 0.05)}, [[], []]),  # no exposure time has a negative ratio
        ({"blur": (0.3, 0.01, 0.3)}, [[], []]),  # the second order does not describe so much blur
    ],
)
def test_residual_motion_makes_axes_unreliable(residual, against):
    """Differential motion along one axis affects the verdict of the other."""
    assert codes(verdict(rows=rows_of(**residual))) == against


def test_rows_that_are_not_registered_may_be_those_of_all_frames():
    """The only group of frames, or one of many."""
    (reason, *_), _ = verdict(rows=rows_of(measured=0.4))
    assert "40% of the rows that frames have in common can be registered" in str(reason)


@pytest.mark.parametrize(
    ("residual", "axis", "allowed"),
    [("unexplained", 0, (0.05, 0.1)), ("correlated", 0, (0.01, 0.05)), ("differential", 1, (0.035, 0.18))],
)
@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_residual_motion_is_compared_with_errors_of_interpolation_and_the_offsets(residual, axis, allowed, factor):
    for size, limit in zip((0.3, 20.0), allowed, strict=True):
        findings = verdict(rows=rows_of(**{residual: factor * limit, "size": size}))
        assert findings[1 - axis] == ()
        assert [reason.limit for reason in findings[axis]] == ([pytest.approx(limit)] if factor > 1 else [])


@pytest.mark.parametrize(("ratio", "found"), [(0.03, []), (0.05, ["displacement_ambiguous"])])
def test_the_displacement_by_several_tones_must_be_known_better(ratio, found):
    tones = Vibration([[[2.0, 1.0], [2.0, 0.0]]], [[[30.0, 45.0], [50.0, 50.0]]])
    small = torch.tensor([[[0.01, 0.01], [0.01, 0.0]]], dtype=torch.float64)
    uncertain = torch.full((1, 2), 1.5 * ratio)
    (findings,) = judged(
        tones,
        VibrationStd(small, small, small, small, torch.zeros(1, 2), torch.zeros(1, 2), uncertain),
        rows_of(),
        intervals=np.array([0.04096]),
        displacement=np.array([[1.5, 1.5]]),
        known_std=uncertain.numpy(),
        timing=TIMING.in_row_order(),
    )
    assert codes(findings) == [found, []]


def test_bands_are_not_judged_where_rows_were_measured():
    """Condition (24) and large residuals of bands concern fits to bands only."""
    options = {"amplitude": 60.0, "frequency": 300.0, "fitted": lambda curve: 0.3 * curve}
    assert codes(verdict(**options))[0] == ["bands_unexplained", "motion_within_row_time"]
    assert codes(verdict(**options, rows=rows_of())) == [[], []]
