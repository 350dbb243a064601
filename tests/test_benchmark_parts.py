"""The parts of the benchmark at small sizes: figures are plausible and consistent, independent of the speed."""

import argparse
import json
import math
import sys
from pathlib import Path

import pytest
import torch

import rsvib_torch as rsv

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture(autouse=True)
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    yield
    for name in [name for name in sys.modules if name.split(".")[0] in ("benchmarks", "benchmark", "benchmark_page")]:
        monkeypatch.delitem(sys.modules, name)


def options(**chosen):
    usual = {"size": 256, "runs": 2, "device": ["cpu"], "scenes": ["city"], "exposures": [20], "noises": [0.005]}
    return argparse.Namespace(**usual | {"grid_size": 128, "pipeline_rows": 384, "scaling_size": 256} | chosen)


def in_order(row):
    return 0 < row["seconds_least"] <= row["seconds"] <= row["seconds_most"]


def test_timed_runs_are_added_run_by_run_and_scaled():
    from benchmarks.measure import Timed, in_turns, shown_seconds

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


def test_registration(tmp_path):
    from benchmarks import registration

    chosen = options()
    found = {row["method"]: row for row in registration.rows(chosen)}
    assert all(in_order(row) for row in found.values())
    slowest = found["skimage phase_cross_correlation"]
    for row in found.values():
        assert row["ratio"] == pytest.approx(slowest["seconds"] / row["seconds"])
    for name in ("ncc", "phase", "cv2.matchTemplate, parabola", "cv2.findTransformECC, from matchTemplate"):
        assert found[name]["share_off"] < 0.15
        assert max(found[name]["rms_px"]) < 0.12
    text = registration.lines(list(found.values()), chosen)
    assert sum(line.startswith("| ") for line in text) == len(found) + 1
    assert registration.lines(*stored("registration", list(found.values()), chosen, tmp_path)) == text


def test_pipeline(tmp_path):
    from benchmarks import pipeline

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
    text = "\n".join(pipeline.lines(results, chosen))
    assert "\n".join(pipeline.lines(*stored("pipeline", results, chosen, tmp_path))) == text
    for row in found.values():
        assert f"| {row['target']} | {row['goal']} | {row['value']:.2f} | " in text


def test_difficulty():
    """Scenes are simplified until unwarping has the accuracy of the reference case, which makes goals comparable."""
    from benchmarks import difficulty

    chosen = options(images=[], difficulty_size=160, by=list(difficulty.WAYS))
    results = difficulty.rows(chosen)
    cases = [(row["by"], row["exposure_rows"], row["noise"]) for row in results]
    assert cases == [(way, *case) for way in difficulty.WAYS for case in difficulty.CASES]
    for row in results:
        assert row["two_db"] > row["one_db"] > row["unwarped_db"]
        if row["noise"] == 0:
            assert row["unwarped_db"] == pytest.approx(difficulty.UNWARPED[0], abs=0.2)
            assert row["one_db"] > 68
    assert sum(line.startswith("| city, ") for line in difficulty.lines(results, chosen)) == len(results)


def test_targets_are_met_or_missed():
    from benchmarks import pipeline

    case = {"scene": "city", "exposure_rows": 20, "noise": 0.0}
    figures = {"amplitude_percent": 1.0, "period_percent": 1.0, "psnr_db": 40.0}
    compared = [
        {**case, "chain": pipeline.PAPER, **figures, "period_percent": math.nan},
        {**case, "chain": pipeline.FASTEST, **figures},
        {**case, "chain": pipeline.OURS, "amplitude_percent": 0.5, "period_percent": 2.0, "psnr_db": 39.0},
        {**case, "chain": pipeline.NARROW, "amplitude_percent": 2.0, "period_percent": 0.5, "psnr_db": 41.0},
    ]
    behind = pipeline.behind_libraries(compared, pipeline.OURS)
    assert [row["figure"] for row in behind] == ["period_percent", "psnr_db"]
    assert behind[0]["peer"] == pipeline.FASTEST
    trips = {"detection_round_trips": 31.0, "restoration_round_trips": 9.0, "frames_a_second": 30.0}
    timed = [
        {"chain": name, "seconds": seconds, **trips, "frames_restored_a_second": 90.0}
        for name, seconds in (
            (pipeline.PAPER, 11.0),
            (pipeline.FASTEST, 0.3),
            (pipeline.OURS, 1.0),
            (pipeline.NARROW, 2.0),
            (pipeline.DEWARP, 0.25),
            (f"{pipeline.OURS} on cuda", 0.05),
        )
    ]
    met = [(row["value"], row["met"]) for row in pipeline.targets(compared, timed)]
    times = [(11.0, True), (5.5, False), (1 / 0.3, False), (0.25 / 0.3, True), (31.0, False), (9.0, True)]
    ahead = [(0.0, True), (1.0, False), (1.0, False), (1.0, False), (0.0, True), (0.0, True)]
    assert met == [*times, (30.0, True), (90.0, False), *ahead]


def test_scaling(monkeypatch, tmp_path):
    from benchmarks import scaling

    every = scaling.cases(1024)
    assert {name for name, _ in every} == {
        "height",
        "width",
        "frames",
        "exposure rows",
        "amplitude across (px)",
        "tones",
    }
    usual = every["height", "1024"]
    assert every["exposure rows", "205"].timing.exposure_rows == pytest.approx(204.8)
    assert every["tones", "3"].vibration.amplitude.shape == (2, 3)
    assert every["amplitude across (px)", "8"].vibration.amplitude[1, 0] == 8
    assert usual.timing.frame_period == pytest.approx(scaling.PERIOD)

    chosen = options(runs=1)
    picked = scaling.cases(256)
    names = [("height", "256"), ("width", "128"), ("frames", "2")]
    monkeypatch.setattr(scaling, "cases", lambda size: {name: picked[name] for name in names})
    monkeypatch.setattr(scaling, "peak_memory", lambda *asked: 10.0 * asked[2] * asked[3])
    results = scaling.rows(chosen)
    first, narrow, again = (row for row in results if row["part"] == "time")
    assert first["detection"] == again["detection"]  # each case is measured only once
    assert first["pixels"] == 2 * narrow["pixels"]
    for row in (first, narrow):
        assert in_order(row["detection"])
        assert in_order(row["restoration"])
        assert row["amplitude_percent"] < 1
        assert row["band_width"] == 6
    memory = [row for row in results if row["part"] == "memory"]
    assert {row["frames_of_memory"] for row in memory} == {1.25}
    text = "\n".join(scaling.lines(results, chosen))
    assert "\n".join(scaling.lines(*stored("scaling", results, chosen, tmp_path))) == text
    assert f"| width | 128 | 6 | {narrow['detection']['seconds']:.3f}" in text


@pytest.mark.slow
def test_peak_memory():
    from benchmarks.measure import peak_memory

    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("the system does not report the peak of memory")
    frame = 4 * 2048 * 1024  # memory that the process released before is reused and does not count: several MB
    exact, dewarped = (peak_memory(method, 1, 2048, 1024) for method in ("exact", "dewarp"))
    assert 2 * frame < dewarped < exact < 200 * frame
    assert peak_memory("detection", 2, 512, 512) > 2 * 4 * 512 * 512


def test_roofline(monkeypatch, tmp_path):
    from benchmarks import roofline

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
    text = "\n".join(roofline.lines(results, chosen))
    assert "| cpu | " in text
    assert "\n".join(roofline.lines(*stored("roofline", results, chosen, tmp_path))) == text


def test_restoration_next_to_row_loops():
    from benchmarks import restoration

    chosen = options(grid_size=176, images=[], no_pylops=True, no_deepinv=True)
    scene = restoration.scenes(chosen)["city"]
    found = {row["method"]: row["psnr_db"]["0.005"] for row in restoration.compare("city", scene, 20, chosen)}
    assert found["raw"] < 25
    assert found["exact"] > 44
    for name in ("skimage wiener, row loop", "skimage richardson_lucy, row loop", "cv2.remap, Lanczos-4"):
        assert found["raw"] + 10 < found[name] < found["exact"]


def test_results_are_stored_and_read_back(tmp_path):
    from benchmarks.store import read_result, write_result

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


def test_page_is_generated_from_stored_results(tmp_path):
    import benchmark_page

    rows = [
        {"name": "round trip", "seconds": 0.1, "seconds_least": 0.09, "seconds_most": 0.2, "round_trips": 1.0},
        {"name": "direct, 2 frames", "seconds": 2.5, "seconds_least": 2.0, "seconds_most": 3.0, "round_trips": 25.0},
    ]
    machine = {"processor": "Model X", "cores": 4, "threads": 2, "python": "3.11.7", "torch": "2.0", "load": None}
    machine |= {"libraries": {"NumPy": "2.0"}, "huge_pages": True, "kept_memory": False, "cuda": None}
    content = {"section": "cost", "version": "0.1.0", "commit": "0123456789", "date": "2026-01-31", "seconds": 61.4}
    content |= {"machine": machine, "options": {"size": 512, "runs": 5}, "rows": rows}
    (tmp_path / "cost.json").write_text(json.dumps(content))
    benchmark_page.main(["--results", str(tmp_path), "--out", str(tmp_path / "page.md")])
    page = (tmp_path / "page.md").read_text()
    assert (
        page
        == f"""{benchmark_page.HEAD}
## Time of detection

Measured by `python scripts/benchmark.py --only cost --store` with rsvib_torch 0.1.0, commit 0123456789, on 2026-01-31 \
in 61 s. Model X, 4 cores, 2 threads; Python 3.11.7, torch 2.0, NumPy 2.0; huge pages. No CUDA device.

| detection, 512^2 | seconds | FFT round trips |
|---|---|---|
| round trip | 0.100 (0.090 to 0.200) | 1.0 |
| direct, 2 frames | 2.500 (2.000 to 3.000) | 25.0 |
"""
    )


def test_the_page_of_the_documentation_is_up_to_date():
    import benchmark_page

    if any(benchmark_page.RESULTS.glob("*.json")):
        assert benchmark_page.PAGE.read_text() == benchmark_page.page_text(benchmark_page.RESULTS)


def stored(section, rows, chosen, folder):
    """Rows and options of a result after storing and reading."""
    from benchmarks.store import read_result, write_result

    result = read_result(write_result(section, rows, chosen, 1.0, folder))
    return result.rows, result.options


def test_one_command_writes_markdown_and_json(monkeypatch, tmp_path, capsys):
    import benchmark

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


def test_verdict(tmp_path):
    from benchmarks import verdict_roc

    case = {"hypothesis": "correct", "group": "correct", "moves": [True, True], "resolution": [0.0, 0.0]}
    good = case | {"outcome": "helps", "gain_db": 6.0, "predicted_gain": 5.0}
    good |= {"misfit_before": [1.0, 1.0], "misfit_after": [0.1, 0.0]}
    wrong = case | {"group": "wrong", "outcome": "worse", "gain_db": -4.0, "predicted_gain": -3.0}
    wrong |= {"misfit_before": [1.0, 1.0], "misfit_after": [1.5, 0.2]}
    noisy = good | {"gain_db": -1.0, "predicted_gain": -2.0, "outcome": "worse"}
    results = [good, wrong, noisy]
    text = verdict_roc.lines(results, options())
    assert "| > 0.3 dB | 1 | 0 | 0 | 0 |" in text
    assert "| < -0.3 dB | 0 | 0 | 0 | 2 |" in text
    assert sum(" 1.000 | " in line for line in text) == 2  # both scores separate these cases
    assert verdict_roc.lines(*stored("verdict", results, options(), tmp_path)) == text


def test_live(tmp_path):
    from benchmarks import live

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
    session = {"name": "session", "frames": 300, "dropped": 0, "delay_median": 0, "delay_99": 1, "within_two": 1.0}
    session |= {"cpu": 40.0, "memory": 500.0, "drift": 0.01, "tracked": 0.99, "predicted": 5, "detections": 1}
    accuracy = {
        "name": "accuracy",
        "errors": [[3e-4, 3e-4], [1e-3, 1e-3]],
        "batch_errors": [[2e-4, 2e-4], [1e-3, 1e-3]],
    }
    change = {"name": "sweep", "size": 64, "amplitude": 0.01, "frequency": 0.05, "lost": 0, "detections": 1}
    speed = {"name": "vidstab", "rate": 30.0, "cpu": 10.0, "rows": 2.0, "whole": 0.3}
    chosen = options(live_size=1024)
    text = live.lines([session, accuracy, change, speed], chosen)
    assert "| error of the amplitude: tracker, batch, ratio | 0.00030 px, 0.00020 px, 1.50 |" in text
    assert "| vidstab | 30.0 | 10 | 2.000 | 0.300 |" in text
    rows, chosen = stored("live", [session, accuracy, change, speed], chosen, tmp_path)
    assert live.lines(rows, chosen) == text


def test_video(tmp_path):
    from benchmarks import video

    chosen = options(video_rows=180, video_frames=12)
    results = video.rows(chosen)
    taken, exact, dewarp = results
    for row in (exact, dewarp):
        assert row["psnr"][0] > taken["psnr"][0] + 10  # dB, of luma
        assert row["psnr"][1] > taken["psnr"][1] + 3  # of chroma
        assert sum(row["parts"].values()) == pytest.approx(1.0)
        assert min(row["parts"].values()) > 0
    assert exact["parts"]["restoration"] > dewarp["parts"]["restoration"] > 0.03
    text = video.lines(results, chosen)
    assert any(line.startswith(f"| exact | {exact['cpu']:.3f} | 0.6") for line in text)
    assert video.lines(*stored("video", results, chosen, tmp_path)) == text
