"""Imports go downwards only: between packages, between the parts of a package, and between modules (no cycles)."""

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import architecture
import pytest
from architecture import INNER_LAYERS

import rsvib_torch

PACKAGE = Path(rsvib_torch.__file__).parent
LAYERS = ({"__main__"}, *architecture.LAYERS)[::-1]  # from the lowest layer to the highest


def layer_of(part, layers):
    for number, parts in enumerate(layers):
        if part in parts:
            return number
    raise AssertionError(f"{part!r} has no layer: add it to LAYERS or INNER_LAYERS of scripts/architecture.py")


# Modules that import what their callers name.
IMPORT_BY_NAME = {"rsvib_torch.checks.values"}


def imported_modules(source, module):
    """Modules of rsvib_torch that a module imports anywhere in its file, with the line: [(line, dotted name)].

    Functions, classes, ``if TYPE_CHECKING`` and ``try`` are included, and imports by name. An import of a computed
    name counts as one of the whole package.
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
        elif isinstance(node, ast.Call):
            called = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if called in {"import_module", "__import__"}:
                texts = [entry.value for entry in node.args if isinstance(entry, ast.Constant)]
                names = [text for text in texts if isinstance(text, str)]
                if not names and module not in IMPORT_BY_NAME:
                    names = ["rsvib_torch"]
        found += [(node.lineno, resolved(name)) for name in names if name.split(".")[0] == "rsvib_torch"]
    return found


@cache
def resolved(name):
    """The module or package that a dotted name belongs to: ``rsvib_torch.imaging.blur`` for ``...blur.blur_rows``."""
    parts = name.split(".")
    while len(parts) > 1:
        path = PACKAGE.joinpath(*parts[1:])
        if path.with_suffix(".py").exists() or (path / "__init__.py").exists():
            break
        parts.pop()
    return ".".join(parts)


def wrong_imports(source, module):
    """Imports of a module from its own layer or from a higher one, as ``line: importing -> imported``."""
    here = module.split(".")[1:]
    wrong = []
    for line, name in imported_modules(source, module):
        there = name.split(".")[1:]
        if not there:  # a public name is imported from the whole package
            if here[0] != "commands":
                wrong.append(f"{line}: {module} -> the whole package")
        elif there[0] != here[0]:
            if layer_of(there[0], LAYERS) >= layer_of(here[0], LAYERS):
                wrong.append(f"{line}: {module} -> {name}")
        elif here[0] in INNER_LAYERS and len(here) > 1:
            layers = INNER_LAYERS[here[0]]
            if len(there) == 1 or (there[1] != here[1] and layer_of(there[1], layers) >= layer_of(here[1], layers)):
                wrong.append(f"{line}: {module} -> {name}")
    return wrong


def modules():
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.name != "__init__.py":
            yield path, ".".join(("rsvib_torch", *path.relative_to(PACKAGE).with_suffix("").parts))


@pytest.mark.parametrize(("path", "module"), [pytest.param(*both, id=both[1]) for both in modules()])
def test_imports_go_downwards(path, module):
    assert wrong_imports(path.read_text(encoding="utf-8"), module) == []


def test_modules_do_not_import_each_other_in_a_cycle():
    uses = {module: {name for _, name in imported_modules(path.read_text(), module)} for path, module in modules()}
    try:
        order = list(TopologicalSorter(uses).static_order())
    except CycleError as error:
        pytest.fail(f"modules import each other: {' -> '.join(error.args[1])}")
    assert len(order) >= len(uses)


def test_every_part_has_a_layer():
    def parts(folder):
        return {path.stem for path in folder.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}

    for part in parts(PACKAGE) - {"__init__"}:
        layer_of(part, LAYERS)
    for package, layers in INNER_LAYERS.items():
        assert parts(PACKAGE / package) - {"__init__"} == set().union(*layers)


def test_no_two_modules_and_no_two_groups_of_options_share_a_name():
    names = [path.stem for path, _ in modules()]
    groups = re.findall(r"^@options\nclass (\w+)", "\n".join(path.read_text() for path, _ in modules()), re.MULTILINE)
    assert len(groups) > 20
    for found in (names, groups):
        assert sorted(found) == sorted(set(found))


def test_modules_that_use_a_displacement_per_row_state_the_invariant():
    """Results on disk and commands only print displacements."""
    uses = re.compile(r"\.(mean_)?displacement\(|\bexposure_trajectory\(|\brows_showing\(")
    for path, module in modules():
        source = path.read_text(encoding="utf-8")
        if uses.search(source) and module.split(".")[1] not in {"motion", "report", "commands"}:
            assert "Invariant: the displacement depends on the row only" in source, module


@pytest.mark.parametrize(
    ("source", "module"),
    [
        ("from rsvib_torch.imaging import blur_rows", "rsvib_torch.motion.vibration"),
        ("from ..restoration import restore", "rsvib_torch.detection.result"),
        ("def late():\n    from rsvib_torch.evaluation import psnr", "rsvib_torch.restoration.restore"),
        ("if TYPE_CHECKING:\n    import rsvib_torch.registration", "rsvib_torch.imaging.simulate"),
        ("module = importlib.import_module(NAME)", "rsvib_torch.results.presentation"),
        ("from rsvib_torch.detection.rows import displacements", "rsvib_torch.detection.tones.fit"),
        ("from rsvib_torch.restoration.exact import restore_exact", "rsvib_torch.restoration.row_methods"),
    ],
)
def test_an_import_in_the_wrong_direction_is_found(source, module):
    line = source.count("\n", 0, max(source.find("rsvib_torch"), source.find("from .."), 0)) + 1
    wrong = wrong_imports(source, module)
    assert len(wrong) == 1
    assert wrong[0].startswith(f"{line}: ")
