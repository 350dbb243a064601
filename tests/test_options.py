"""Groups of options: flat arguments of functions, their checks, and tables from files."""

import inspect
import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

import rsvib_torch as rsv
from rsvib_torch.checks.values import MistakesError, validate
from rsvib_torch.options import ToneOptions


@pytest.mark.parametrize(
    ("function", "leading", "option"),
    [
        (rsv.detect_vibration, ["frames", "timing"], "tones"),
        (rsv.restore, ["frames", "timing", "vibration"], "half_rows"),
        (rsv.register_bands, ["frames", "timing"], "method"),
        (rsv.align_motion, ["frames", "timing", "recorded"], "fit_scale"),
        (rsv.VibrationTracker.__init__, ["self", "timing"], "steady"),
    ],
)
def test_functions_have_the_fields_as_keyword_arguments(function, leading, option):
    parameters = inspect.signature(function).parameters
    assert list(parameters)[: len(leading)] == leading
    assert parameters[option].kind is inspect.Parameter.KEYWORD_ONLY
    assert parameters[option].default is not inspect.Parameter.empty
    assert f"{option}: " in function.__doc__


def test_values_are_kept_or_refused_but_not_converted():
    options = ToneOptions(tones=np.int64(2), principal_point=np.array([1, 2.5]), focal_length=900)
    assert (options.tones, options.principal_point, options.focal_length) == (2, (1.0, 2.5), 900.0)
    assert pickle.loads(pickle.dumps(options)) == replace(options, search=16)
    with pytest.raises(FrozenInstanceError):
        options.tones = 3
    for value, error in ((2.0, TypeError), ("2", TypeError), (True, TypeError), (5, ValueError)):
        with pytest.raises(error, match="tones must be"):
            ToneOptions(tones=value)


def test_tables_of_files_have_one_line_for_each_mistake():
    table = {"registration": "sift", "band_rows": 2.5, "tones": 9, "principal_point": [1], "step": 3}
    with pytest.raises(MistakesError) as caught:
        validate(ToneOptions, table, "camera.toml")
    assert sorted(line.partition("; the options")[0] for line in str(caught.value).splitlines()) == [
        "camera.toml: band_rows must be a whole number, got 2.5 (float)",
        "camera.toml: principal_point[1] is missing",
        "camera.toml: registration must be 'projection', 'ncc' or 'phase', got 'sift' (str)",
        "camera.toml: tones must be at most 4, got 9 (int)",
        "camera.toml: unknown option 'step'",
    ]
