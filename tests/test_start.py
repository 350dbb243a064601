"""Start of the package and of the program: what is imported when, and names that type checkers and editors find."""

import ast
import os
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

import rsvib_torch as rsv
from rsvib_torch.detection import pipeline
from rsvib_torch.motion import recorded
from rsvib_torch.options import METHOD_OPTIONS, BadFrames, DetectionMethod, MotionUnit, PriorName, Registration
from rsvib_torch.registration.methods import BAND_METHODS
from rsvib_torch.restoration.exact.priors import PRIORS
from rsvib_torch.restoration.restore import METHODS

PACKAGE = Path(rsv.__file__).parent
LIBRARIES = ("kornia", "cv2", "scipy", "tifffile", "h5py", "zarr", "matplotlib", "jinja2", "dask", "imagecodecs")
PROGRAM = ("torch", "numpy", *LIBRARIES)
BAD_CONFIG = """
[sensor]
row_time = 2e-5
exposure_time = 1e-3
frame_rate = 25
frame_row = 512
[detection]
search = "far"
[restoration]
method = "banded"
prior = "edges"
[stack]
window = 1
"""


def loaded(code, names, folder):
    """Names of modules that a new interpreter has imported after running some code."""
    program = f"{code}\nimport sys\nprint(*(name for name in {names!r} if name in sys.modules), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=folder, check=True)
    return done.stderr.splitlines()[-1].split()


def command(arguments):
    return f"run_command({arguments.split()!r})"


COMMANDS = (  # help, lists, and what is refused before anything is computed
    "--help",
    "known --help",
    "export vibration.json clip.unknown",
    "run frames.tif out --config none.toml",
    "detect frames.tif --out out --config bad.toml",
    "detect frames.tif --out out --config camera.toml --exposure 1",
    "init --list-presets",
    "cameras iphone 12",
)


@pytest.mark.parametrize(
    ("code", "names"),
    [
        ("import rsvib_torch", ("torch", "numpy", "pydantic", "typer", "rich", *LIBRARIES)),
        ("import torch, rsvib_torch as rsv\nrsv.SensorTiming, rsv.Vibration, rsv.io, rsv.restoration", LIBRARIES),
        ("from rsvib_torch.config import read_config\nread_config('camera.toml')", PROGRAM),
        ("from rsvib_torch.commands.main import run_command\n" + "\n".join(map(command, COMMANDS)), PROGRAM),
    ],
)
def test_libraries_are_imported_when_they_are_used(tmp_path, code, names):
    (tmp_path / "bad.toml").write_text(BAD_CONFIG)
    (tmp_path / "camera.toml").write_text("[sensor]\nrow_time = 2e-5\nexposure_rows = 20\nframe_rows = 512\n")
    assert loaded(code, names, tmp_path) == []


def test_names_of_options_are_those_of_the_tables():
    assert list(METHOD_OPTIONS) == list(METHODS)
    assert set(get_args(PriorName)) == set(PRIORS)
    assert set(get_args(Registration)) == set(BAND_METHODS)
    assert set(get_args(DetectionMethod)) == set(pipeline.METHODS)
    assert set(get_args(MotionUnit)) == {"px", *recorded._RADIANS}
    assert get_args(BadFrames) == ("pass", "skip")


def stubs():
    return sorted(PACKAGE.rglob("*.pyi"))


@pytest.mark.parametrize("stub", stubs(), ids=lambda path: path.parent.name)
def test_stub_lists_what_the_package_has(stub):
    """Every name of a stub can be imported, and its list of names is that of the package."""
    tree = ast.parse(stub.read_text(encoding="utf-8"))
    imports = [alias for node in tree.body if isinstance(node, ast.ImportFrom) and node.module for alias in node.names]
    lists = (ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign))
    listed = next(lists, [alias.asname for alias in imports])
    module = ".".join(("rsvib_torch", *stub.relative_to(PACKAGE).parts[:-1]))
    package = __import__(module, fromlist=["x"])
    assert sorted(package.__all__) == sorted(listed)
    for name in listed:
        assert getattr(package, name) is not None
        assert name in dir(package)
    with pytest.raises(AttributeError):
        package.no_such_name  # noqa: B018


def test_functions_named_like_their_module_stay_functions():
    code = (
        "import rsvib_torch.restoration.restore\nfrom rsvib_torch.restoration import restore\nassert callable(restore)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_type_checker_knows_the_names(tmp_path, pytestconfig):
    pytest.importorskip("mypy")
    (tmp_path / "user.py").write_text(
        "import rsvib_torch as rsv\n"
        "from rsvib_torch.imaging.trajectory import rows_showing\n"
        "from rsvib_torch.io import StackInfo\n"
        "timing = rsv.SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)\n"
        "info: StackInfo = rsv.read_stack_info('frames.tif')\n"
        "reveal_type(rsv.restore(rsv.read_stack('frames.tif'), timing, rsv.Vibration.still()))\n"
        "rsv.evaluation.cramer_rao_bound\n"
        "rsv.restor\n"
        "frames, still = rsv.read_stack('frames.tif'), rsv.Vibration.still()\n"
        "rsv.detect_vibration(frames, timing=timing, tones=2).vibration\n"
        "rsv.detect_motion(frames, timing, knot_rows=20).motion\n"
        "rsv.restore(frames, timing, still, half_rows='x')\n"
        "rsv.restore(frames, timing, still, method='magic')\n"
        "rsv.register_bands(frames, timing, band_row=3)\n"
        "rsv.VibrationTracker(timing, window=4.5)\n"
        "rsv.detect_swept_tone(frames, timing, tones=2)\n"
        "row, start = frames[0, :, 0], frames[0, 0, 0]\n"
        "rows_showing(row, start, timing.in_row_order(), still)\n"
        "rows_showing(row, start, timing, still)\n"
    )
    cache = pytestconfig.cache.mkdir("mypy")  # types of PyTorch are read once, in a minute
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(cache), "user.py"]
    found = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}  # mypy does not follow the hooks of editable installations
    shown = subprocess.run(command, cwd=tmp_path, env=found, capture_output=True, text=True, check=False).stdout
    assert 'note: Revealed type is "torch._tensor.Tensor"' in shown
    assert 'user.py:8: error: Module has no attribute "restor"' in shown
    mistakes = [line.split(":")[1] for line in shown.splitlines() if "error:" in line]
    # options are known from the fields of their groups; functions of rows require a timing in row order
    assert mistakes == ["8", "12", "13", "14", "15", "16", "19"]
    assert 'has incompatible type "SensorTiming"; expected "RowTiming"' in shown
