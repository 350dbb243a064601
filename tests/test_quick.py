"""The selection of quick tests stays valid: every file of an algorithm has some, and the list names existing tests."""

import ast

import pytest
from conftest import ALGORITHMS, SLOWER_TESTS, TESTS

FILES = [
    file for name in ALGORITHMS for file in [TESTS / name, *sorted((TESTS / name).glob("test_*.py"))] if file.suffix
]


def defined_tests(file):
    """Names of the tests of a file as in the list, with whether they are marked as slow."""
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            is_slow = any("mark.slow" in ast.unparse(decorator) for decorator in node.decorator_list)
            yield f"{file.relative_to(TESTS).as_posix()}::{node.name}", is_slow


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_every_file_of_an_algorithm_has_quick_tests(file):
    assert any(name not in SLOWER_TESTS and not is_slow for name, is_slow in defined_tests(file))


def test_the_list_names_existing_tests_once():
    assert set(SLOWER_TESTS) <= {name for file in FILES for name, _ in defined_tests(file)}
    assert len(set(SLOWER_TESTS)) == len(SLOWER_TESTS)
