"""Report pages: self-contained, escaped, with the right images, and sentences that match the verdict."""

import base64
import json
import math
import re
import shlex
import shutil
import subprocess
from dataclasses import replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path

import cv2
import detections
import numpy as np
import pytest
import torch
from edge_truth import draw_edge, gaussian, mtf50_of, through_pixels
from program import rsvib

from rsvib_torch.datasets import resolution_chart
from rsvib_torch.imaging import SensorNoise, simulate_frames
from rsvib_torch.io import write_stack
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.report.html.page import frames_in_turn, measure_edges, whole_frame, write_report_page
from rsvib_torch.report.html.template import pictures
from rsvib_torch.report.html.words import Report, overall_result, verdict_sentences
from rsvib_torch.report.plots import gain_figure, motion_blur, psf_figure, rows_figure
from rsvib_torch.restoration import RestorationVerdict
from rsvib_torch.results.reason import Reason

TIMING = SensorTiming(row_time=4e-5, exposure_rows=12, frame_rows=512)
COMMAND = "rsvib report '<img src=x>.tif' out"
SHAKE = Vibration([1.6, 1.1], [71.0, 113.0], [0.6, -1.2])


def result_of(vibration=SHAKE, reliable=(True, True), reasons=((), ())):
    """A detection without errors."""
    return detections.result_of(vibration, TIMING, 0.001, last_row=240, reliable=reliable, reasons=reasons)


def verdict_of(outcome, *reasons):
    pair, one = torch.zeros(1, 2), torch.full((1,), 3.0)
    return RestorationVerdict(one, one, pair, pair, pair, one, one, one, (outcome,), (reasons,))


def report_of(**changes):
    scene = resolution_chart(256, 224, sigma=0.7)
    frames = torch.stack([scene.roll(2, 0), scene.roll(-3, 1)])
    whole = Report(
        title="<script>alert(1)</script>",
        subtitle='a "quoted" & <b>bold</b> name',
        frames=frames,
        restored=scene.expand(2, -1, -1),
        was_restored=True,
        timing=TIMING,
        detection=result_of(),
        verdict=verdict_of("helps"),
        left_alone=(),
        options={"method": "<exact>"},
        version="1.2.3",
        command=COMMAND,
        created=datetime(2031, 5, 7, 11, 30, 5, tzinfo=UTC),
    )
    return replace(whole, **changes)


class Reader(HTMLParser):
    """Tags with their attributes, and the text."""

    def __init__(self):
        super().__init__()
        self.tags, self.text = [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text.append(data)


def read(path):
    reader = Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    return reader


def decoded(uri):
    kind, content = uri.split(",", 1)
    assert re.fullmatch(r"data:image/(png|jpeg);base64", kind)
    image = cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


@pytest.fixture(scope="module", name="page")
def make_page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    files = write_report_page(folder, report_of())
    return folder, files, read(folder / "report.html")


def test_page_is_self_contained(page):
    folder, files, reader = page
    assert sorted(files) == sorted(path.name for path in folder.iterdir())
    images = [attributes["src"] for tag, attributes in reader.tags if tag == "img"]
    assert len(images) >= 2 + 2 + 5
    for uri in images:
        assert min(decoded(uri).shape[:2]) > 10
    for _, attributes in reader.tags:
        assert "href" not in attributes
        assert "srcset" not in attributes
        assert attributes.get("src", "data:").startswith("data:")
        assert not any(name.startswith("on") for name in attributes)
    style = (folder / "report.html").read_text().split("<style>")[1].split("</style>")[0]
    assert "url(" not in style
    assert "@import" not in style
    for name in files:
        if name.endswith(".png"):
            assert min(cv2.imread(str(folder / name)).shape[:2]) > 300


def test_text_of_the_user_is_escaped_and_all_sections_are_there(page):
    _, _, reader = page
    assert [tag for tag, _ in reader.tags].count("script") == 1
    text = "".join(reader.text)
    for part in ("Offsets along y", "1.6000 ± 0.0010", "Point spread functions", "MTF of slanted edges", COMMAND):
        assert part in text
    (slider,) = (attributes for _, attributes in reader.tags if attributes.get("type") == "range")
    assert "aria-label" in slider
    assert text.count("<script>alert(1)</script>") == 2  # title and heading
    assert 'a "quoted" & <b>bold</b> name' in text
    assert "method = <exact>" in text


@pytest.mark.parametrize("shape", [(3000, 700), (3, 700, 3000), (2, 90, 60)])
def test_images_are_bounded_and_have_a_common_grey_scale(shape):
    ramp = torch.linspace(0, 1, shape[-1]).expand(shape)
    shown = pictures({"a": [0.5 * ramp], "b": [ramp]}, most_pixels=200_000)
    first, second = (decoded(uri).astype(float) for _, (uri,) in shown.panels)
    assert first.shape[0] * first.shape[1] <= 201_000
    assert (shown.height, shown.width) == first.shape[:2] == second.shape[:2]
    assert shown.scale == pytest.approx(first.shape[1] / shape[-1])
    assert (first.ndim == 3) == (shape[0] == 3)
    assert first[..., -3:].max() == pytest.approx(0.5 * second.max(), abs=3)
    assert second.max() == 255


def test_colours_are_in_order_and_missing_pixels_black():
    frame = torch.zeros(3, 40, 40)
    frame[0, :20], frame[2, 20:], frame[:, 30] = 1.0, 1.0, torch.nan
    ((_, (uri,)),) = pictures({"a": [frame]}).panels
    expected = [[0, 0, 255], [255, 0, 0], [0, 0, 0]]  # blue, green, red
    np.testing.assert_allclose(decoded(uri)[[5, 36, 30], 5].astype(int), expected, atol=40)


def test_motion_blur_is_the_range_of_the_displacement():
    starts = torch.arange(0, 0.05, 1e-5, dtype=torch.float64)
    found = motion_blur(SHAKE, starts, TIMING).amax(0)
    expected = 2 * SHAKE.amplitude[:, 0] * (math.pi * SHAKE.frequency[:, 0] * TIMING.exposure_time).sin()
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0)
    moving = Vibration([0.0, 0.0], [0.0, 0.0], image_motion=[300.0, -200.0])
    expected = torch.tensor([300.0, 200.0]).double() * TIMING.exposure_time
    torch.testing.assert_close(motion_blur(moving, starts[:5], TIMING), expected.expand(5, 2))


def test_gain_and_rows_figures_draw_the_model():
    figure = gain_figure(result_of(reliable=(True, False), reasons=((), ("x",))), TIMING)
    upper, lower = figure.axes
    curve = upper.lines[0].get_xydata()
    expected = 2 * np.sin(np.pi * curve[:, 0] * TIMING.frame_period) * np.sinc(curve[:, 0] * TIMING.exposure_time)
    np.testing.assert_allclose(curve[:, 1], np.abs(expected), atol=1e-12)
    assert [text.get_text() for text in upper.get_legend().get_texts()] == ["x", "y (not reliable)"]
    bars = [container.lines[0].get_xydata()[0] for container in lower.containers]
    np.testing.assert_allclose(bars, [[71.0, 1.6], [113.0, 1.1]])
    place = rows_figure(SHAKE, TIMING, 200).axes[0].lines
    starts = TIMING.row_starts(1, 200)[0]
    for axis in range(2):
        expected = SHAKE.mean_displacement(starts, TIMING.exposure_time)[:, axis]
        np.testing.assert_allclose(place[axis].get_ydata(), expected)


@pytest.mark.parametrize("motion", [SHAKE, Vibration([0.1, 0.2], [60.0, 90.0], 0.3, [3000.0, 0.0])])
def test_kernels_are_centred_on_their_rows(motion):
    for panel in psf_figure(motion, TIMING, 300).axes:
        kernel = panel.images[0].get_array()
        assert kernel.sum() == pytest.approx(1.0)
        left, _, _, top = panel.images[0].get_extent()
        y, x = np.indices(kernel.shape)
        centre = np.array([(kernel * (x + left + 0.5)).sum(), (kernel * (y + top + 0.5)).sum()])
        assert np.abs(centre).max() <= 0.5 + 1e-9
        np.testing.assert_allclose(panel.lines[0].get_xydata().mean(0), centre, atol=0.02)


def test_edges_are_measured_in_both_frames():
    frames = [torch.from_numpy(np.pad(draw_edge(5.0, sigma, (80, 60)), 6, mode="edge")) for sigma in (0.9, 0.6)]
    (pair,), notes = measure_edges(*frames, [(6, 6, 80, 60)])
    assert notes == []
    for curve, sigma in ((pair.before, 0.9), (pair.after, 0.6)):
        assert float(curve.mtf50) == pytest.approx(mtf50_of(through_pixels(gaussian(sigma), 5.0)), rel=1e-3)
    assert pair.direction == "horizontal"
    flat = torch.full((92, 72), 0.5)
    pairs, notes = measure_edges(flat, flat, [(0, 0, 40, 40)])
    assert pairs == []
    assert notes[0].startswith("The edge at rows 0 … 39, columns 0 … 39 was not measured")
    assert measure_edges(flat, flat) == ([], [])
    with pytest.raises(ValueError, match=r"edge 60,0,40,40 .* must be inside the frame of 92 x 72 px"):
        measure_edges(flat, flat, [(60, 0, 40, 40)])


@pytest.mark.parametrize(
    ("reliable", "verdict", "restored", "mood", "first"),
    [
        ((True, True), verdict_of("helps"), True, "good", "restoration improves the frames"),
        ((True, False), verdict_of("partly", Reason("no_contrast", "y")), True, "doubt", "removed in part"),
        ((True, True), verdict_of("unknown", Reason("nothing_undone")), True, "doubt", "not sufficient to determine"),
        ((True, True), None, True, "doubt", "not sufficient to determine whether"),
        ((True, True), verdict_of("worse", Reason("no_contrast", "x")), False, "bad", "does not improve the frames"),
        ((False, False), None, False, "doubt", "No vibration was detected that can be removed"),
        ((False, False), verdict_of("helps"), True, "bad", "not reliable"),
    ],
)
def test_sentences_match_the_verdict(reliable, verdict, restored, mood, first):
    reasons = tuple(() if good else ("only a third of a period is seen",) for good in reliable)
    result = result_of(reliable=reliable, reasons=reasons)
    report = report_of(detection=result, verdict=verdict, was_restored=restored)
    assert overall_result(report, result)[0] == mood
    words = verdict_sentences(report, result, SHAKE)
    assert first in words[0]
    for name, good in zip("xy", reliable, strict=True):
        refused = f"The vibration along {name} is not reliable: only a third of a period is seen."
        assert (refused in words) != good
    assert any("blurred by up to" in line for line in words)


def test_consecutive_frames_are_shown_at_one_place_of_the_scene():
    speed = 7 / TIMING.frame_period  # px/s along x: 7 px between the frames
    moving = Vibration([1.6, 1.1], [71.0, 113.0], [0.6, -1.2], [speed, -2 * speed])
    scene = resolution_chart(300, 320, sigma=0.7)
    frames = torch.stack([scene[20:276, 40:264], scene[34:290, 33:257]])  # the content moves by (7, -14) px
    shown = frames_in_turn(report_of(frames=frames, restored=frames.flip(-1)), 0, moving.image_motion)
    assert [name for name, _ in shown.panels] == ["input", "restored"]
    images = [decoded(uri).astype(float) for _, pair in shown.panels for uri in pair]
    assert np.abs(images[0] - images[1]).max() < 20  # JPEG
    assert np.abs(images[2] - images[3]).mean() > 20  # these frames are mirrored, and move the other way
    row, column = map(int, re.findall(r"rows (\d+) … \d+, columns (\d+)", shown.caption)[0])
    part = frames[0, row : row + shown.height, column : column + shown.width].numpy()
    assert np.corrcoef(images[0].ravel(), part.ravel())[0, 1] > 0.99
    assert "Frame 1 is moved by -7 px along x and 14 px along y, the uniform motion." in shown.caption


def test_one_frame_and_one_joint_image():
    report = report_of(restored=report_of().frames[:1])
    pair = whole_frame(report, 1, {"input": report.frames[1], "restored": report.restored[0]})
    assert pair.caption.startswith("Frame 1, and one image restored jointly from all frames. Grey levels are stretched")
    assert [name for name, _ in frames_in_turn(report, 1, SHAKE.image_motion).panels] == ["input"]
    assert frames_in_turn(report_of(frames=report.frames[:1]), 0, SHAKE.image_motion) is None


def test_page_without_restoration_has_no_pairs_but_reasons_and_next_steps(tmp_path):
    reasons = (("tone of 71 Hz is nearly blind",), ())
    report = report_of(
        detection=result_of(reliable=(False, True), reasons=reasons),
        verdict=verdict_of("worse", Reason("motion_remains", "y", 2.0, 1.6, {"before": 2.0})),
        was_restored=False,
        next_steps=("Inspect the restored frames nevertheless:\n  rsvib report a&b.tif out --force",),
    )
    files = write_report_page(tmp_path, report, [(0, 0, 40, 40)])
    reader = read(tmp_path / "report.html")
    text = "".join(reader.text)
    verdict = text[: text.index("What to do next")]
    assert "not reliable: tone of 71 Hz is nearly blind" in verdict
    assert "2 px remain unexplained" in verdict
    assert "rsvib report a&b.tif out --force" in text[text.index("What to do next") : text.index("Input frame")]
    assert "Input and restored" not in text
    assert "details.png" not in files
    assert [attributes for _, attributes in reader.tags if attributes.get("type") == "range"] == []
    sources = [attributes["src"] for tag, attributes in reader.tags if tag == "img"]
    assert len(sources) == len(set(sources))  # no image twice
    assert len(sources) == 1 + 2 + sum(name.endswith(".png") for name in files)  # frame, frames in turn, figures


def script_results(page, motion="motion"):
    """What the script of a page did with the events that page_dom.js sends."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node")
    harness = Path(__file__).with_name("page_dom.js")
    done = subprocess.run([node, harness, page, motion], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_script_of_the_page(page):
    found = script_results(page[0] / "report.html")
    assert [cut for _, cut, _ in found["cuts"]] == ["49%", "48%", "49%", "50%", "49%", "59%", "59%", "100%", "0%"]
    assert [prevented for _, _, prevented in found["cuts"]] == [True] * 6 + [False] + [True] * 2
    assert found["spoken"] == "0 % from the left"
    assert found["off"] == {"drawn": [None, None], "row": "", "column": "", "hidden": True, "pressed": "false"}
    assert (found["first"]["hidden"], found["first"]["pressed"], found["closed"]) == (False, "true", True)
    # the stage of 200 x 100 px of the harness shows the frame of 224 x 256 px; the magnifier shows 40 x 40 px
    row, column = 64, 168
    expected = [column - 20, row - 20, 40, 40, 0, 0, 40, 40]
    assert found["pointed"]["drawn"] == [["input", *expected], ["restored", *expected]]
    assert (found["pointed"]["row"], found["pointed"]["column"]) == (row, column)
    assert found["entered"]["drawn"][0][1:3] == [column - 20, 0]  # row 5 is closer to the edge than half the square
    first, second = ["frame 0"] * 2, ["frame 1"] * 2
    assert found["blink"] == [
        [True, second, "Stop blinking", True],
        [False, first, "Stop blinking", True],
        [True, second, "Stop blinking", True],
        [True, second, "Start blinking", False],
        [True, second, "Start blinking", False],  # one step stops
    ]
    assert not found["start_hidden"]
    assert script_results(page[0] / "report.html", "reduced")["start_hidden"]


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("camera")
    (folder / "camera.toml").write_text(
        "[sensor]\nrow_time = 4e-5\nexposure_rows = 12\nframe_rows = 512\nfull_scale = 4095\n"
    )
    scene = resolution_chart(352, 240, sigma=0.7)
    noise = SensorNoise(read_noise=0.003, bits=12)
    frames = simulate_frames(
        scene, TIMING, SHAKE, 2, frame_size=(288, 176), noise=noise, generator=torch.Generator().manual_seed(3)
    )
    write_stack(folder / "chart & <co>.tif", frames, dtype="uint16", full_scale=4095)
    return folder


def test_command_writes_a_page(place):
    frames, config, out = (str(place / name) for name in ("chart & <co>.tif", "camera.toml", "out"))
    arguments = ["run", frames, out, "--config", config, "--report"]
    assert rsvib(*arguments) == 0
    text = "".join(read(place / "out" / "report.html").text)
    assert "Vibration in chart & <co>.tif" in text
    assert "The vibration of the camera was measured and removed; restoration improves the frames." in text
    found = re.search(r"The vibration along x is ([\d.]+) ± [\d.]+ px at ([\d.]+)", text)
    assert float(found[1]) == pytest.approx(1.6, rel=0.01)
    assert float(found[2]) == pytest.approx(71.0, rel=0.002)
    assert (place / "out" / "psf.png").exists()
    assert shlex.join(["rsvib", *arguments]) in text
