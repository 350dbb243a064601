"""The parts of the benchmark at small sizes: figures are plausible and consistent, independent of the speed."""

import argparse
import json
import math
import sys
from pathlib import Path

import benchmark
import benchmark_page
import pytest
import torch
from benchmarks import difficulty, live, pipeline, registration, roofline, video
from benchmarks.measure import Timed, in_turns, peak_memory, shown_seconds
from benchmarks.store import read_result, write_result

import rsvib_torch as rsv


def options(**chosen):
    usual = {"size": 256, "runs": 2, "device": ["cpu"], "scenes": ["city"], "exposures": [20], "noises": [0.005]}
    return argparse.Namespace(**usual | {"grid_size": 128, "pipeline_rows": 384, "scaling_size": 256} | chosen)


def in_order(row):
    return 0 < row["seconds_least"] <= row["seconds"] <= row["seconds_most"]


def test_timed_runs_are_added_run_by_run_and_scaled():
    first, second = Timed("a", (1.0, 4.0, 2.0)), Timed("b", (0.5, 0.1, 0.2))
    both = first + second
    assert both.result == "b"
    assert both.runs == (1.5, 4.1, 2.2)
    assert first.scaled(10).figures() == {"seconds": 20.0, "seconds_least": 10.0, "seconds_most": 40.0}
    assert shown_seconds(both.figures()) == "2.200 (1.500 to 4.100)"
    calls = []
    done = in_turns({"x": lambda: calls.append("x"), "y": lambda: calls.append("y")}, 2)
    assert calls == ["x", "y", "x", "y", "x", "y"]
    assert [len(timed.runs) for timed in done.values()] == [2, 2]


def test_registration():
    chosen = options()
    found = {row["method"]: row for row in registration.rows(chosen)}
    assert all(in_order(row) for row in found.values())
    slowest = found["skimage phase_cross_correlation"]
    for row in found.values():
        assert row["ratio"] == pytest.approx(slowest["seconds"] / row["seconds"])
    for name in ("ncc", "phase", "cv2.matchTemplate, parabola", "cv2.findTransformECC, from matchTemplate"):
        assert found[name]["share_off"] < 0.15
        assert max(found[name]["rms_px"]) < 0.12


def test_pipeline():
    chosen = options(runs=1)
    results = pipeline.rows(chosen)
    compared = {row["chain"]: row for row in results if row["part"] == "accuracy"}
    timed = {row["chain"]: row for row in results if row["part"] == "speed"}
    assert list(compared) == list(timed)
    assert {pipeline.PAPER, pipeline.FASTEST, pipeline.OURS, pipeline.DEWARP} < set(compared)
    for name, row in compared.items():
        percent_bound = (
            1.0 if name in (pipeline.OURS, pipeline.DEWARP) else 15.0
        )  # small frames have few bands, with strong blur
        percent_bound = 2.0 if name in (pipeline.NARROW, pipeline.NARROW_DEWARP) else percent_bound
        assert row["amplitude_percent"] < percent_bound
        assert row["period_percent"] < percent_bound
        assert row["psnr_db"] > (44 if name == pipeline.OURS else 30)
    for row in timed.values():
        assert in_order(row)
        assert row["frames_a_second"] == pytest.approx(2 / row["seconds"])
        whole = row["detection_seconds"] + row["restoration_seconds"]
        assert row["seconds_least"] * 0.5 < whole < row["seconds_most"] * 2
    trip = timed[pipeline.OURS]["detection_seconds"] / timed[pipeline.OURS]["detection_round_trips"]
    restoration = timed[pipeline.OURS]["restoration_seconds"]
    assert timed[pipeline.OURS]["restoration_round_trips"] == pytest.approx(restoration / 2 / trip)
    found = {row["target"]: row for row in results if row["part"] == "target"}
    ratio = timed[pipeline.PAPER]["seconds"] / timed[pipeline.OURS]["seconds"]
    assert found["time of the paper's chain over ours"]["value"] == pytest.approx(ratio)


def test_difficulty():
    """Scenes are simplified until unwarping has the accuracy of the reference case, which makes goals comparable."""
    chosen = options(images=[], difficulty_size=160, by=list(difficulty.WAYS))
    results = difficulty.rows(chosen)
    cases = [(row["by"], row["exposure_rows"], row["noise"]) for row in results]
    assert cases == [(way, *case) for way in difficulty.WAYS for case in difficulty.CASES]
    for row in results:
        assert row["two_db"] > row["one_db"] > row["unwarped_db"]
        if row["noise"] == 0:
            assert row["unwarped_db"] == pytest.approx(difficulty.UNWARPED[0], abs=0.2)
            assert row["one_db"] > 68


@pytest.mark.slow
def test_peak_memory():
    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("the system does not report the peak of memory")
    frame = 4 * 2048 * 1024  # memory that the process released before is reused and does not count: several MB
    exact, dewarped = (peak_memory(method, 1, 2048, 1024) for method in ("exact", "dewarp"))
    assert 2 * frame < dewarped < exact < 200 * frame
    assert peak_memory("detection", 2, 512, 512) > 2 * 4 * 512 * 512


def test_roofline(monkeypatch):
    monkeypatch.setattr(roofline, "COPIED", 1 << 22)
    monkeypatch.setattr(roofline, "MULTIPLIED", 256)
    chosen = options()
    results = roofline.rows(chosen)
    (device,) = (row for row in results if row["part"] == "device")
    shapes, counted = device["shapes"], {row["step"]: row for row in results if row["part"] == "step"}
    assert shapes["rows"] == shapes["columns"] == 256
    assert shapes["frequencies"] == shapes["length"] // 2 + 1
    # a kernel of six rows and one row for its displacement within a cell: half-width six
    assert (shapes["taps"], shapes["width"]) == (7, 6)
    unknowns = shapes["unknowns"] * shapes["frequencies"]
    assert counted["factors"]["operations"] == 8 * (6 * 6 + 6) * unknowns  # updates of the window, scaling of a row
    band = 8 * (shapes["unknowns"] + 6) * 13 * shapes["frequencies"]
    assert counted["factors"]["bytes_least"] == 2 * band
    assert counted["forward substitution"]["operations"] == (8 * 6 + 2) * unknowns
    assert counted["back substitution"]["operations"] == 8 * 6 * shapes["unknowns"] * shapes["frequencies"]
    for row in counted.values():
        assert 0 < row["bytes_least"] <= row["bytes_moved"]
    assert device["least_seconds"] <= device["moved_seconds"]
    moved = sum(row["bytes_moved"] for row in counted.values())
    assert device["share_of_bandwidth"] == pytest.approx(moved / device["bytes_a_second"] / device["seconds"])


def test_results_are_stored_and_read_back(tmp_path):
    rows = [{"name": "a", "values": [1.5, -math.inf, None], "error": math.nan, "pair": (2, "x")}]
    chosen = options(out=tmp_path, images=[Path("scene.png")])
    path = write_result("registration", rows, chosen, 12.34, tmp_path)
    text = path.read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    back = read_result(path)
    assert back.rows[0].pop("error") != back.rows[0].get("error")
    assert back.rows == [{"name": "a", "values": [1.5, -math.inf, None], "pair": [2, "x"]}]
    assert (back.section, back.version, back.seconds) == ("registration", rsv.__version__, 12.3)
    assert (back.options.size, back.options.images) == (256, ["scene.png"])
    assert not hasattr(back.options, "out")
    assert back.machine["torch"] == torch.__version__
    assert {"processor", "cores", "threads"} < set(back.machine)


def test_the_page_of_the_documentation_is_up_to_date():
    if any(benchmark_page.RESULTS.glob("*.json")):
        assert benchmark_page.PAGE.read_text() == benchmark_page.page_text(benchmark_page.RESULTS)


def test_one_command_writes_markdown_and_json(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmark.py", "--out", str(tmp_path), "--size", "224", "--runs", "1"])
    sys.argv += ["--only", "registration", "--device", "cpu"]
    threads = torch.get_num_threads()
    try:
        benchmark.main()
    finally:
        torch.set_num_threads(threads)
    summary = json.loads((tmp_path / "registration.json").read_text())
    assert summary["machine"]["torch"] == torch.__version__
    assert {"OpenCV", "SciPy", "scikit-image", "Kornia"} < set(summary["machine"]["libraries"])
    assert len(summary["rows"]) == 7
    text = (tmp_path / "benchmark.md").read_text()
    assert text in capsys.readouterr().out + "\n"
    assert "skimage" in text
    assert rsv.__version__


def test_live():
    size = 192  # of frames of 128 px, the start from row bands misses one axis
    pixels = live.frames_of(size, live.Changing(), 8)
    moving, _ = live.residual(pixels, size)
    assert 1.2 < moving < 3.0  # px: rows move, and a stabiliser of whole frames does not help
    assert live.residual(live.phase_correlated(pixels), size)[0] > 0.9 * moving
    restored = live.tracked_frames(pixels, size, "dewarp")()
    assert live.residual(restored[4:], size)[0] < 0.1 * moving
    times = live.np.array([0.1, 0.3, 1.3])
    changing = live.Changing(sweep=2.0, doublings=1.0)
    assert changing.amplitude(times)[0] == pytest.approx([2.1, 2.1, 4.2])
    angle = 2 * live.np.pi * (52.0 * 1.3 + 1.0) + 0.5  # 2 Hz/s during one second: one cycle more
    assert changing.displacement(times)[0, -1] == pytest.approx(4.2 * live.np.sin(angle))


def test_video():
    chosen = options(video_rows=180, video_frames=12)
    results = video.rows(chosen)
    taken, exact, dewarp = results
    for row in (exact, dewarp):
        assert row["psnr"][0] > taken["psnr"][0] + 10  # dB, of luma
        assert row["psnr"][1] > taken["psnr"][1] + 3  # of chroma
        assert sum(row["parts"].values()) == pytest.approx(1.0)
        assert min(row["parts"].values()) > 0
    assert exact["parts"]["restoration"] > dewarp["parts"]["restoration"] > 0.03
