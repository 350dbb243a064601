"""The table of reasons: every text names what was compared, and reasons are stored and read without loss."""

import json
import math
from string import Formatter

import pytest

from rsvib_torch.detection.verdict import with_remedy
from rsvib_torch.results.reason import GROUPS, REASONS, Reason, read_findings

VALUE, LIMIT = 3.0, 7.0


def example(code):
    """A reason of a code with all details of its text."""
    kind = REASONS[code]
    parts = (kind.sentence + kind.remedy).replace("[", "").replace("]", "")
    fields = {name: spec for _, name, spec, _ in Formatter().parse(parts) if name}
    numbers = {name: fields.pop(name, None) is not None for name in ("value", "limit")}
    details = {name: 5.0 if spec else "(text)" for name, spec in fields.items() if name not in ("axis", "other")}
    return Reason(code, "x", *(VALUE if numbers["value"] else None, LIMIT if numbers["limit"] else None), details)


@pytest.mark.parametrize("code", REASONS)
def test_every_text_names_what_is_compared_and_is_stored(code):
    """A reason with a limit states value, limit and unit; a reason without one compares nothing."""
    kind, reason = REASONS[code], example(code)
    assert bool(kind.compares) == (reason.value is not None) == (reason.limit is not None)
    assert kind.compares or not kind.unit
    if reason.value is not None:
        fields = {name: spec for _, name, spec, _ in Formatter().parse(kind.sentence.replace("[", "")) if name}
        for name, number in (("value", VALUE), ("limit", LIMIT)):
            assert format(number, fields[name]) in str(reason)
    assert not any(mark in str(reason) for mark in "{}[]")
    assert kind.refuses
    assert [code in group for group in GROUPS.values()].count(True) == 1
    stored = json.loads(json.dumps(reason.to_dict()))
    assert Reason.from_dict(stored) == reason
    assert stored["text"] == str(reason)


def test_infinite_numbers_are_read_again():
    reason = Reason("displacement_uncertain", "x", math.inf, 0.5, {"size": math.inf})
    stored = json.loads(json.dumps(reason.to_dict(), allow_nan=False))
    assert stored["value"] is None
    assert str(Reason.from_dict(stored)) == str(reason)


@pytest.mark.parametrize(
    ("stored", "code"),
    [
        ({"code": "of a later version", "axis": "x", "text": "blind"}, "unspecified"),
        ({"code": "no_tone", "axis": "y", "value": None, "limit": None, "details": {}, "text": "?"}, "no_tone"),
    ],
)
def test_stored_reasons_have_a_known_code(stored, code):
    ((reason,), ()) = read_findings([[stored], []])
    assert reason.code == code
    assert str(reason) == ("blind" if code == "unspecified" else str(Reason("no_tone")))


def test_remedies_are_those_of_python_and_of_the_program():
    reason = Reason("rows_unexplained", "x", 0.2, 0.05)
    assert "try more tones, or detect_motion (rsvib motion) if the vibration changes" in str(reason)
    followed = with_remedy([reason], "use frames at shorter intervals")[0]
    assert str(followed).endswith("0.05 px are allowed; use frames at shorter intervals")
