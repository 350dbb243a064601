"""Report pages: self-contained, escaped, with the right images, and a headline that matches the verdict."""

import base64
import re
import shlex
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import detections
import numpy as np
import pytest
import torch
from benchmarks.resolution_chart import resolution_chart
from program import rsvib

from rsvib_torch.imaging import SensorNoise, simulate_frames
from rsvib_torch.io import write_stack
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.report.page import Report, encoded, frames_in_turn, headline, write_report_page
from rsvib_torch.report.plots import psf_figure

TIMING = SensorTiming(row_time=4e-5, exposure_rows=12, frame_rows=512)
COMMAND = "rsvib report '<img src=x>.tif' out"
SHAKE = Vibration([1.6, 1.1], [71.0, 113.0], [0.6, -1.2])


def result_of(vibration=SHAKE, reliable=(True, True), reasons=((), ())):
    """A detection without errors."""
    return detections.result_of(vibration, TIMING, 0.001, last_row=240, reliable=reliable, reasons=reasons)


def report_of(**changes):
    scene = resolution_chart(256, 224, sigma=0.7)
    whole = Report(
        title="<script>alert(1)</script>",
        subtitle='a "quoted" & <b>bold</b> name',
        frames=torch.stack([scene.roll(2, 0), scene.roll(-3, 1)]),
        timing=TIMING,
        restored=scene.expand(2, -1, -1),
        detection=result_of(),
        outcome="helps",
        texts={"Vibration": result_of().summary()},
        next_steps=("Write the restored frames:\n  rsvib run a&b.tif out",),
        made_with=COMMAND,
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
    assert files == ["report.html", "before_after.png", "offsets.png", "psf.png"]
    assert sorted(files) == sorted(path.name for path in folder.iterdir())
    images = [attributes["src"] for tag, attributes in reader.tags if tag == "img"]
    assert len(images) == 2 + 4 + len(files) - 1
    assert all(min(decoded(uri).shape[:2]) > 10 for uri in images)
    for tag, attributes in reader.tags:
        assert tag != "script"
        assert not {"href", "srcset"} & attributes.keys()
        assert attributes.get("src", "data:").startswith("data:")
        assert not any(name.startswith("on") for name in attributes)
    style = (folder / "report.html").read_text().split("<style>")[1].split("</style>")[0]
    assert "url(" not in style
    assert "@import" not in style
    for name in files[1:]:
        assert min(cv2.imread(str(folder / name)).shape[:2]) > 300


def test_text_of_the_user_is_escaped_and_frames_are_switched_by_boxes_with_labels(page):
    text = "".join(page[2].text)
    for part in ("1.6000 ± 0.0010", "Point spread functions", "rsvib run a&b.tif out", COMMAND):
        assert part in text
    boxes = [attributes["id"] for tag, attributes in page[2].tags if tag == "input"]
    assert boxes == [attributes["for"] for tag, attributes in page[2].tags if tag == "label"] == ["show1", "show2"]
    assert text.count("<script>alert(1)</script>") == 2  # title and heading
    assert 'a "quoted" & <b>bold</b> name' in text


@pytest.mark.parametrize("shape", [(9000, 700), (3, 300, 9000), (2, 90, 60)])
def test_images_are_bounded_and_have_a_common_grey_scale(shape):
    ramp = torch.linspace(0, 1, shape[-1]).expand(shape)
    first, second = (decoded(uri).astype(float) for uri in encoded([0.5 * ramp, ramp])[0])
    assert first.shape[:2] == second.shape[:2]
    assert max(first.shape) <= 4096
    assert (first.ndim == 3) == (shape[0] == 3)
    assert first[..., -3:].max() == pytest.approx(0.5 * second.max(), abs=3)
    assert second.max() == 255


def test_colours_are_in_order_and_missing_pixels_black():
    frame = torch.zeros(3, 40, 40)
    frame[0, :20], frame[2, 20:], frame[:, 30] = 1.0, 1.0, torch.nan
    (uri,), _ = encoded([frame])
    expected = [[0, 0, 255], [255, 0, 0], [0, 0, 0]]  # blue, green, red
    np.testing.assert_allclose(decoded(uri)[[5, 36, 30], 5].astype(int), expected, atol=40)


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


@pytest.mark.parametrize(
    ("reliable", "outcome", "restored", "mark", "sentence"),
    [
        ((True, True), "helps", True, "good", "restoration improves the frames"),
        ((True, False), "partly", True, "doubt", "removed in part"),
        ((True, True), "unknown", True, "doubt", "not sufficient to determine"),
        ((True, True), None, True, "doubt", "not sufficient to determine whether"),
        ((True, True), "worse", False, "bad", "does not improve the frames"),
        ((False, False), None, False, "doubt", "No vibration was found that can be removed"),
        ((False, False), "helps", True, "bad", "not reliable"),
    ],
)
def test_headline_matches_the_verdict(reliable, outcome, restored, mark, sentence):
    report = report_of(detection=result_of(reliable=reliable), outcome=outcome)
    found = headline(report if restored else replace(report, restored=None))
    assert found[0] == mark
    assert sentence in found[1]


def test_consecutive_frames_are_shown_at_one_place_of_the_scene():
    motion = torch.tensor([7.0, -14.0]) / TIMING.frame_period  # px/s
    scene = resolution_chart(300, 320, sigma=0.7)
    frames = torch.stack([scene[20:276, 40:264], scene[34:290, 33:257]])  # the content moves by (7, -14) px
    shown = frames_in_turn(report_of(frames=frames, restored=frames.flip(-1)), 0, motion)
    assert [name for name, _ in shown["panels"]] == ["input", "restored"]
    images = [decoded(uri).astype(float) for _, pair in shown["panels"] for uri in pair]
    assert np.abs(images[0] - images[1]).max() < 20  # JPEG
    assert np.abs(images[2] - images[3]).mean() > 20  # these frames are mirrored, and move the other way
    row, column = map(int, re.findall(r"rows (\d+) … \d+, columns (\d+)", shown["caption"])[0])
    height, width = images[0].shape
    part = frames[0, row : row + height, column : column + width].numpy()
    assert np.corrcoef(images[0].ravel(), part.ravel())[0, 1] > 0.99
    assert "Frame 1 is moved by -7 px along x and 14 px along y, the uniform motion." in shown["caption"]
    joint = report_of(restored=frames[:1])
    assert [name for name, _ in frames_in_turn(joint, 1, motion)["panels"]] == ["input"]
    assert frames_in_turn(report_of(frames=frames[:1]), 0, motion) is None


def test_page_without_restoration_has_one_image_of_the_frame(tmp_path):
    files = write_report_page(tmp_path, report_of(restored=None, outcome="worse"))
    reader = read(tmp_path / "report.html")
    assert "Restoration does not improve the frames; they are unchanged." in "".join(reader.text)
    assert "before_after.png" not in files
    assert [attributes["id"] for tag, attributes in reader.tags if tag == "input"] == ["show2"]
    assert sum(tag == "img" for tag, _ in reader.tags) == 1 + 2 + len(files) - 1  # frame, frames in turn, figures


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
    found = re.search(r"x +([\d.]+) ± [\d.]+ .*? (7[\d.]+) ±", text)
    assert float(found[1]) == pytest.approx(1.6, rel=0.01)
    assert float(found[2]) == pytest.approx(71.0, rel=0.002)
    assert (place / "out" / "psf.png").exists()
    assert shlex.join(["rsvib", *arguments]) in text
