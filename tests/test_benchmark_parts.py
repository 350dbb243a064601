"""The parts of the benchmark at small sizes: figures are plausible and consistent, independent of the speed."""

import math
from pathlib import Path

import benchmark
import pytest
import torch
from harness import read_result, write_result

import rsvib_torch as rsv


def test_results_are_stored_and_read_back(tmp_path):
    rows = [{"name": "a", "values": [1.5, -math.inf, None], "error": math.nan, "pair": (2, "x")}]
    chosen = benchmark.parsed(["--only", "pipeline", "--quick", "--out", str(tmp_path)])
    chosen.scenes = [Path("scene.png")]
    path = write_result("pipeline", rows, chosen, 12.34, tmp_path)
    text = path.read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    back = read_result(path)
    assert back.rows[0].pop("error") != back.rows[0].get("error")
    assert back.rows == [{"name": "a", "values": [1.5, -math.inf, None], "pair": [2, "x"]}]
    assert (back.section, back.version, back.seconds) == ("pipeline", rsv.__version__, 12.3)
    assert (back.options.size, back.options.scenes) == (256, ["scene.png"])
    assert not hasattr(back.options, "out")
    assert back.machine["torch"] == torch.__version__
    assert {"processor", "cores", "threads"} < set(back.machine)


def test_the_pages_of_the_documentation_are_up_to_date():
    for path, text in benchmark.pages().items():
        assert path.read_text(encoding="utf-8") == text


def test_the_options_of_all_sections_have_a_help(capsys):
    with pytest.raises(SystemExit) as ended:  # names of kinds contain per cent signs
        benchmark.parsed(["--only", *benchmark.SECTIONS, "--help"])
    assert ended.value.code == 0
    assert "--bar-kinds" in capsys.readouterr().out
