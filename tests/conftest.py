"""Fixtures of all tests, and the selection of the quick ones: ``pytest tests --quick``, ``make quick``."""

from pathlib import Path

import psutil
import pytest
import torch
from hypothesis import settings
from matplotlib.backend_bases import FigureCanvasBase
from PIL import Image
from small_stack import FRAMES, WINDOWS, process_small, write_small

from rsvib_torch import SensorTiming

settings.register_profile("any machine", deadline=None)  # the first example imports what it uses
settings.load_profile("any machine")
TESTS = Path(__file__).parent
ALGORITHMS = ("detection", "registration", "restoration", "tracking", "test_imports.py", "test_turned_frames.py")
RENDERED = {"report", "test_presentation.py", "test_docs.py", "test_spectrum.py"}  # tests of figures
LONGEST = (
    "test_tutorials.py",
    "test_changing_vibration.py",
    "test_camera_path.py",
    "test_diagnosis.py",
    "test_verdict.py",
    "test_all_functions.py",
    "test_process_video.py",
    "test_direct.py",
    "test_mosaic.py",
    "test_steady_by_gyroscope.py",
    "test_rotation_alignment.py",
)
SLOWER_TESTS = [line for line in (TESTS / "slower_tests.txt").read_text().splitlines() if not line.startswith("#")]


def pytest_addoption(parser):
    parser.addoption("--quick", action="store_true", help="tests of the algorithms, without tests/slower_tests.txt")


def pytest_ignore_collect(collection_path, config):
    """With ``--quick``, the tests of the algorithms are collected only."""
    if config.getoption("quick", False) and collection_path != TESTS:
        return collection_path.relative_to(TESTS).parts[0] not in ALGORITHMS or None
    return None


def pytest_collection_modifyitems(config, items):
    """The longest files begin, so that all workers end together; ``--quick`` leaves out ``slower_tests.txt``."""
    items.sort(key=lambda item: item.path.name not in LONGEST)
    if config.getoption("quick", False):
        slower = [item for item in items if item.nodeid.split("[")[0].removeprefix("tests/") in SLOWER_TESTS]
        config.hook.pytest_deselected(items=slower)
        items[:] = [item for item in items if item not in slower]


@pytest.fixture(scope="session")
def paper_camera():
    """The camera of the paper: 20.52 us per row, exposure of 20 rows, no blanking."""
    return SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


@pytest.fixture(autouse=True)
def same_random_numbers():
    """Seed the global generators, so that tests without a generator of their own are reproducible."""
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def figures_are_not_rendered(request, monkeypatch):
    """Write white images in place of figures, except in tests of figures: rendering takes most of a command's time."""

    def print_figure(canvas, file, **_):
        width, height = canvas.figure.get_size_inches() * 100
        Image.new("RGB", (round(width), round(height)), "white").save(file, "png")

    if not RENDERED & set(request.path.parts):
        monkeypatch.setattr(FigureCanvasBase, "print_figure", print_figure)


@pytest.fixture(name="set_free")
def replace_free_memory(monkeypatch):
    """Sets the free memory of the machine, in bytes."""

    def set_free(size):
        memory = psutil.virtual_memory()._replace(available=size)
        monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)

    return set_free


@pytest.fixture(scope="session", name="whole")
def process_whole(tmp_path_factory):
    """A folder with a stack and the outputs of uninterrupted runs."""
    folder = tmp_path_factory.mktemp("whole")
    write_small(folder / "frames.tif")
    for name in ("out.tif", "out.npy"):
        report = process_small(folder / "frames.tif", folder / name)
        assert (report.frames, report.windows, report.restored) == (FRAMES, WINDOWS, WINDOWS)
    return folder
