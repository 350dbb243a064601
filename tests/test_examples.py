"""The example scripts at small sizes: they run, print results, and reach the stated accuracy."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "scripts" / "examples"


def run(name, arguments, capsys):
    runpy.run_path(str(EXAMPLES / name))["main"](arguments)
    return capsys.readouterr().out


def test_gradient_descent_refines_the_vibration(capsys):
    printed = run("refine_vibration.py", ["--size", "512", "128"], capsys)
    rows = re.findall(r"(\w+) [xy] \(\w+\)\s+(\S+)\s+(\S+)\s+(\S+)", printed)
    assert len(rows) == 6
    for name, *numbers in rows:
        start, refined, true = map(float, numbers)
        tolerance = {"amplitude": 0.03, "frequency": 0.15, "phase": 0.02}[name]
        assert abs(start - true) > 5 * tolerance
        assert abs(refined - true) < tolerance, (name, numbers)
    before, after = map(float, re.search(r"frames: (\S+) before, (\S+) after", printed).groups())
    assert after < 0.2 * before


def test_third_line_makes_a_blind_frequency_measurable(capsys):
    printed = run("push_broom_jitter.py", ["--size", "448", "112"], capsys)
    truth, two, three = (line for line in printed.splitlines() if "px at" in line)
    assert "refused" in two
    found, true = (float(re.search(r"(\S+) px at 13\d", line).group(1)) for line in (three, truth))
    assert found == pytest.approx(true, rel=0.02)
    taken, blind, seen = (float(re.search(r"(\S+) dB", line).group(1)) for line in (truth, two, three))
    assert seen > blind + 8
    assert blind > taken + 2


@pytest.mark.parametrize("script", sorted(path.name for path in EXAMPLES.glob("*.py")))
def test_help_is_the_docstring(script, capsys):
    with pytest.raises(SystemExit, match="0"):
        run(script, ["--help"], capsys)
    assert "Printed:" in capsys.readouterr().out


def test_recordings_that_are_missing_are_named(capsys, tmp_path):
    """The recordings are not part of the project."""
    assert runpy.run_path(str(ROOT / "scripts" / "recordings.py"))["main"]([str(tmp_path), "--only", "eye"]) == 2
    assert "revas missing" in capsys.readouterr().err
