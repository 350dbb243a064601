"""Sentences of SECURITY.md that no attack of docs/reliability.md covers: files are read as data."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "rsvib_torch").rglob("*.py"))
EXECUTING = ("eval", "exec", "compile", "pickle", "marshal", "shelve", "subprocess", "system", "popen", "Popen")


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_executes_what_a_file_contains(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            names = [getattr(node, "module", None) or "", *(alias.name for alias in node.names)]
            assert not set(names) & set(EXECUTING), f"line {node.lineno}"
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            assert name not in EXECUTING, f"line {node.lineno}"
            if name in ("np.load", "torch.load"):
                options = {one.arg: ast.unparse(one.value) for one in node.keywords}
                assert "False" in options.get("allow_pickle", "") or "True" in options.get("weights_only", "")


def test_the_tests_that_are_named_exist():
    text = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    attacks = (ROOT / "scripts" / "reliability.py").read_text(encoding="utf-8")
    for path in re.findall(r"`(tests/[^`]+)`", text):
        assert (ROOT / path).is_file(), path
    for name in re.findall(r"attack `(\w+)`", text):
        assert f'"{name}": (' in attacks, name
