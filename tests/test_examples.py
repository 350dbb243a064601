"""The example script at a small size: it runs, prints results, and reaches the stated accuracy."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "scripts" / "examples"


def run(name, arguments, capsys):
    runpy.run_path(str(EXAMPLES / name))["main"](arguments)
    return capsys.readouterr().out


def test_third_line_makes_a_blind_frequency_measurable(capsys):
    printed = run("push_broom_jitter.py", ["--size", "448", "112"], capsys)
    truth, two, three = (line for line in printed.splitlines() if "px at" in line)
    assert "refused" in two
    found, true = (float(re.search(r"(\S+) px at 13\d", line).group(1)) for line in (three, truth))
    assert found == pytest.approx(true, rel=0.02)
    taken, blind, seen = (float(re.search(r"(\S+) dB", line).group(1)) for line in (truth, two, three))
    assert seen > blind + 8
    assert blind > taken + 2
