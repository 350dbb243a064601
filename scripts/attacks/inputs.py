"""Commands and functions whose output is, contains or lies in one of their inputs, under another name or the same."""

import contextlib
import io
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import tifffile
from attacks.files import write_stack
from attacks.small_runs import Reference, completed_or_refused, content, fork, process
from attacks.trial import Trial
from small_stack import CAMERA

import rsvib_torch as rsv
from rsvib_torch.commands.main import run_command


def _write_originals(folder: Path, source: Path) -> None:
    """Inputs of all kinds."""
    folder.mkdir()
    counts = tifffile.imread(source)[:4]
    for name in ("frames.tif", "pngs", "frames.npy", "frames.h5", "frames.mkv"):
        write_stack(folder / name, counts)
    (folder / "camera.toml").write_text(CAMERA)
    times = "\n".join(f"{0.001 * index},0.1,0.2" for index in range(100))
    (folder / "motion.csv").write_text(f"time,x,y\n{times}\n")
    shutil.copy(source.with_name("vibrations.json"), folder / "vibrations.json")


def _aliases(original: Path, *, ending: str = "") -> dict[str, Path]:
    """Names of an output that are the original, or lie in it; tests/files/test_outputs.py has more of them."""
    if original.is_dir():
        return {"itself": original, "a file in it": original / "restored.tif", "a folder in it": original / "deep/out"}
    hard = original.with_name(f"hard{ending or original.suffix}")
    hard.unlink(missing_ok=True)
    os.link(original, hard)
    return {"itself": original, "a hard link": hard}


def _command(arguments: list[str]) -> None:
    """A command, whose one-line error is raised."""
    shown = io.StringIO()
    with contextlib.redirect_stderr(shown):
        code = run_command(arguments)
    if code == 2 and "Traceback" not in shown.getvalue():
        raise ValueError(shown.getvalue())
    if code != 0:
        raise AssertionError(shown.getvalue())


def _written(place: str, output: str) -> None:
    """``write_stack`` with the metadata of an input, onto it."""
    frames = rsv.read_stack(place, full_scale=4095)
    rsv.write_stack(output, frames, dtype="uint16", full_scale=4095, like=rsv.read_stack_info(place))


def _processed(place: Path, output: Path, manifest: Path | None) -> None:
    process(place, output, manifest=manifest, given=None, detection={"method": "bands"})


def _attempts(place: Path) -> Iterator[tuple[str, Callable[..., None], tuple[object, ...]]]:
    """All trials: title, function and arguments; hard links are made in ``place``."""
    config = ["--config", str(place / "camera.toml"), "--overwrite"]
    vibration = ["--vibration", str(place / "vibrations.json")]
    known = ["--motion", str(place / "motion.csv"), "--unit", "px", "--offset", "0"]

    def command(title: str, *arguments: object) -> tuple[str, Callable[..., None], tuple[object, ...]]:
        return title, _command, ([str(argument) for argument in arguments],)

    stacks = ("frames.tif", "pngs", "frames.npy", "frames.h5", "frames.mkv")
    for stack in stacks:
        source = place / stack
        for alias, output in _aliases(source).items():
            yield command(f"restore {stack}: {alias}", "restore", source, output, *config, *vibration)
            yield command(f"known {stack}: {alias}", "restore", source, output, *config, *known)
            yield f"process_stack {stack}: {alias}", _processed, (source, output, None)
            yield f"write_stack like {stack}: {alias}", _written, (str(source), str(output))
    folders = {"the input": place / "pngs", "a folder in it": place / "pngs" / "out", "the folder of it": place}
    for alias, out in folders.items():
        yield command(f"run pngs: {alias}", "run", place / "pngs", out, *config)
        yield command(f"detect pngs: {alias}", "detect", place / "pngs", "--out", out, *config)
        yield command(f"page of pngs: {alias}", "run", place / "pngs", out, "--report", *config)
    for stack in ("frames.tif", "frames.npy", "frames.mkv"):
        arguments = (place / stack, place, "--output", stack, *config)
        yield command(f"run {stack}: --output is the input", "run", *arguments)
    for stack in ("frames.tif", "pngs"):
        for alias, output in _aliases(place / stack, ending=".csv").items():
            yield command(f"motion: {alias}", "motion", place / stack, "--out", output, *config)
            light = ("--frequency", 100, "--out", output, config[2])
            yield command(f"calibrate: {alias}", "calibrate", place / stack, *light)
            camera = ("--row-time", "1e-4", "--exposure", "6e-4", "--frame-rate", 130, "--out", output, config[2])
            yield command(f"init: {alias}", "init", place / stack, *camera)
    for alias, output in _aliases(place / "camera.toml").items():
        yield command(f"motion: camera.toml, {alias}", "motion", place / "frames.tif", "--out", output, *config)
    for manifest in ("frames.tif", "restored.tif", "pngs/manifest.json"):
        source = place / ("pngs" if manifest.startswith("pngs") else "frames.tif")
        yield f"process_stack: manifest {manifest}", _processed, (source, place / "restored.tif", place / manifest)


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """All combinations, in an order that depends on nothing."""
    reference, place = Reference(folder / "reference"), folder / "inputs"
    code, message = fork(_write_originals, place, reference.source)
    assert code == 0, message
    for number, (title, function, arguments) in enumerate(_attempts(place)):
        if number >= count:
            return
        before = content(place)
        code, text = fork(function, *arguments)
        changed = sorted(set(before.items()) ^ set(content(place).items()))
        if changed:
            yield Trial(title, "lost", f"changed: {changed[0][0]}: {text}")
            return
        if code == 2 and not any(words in text for words in ("input", "same file", "inside the other")):
            yield Trial(title, "wrong", f"refused for another reason: {text}")
        else:
            yield completed_or_refused(title, code, text.strip(), "not refused")
