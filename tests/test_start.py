"""Start of the package and of the program: what is imported when, and names that type checkers and editors find."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import get_args

import pytest

import rsvib_torch as rsv
from rsvib_torch.motion import recorded
from rsvib_torch.options import METHOD_OPTIONS, MotionUnit, PriorName, Registration
from rsvib_torch.registration.methods import BAND_METHODS
from rsvib_torch.restoration.priors import PRIORS
from rsvib_torch.restoration.restore import METHODS

PACKAGE = Path(rsv.__file__).parent
LIBRARIES = ("kornia", "cv2", "scipy", "tifffile", "h5py", "matplotlib", "jinja2", "imagecodecs")
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


COMMANDS = (  # help, lists, and what is refused before anything is computed
    "--help",
    "known --help",
    "run frames.tif out --config none.toml",
    "detect frames.tif --out out --config bad.toml",
    "detect frames.tif --out out --config camera.toml --exposure 1",
    "cameras iphone 12",
)


@pytest.mark.parametrize(
    ("code", "names"),
    [
        ("import rsvib_torch", ("torch", "numpy", "pydantic", "typer", "rich", *LIBRARIES)),
        ("import torch, rsvib_torch as rsv\nrsv.SensorTiming, rsv.Vibration, rsv.io, rsv.restoration", LIBRARIES),
        ("from rsvib_torch.config import read_config\nread_config('camera.toml')", PROGRAM),
        (
            "from rsvib_torch.commands.main import run_command\n"
            + "\n".join(f"run_command({line.split()!r})" for line in COMMANDS),
            PROGRAM,
        ),
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
    assert set(get_args(MotionUnit)) == {"px", *recorded._RADIANS}


@pytest.mark.parametrize("stub", sorted(PACKAGE.rglob("*.pyi")), ids=lambda path: path.parent.name)
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
    import_module("rsvib_torch.restoration.restore")
    assert callable(rsv.restoration.restore)
