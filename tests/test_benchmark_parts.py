"""The parts of the benchmark at small sizes: figures are plausible and consistent, independent of the speed."""

import json
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


def test_one_command_writes_markdown_and_json(tmp_path, capsys):
    threads = torch.get_num_threads()
    try:
        benchmark.main(["--out", str(tmp_path), "--only", "gpu", "--quick", "--gpu-sizes", "96", "--gpu-stacks", "1"])
    finally:
        torch.set_num_threads(threads)
    summary = json.loads((tmp_path / "gpu.json").read_text())
    assert summary["machine"]["torch"] == torch.__version__
    assert {"OpenCV", "SciPy", "scikit-image", "Kornia"} < set(summary["machine"]["libraries"])
    assert summary["options"]["gpu_stacks"] == [1]
    rate, *cases = summary["rows"]
    assert rate["bytes_a_second"] > 1e8
    works = ["tracker, dewarp", "detection", "restoration, exact", "restoration, dewarp"]
    assert [row["work"] for row in cases] == works
    for row in cases:
        assert row["seconds"] > 0
        assert 0 < row["transfers"] < row["operations"]
    text = (tmp_path / "benchmark.md").read_text()
    assert text in capsys.readouterr().out + "\n"
    assert sum(line.startswith("| cpu | 96² | 1 |") for line in text.splitlines()) == 4
