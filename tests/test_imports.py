"""Imports run one way: a module knows only what lies beneath it."""

import ast
from pathlib import Path

import pytest

import rsvib_torch

PACKAGE = Path(rsvib_torch.__file__).parent
# from the ground up; what shares a floor may not know each other
FLOORS = (
    {"pieces", "quadrature"},
    {"toeplitz"},
    {"arrays", "checks", "precision", "splines", "spectral", "missing", "parallel", "validation"},
    {"sensor"},
    {"vibration"},
    {"free_motion"},
    {"orientation"},
    {"registration", "imaging", "calibration"},
    {"detection", "restoration"},
    {"evaluation", "augmentation"},
    {"stacks", "motion_file"},
    {"config", "pictures", "terminal"},
    {"report", "pages"},
    {"workflow", "calibrate_command"},
    {"command_options"},
    {"stack_commands", "motion_command"},
    {"cli"},
)


def floor_of(room):
    for floor, rooms in enumerate(FLOORS):
        if room in rooms:
            return floor
    raise AssertionError(f"rsvib_torch.{room} has no floor yet: give it one in {Path(__file__).name}")


def rooms_imported(source, module):
    """Rooms of the package (first name below it) that a module imports, wherever in the file it does so.

    Functions, classes, ``if TYPE_CHECKING`` and ``try`` are searched as well, and imports by name.
    """
    package = module.split(".")
    found = []
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: -node.level] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            names = [f"{origin}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if called in {"import_module", "__import__"} and isinstance(node.args[0].value, str):
                names = [node.args[0].value]
        for name in names:
            parts = name.split(".")
            if parts[0] == "rsvib_torch":
                found.append((node.lineno, parts[1] if len(parts) > 1 else ""))
    return found


def wrong_imports(source, module):
    """Lines of a module that import from its own floor or from above, as ``line: importing -> imported``."""
    room = module.split(".")[1]
    wrong = []
    for line, name in rooms_imported(source, module):
        is_room = (PACKAGE / name / "__init__.py").exists() or (PACKAGE / f"{name}.py").exists()
        other = name if is_room else ""  # a public name comes from the whole package
        if not other and room == "cli":
            continue  # the outermost room may look at the whole package, for its version
        if other != room and (not other or floor_of(other) >= floor_of(room)):
            wrong.append(f"{line}: {room} -> {other or 'the whole package'}")
    return wrong


def modules():
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts != ("__init__",):
            yield pytest.param(path, ".".join(("rsvib_torch", *parts)), id="/".join(parts))


@pytest.mark.parametrize(("path", "module"), list(modules()))
def test_imports_run_one_way(path, module):
    assert wrong_imports(path.read_text(encoding="utf-8"), module) == []


@pytest.mark.parametrize(
    ("source", "module"),
    [
        ("from rsvib_torch.imaging import blur_rows", "rsvib_torch.vibration"),
        ("import rsvib_torch.cli", "rsvib_torch.stacks.files"),
        ("from rsvib_torch import detection", "rsvib_torch.imaging.psf"),
        ("import rsvib_torch", "rsvib_torch.sensor"),
        ("from rsvib_torch import SensorTiming", "rsvib_torch.imaging.psf"),
        ("from ..restoration import restore", "rsvib_torch.detection.result"),
        ("from .. import stacks", "rsvib_torch.detection.result"),
        ("def late():\n    from rsvib_torch.evaluation import psnr", "rsvib_torch.restoration.restore"),
        ("if TYPE_CHECKING:\n    import rsvib_torch.registration", "rsvib_torch.imaging.simulate"),
        ("try:\n    from rsvib_torch import report\nexcept ImportError:\n    pass", "rsvib_torch.stacks"),
        ("module = importlib.import_module('rsvib_torch.config')", "rsvib_torch.evaluation.quality"),
    ],
)
def test_an_import_that_runs_back_is_seen(source, module):
    line = source.count("\n", 0, max(source.find("rsvib_torch"), source.find("from .."), 0)) + 1
    wrong = wrong_imports(source, module)
    assert len(wrong) == 1
    assert wrong[0].startswith(f"{line}: ")


def test_imports_from_beneath_and_beside_are_right():
    source = "import math\nimport torch\nfrom rsvib_torch.sensor import SensorTiming\nfrom .motion import frame_motion"
    assert rooms_imported(source, "rsvib_torch.restoration.banded") == [(3, "sensor"), (4, "restoration")]
    assert wrong_imports(source, "rsvib_torch.restoration.banded") == []


def test_every_room_has_a_floor():
    rooms = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    for room in rooms - {"__init__"}:
        floor_of(room)
