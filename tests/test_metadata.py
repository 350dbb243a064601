"""Metadata of the package: links of the long description, files of the wheel, versions of Python and dependencies."""

import re
import runpy
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import rsvib_torch as rsv

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
README = (ROOT / "README.md").read_text(encoding="utf-8")
LINK = re.compile(r"!?\[[^\]]+\]\(([^)\s]+)\)")
SETUP = runpy.run_path(str(ROOT / "setup.py"), run_name="setup")


def test_links_of_the_long_description_are_absolute():
    base = "https://host.example/owner/name/blob/main"
    targets = LINK.findall(SETUP["long_description"](README, base))
    assert len(targets) == len(LINK.findall(README)) > 20
    for target in targets:
        assert target.startswith(f"{base}/")
        assert (ROOT / target.removeprefix(f"{base}/").split("?")[0]).exists()
    assert f"{base}/docs/before_after.png?raw=true" in targets


def test_files_that_are_not_modules_are_package_data():
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["rsvib_torch"]
    package = Path(rsv.__file__).parent
    others = [path.relative_to(package) for path in package.rglob("*") if path.is_file()]
    others = [path for path in others if path.suffix not in (".py", ".pyc")]
    assert {"py.typed", "__init__.pyi", "readout_times.csv", "report.html"} <= {path.name for path in others}
    for path in others:
        assert any(fnmatch(str(path), pattern.replace("**/", "*")) for pattern in patterns), path


def test_tested_versions_of_python_are_stated():
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    tested = re.findall(r'"(3\.\d+)"', re.search(r"python: \[(.*)\]", workflow)[1])
    stated = [text.rsplit(" ", 1)[1] for text in PROJECT["project"]["classifiers"] if re.search(r":: 3\.\d+$", text)]
    assert stated == tested == ["3.11", "3.12", "3.13"]
    assert PROJECT["project"]["requires-python"] == ">=3.11"


def test_versions_agree():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {rsv.__version__}\n" in citation
    assert PROJECT["project"]["version"] == rsv.__version__


def test_every_dependency_has_a_lower_bound_below_the_tested_version():
    extras = PROJECT["project"]["optional-dependencies"]
    stated = [*PROJECT["project"]["dependencies"], *(line for extra in extras.values() for line in extra)]
    pins = dict(line.split("==") for line in (ROOT / "scripts" / "constraints.txt").read_text().split())
    pins = {name.lower().replace("_", "-"): version for name, version in pins.items()}
    for line in stated:
        if line.startswith("rsvib_torch["):
            continue
        name, bound = re.fullmatch(r"([\w-]+)(?:\[\w+\])?>=([\d.]+)", line).groups()
        lowest, tested = ([int(part) for part in re.findall(r"\d+", text)] for text in (bound, pins[name.lower()]))
        assert lowest <= tested, line
