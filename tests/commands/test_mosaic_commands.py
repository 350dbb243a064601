"""rsvib with raw frames behind colour filters, optics and a finer grid."""

import numpy as np
import pytest
from program import refused, rsvib
from small_stack import CAMERA as SMALL
from small_stack import HEIGHT, STILL, WIDTH, write_small

from rsvib_torch import read_stack, read_stack_info

CAMERA = SMALL.partition("[restoration]")[0]
CONFIG = f"""{CAMERA}
[restoration]
joint = true
scale = 2
mosaic = "RGGB"

[restoration.optics]
sigma = 0.4
pixel = 1.0

[stack]
window = 3
"""


@pytest.fixture(scope="module", name="place")
def make_place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mosaic")
    write_small(folder / "raw.tif", frames=5)  # of a grey scene
    (folder / "camera.toml").write_text(CAMERA)
    (folder / "mosaic.toml").write_text(CONFIG)
    assert rsvib("detect", folder / "raw.tif", "--config", folder / "camera.toml", "--out", folder / "found") == 0
    return folder


def restore(place, out, *more):
    vibration = ("--config", place / "camera.toml", "--vibration", place / "found" / "vibration.json")
    return ("restore", place / "raw.tif", out, *vibration, *more)


def test_run_in_windows_with_keys_of_the_configuration(place, tmp_path):
    assert rsvib("run", place / "raw.tif", tmp_path / "out", "--config", place / "mosaic.toml", "--workers", 1) == 0
    assert read_stack_info(tmp_path / "out" / "restored.tif").shape == (2, 3, 2 * HEIGHT, 2 * WIDTH)
    written = read_stack(tmp_path / "out" / "restored.tif")[0, :, ::2, ::2].double().numpy()
    assert np.sqrt(np.mean((written - STILL)[:, 12:-12, 12:-12] ** 2)) < 0.06
    assert (tmp_path / "out" / "before_after.png").exists()


def test_report_of_a_finer_grid(place, tmp_path):
    more = ("--scale", 2, "--joint", "all")
    assert rsvib("report", place / "raw.tif", tmp_path / "out", "--config", place / "camera.toml", *more) == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "2 x 2 points per px, the input is interpolated" in page


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--mosaic", "RGB"), "'RGB' is not one of 'RGGB', 'BGGR', 'GRBG', 'GBRG'"),
        (("--optics-sigma", -1), "error: --optics-sigma must be at least 0, got -1.0"),
        (("--optics-sigma", 0.4, "--method", "dewarp"), "is no option of method='dewarp'; its options are"),
        (("--scale", 3), "--scale must be 1 or 2, got 3"),
    ],
)
def test_errors(place, tmp_path, capsys, more, message):
    assert message in refused(capsys, *restore(place, tmp_path / "out.tif", *more))
    assert not list(tmp_path.iterdir())
