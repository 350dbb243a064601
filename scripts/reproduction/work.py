"""All trials of a reproduction, run in several processes."""

import multiprocessing
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from reproduction import claims
from reproduction.camera import Scene
from reproduction.paper import TARGETS, Target
from reproduction.targets import Edge, draw, edges_of, shake_of
from reproduction.trials import Images, clean_frames, run_trial, still_values

_SHUTTER_SIZE = (192, 256)


@dataclass(frozen=True)
class Plan:
    """Size and number of the trials.

    Attributes:
        size: (rows, columns) of the frames.
        seeds: Number of trials, each with random phases and noise.
        noises: Standard deviations, fractions of full scale; the first is used for the tables.
        edges: Number of slanted edges per axis.
        speeds: Image motions in px/s.
        processes: Number of processes at a time.
    """

    size: tuple[int, int]
    seeds: int
    noises: tuple[float, ...]
    edges: int
    speeds: tuple[float, ...]
    processes: int


@dataclass(eq=False)
class Found:
    """Results: trials of each target, the camera at rest, the claims, and images of the first trial."""

    trials: dict[Target, list[dict[str, Any]]] = field(default_factory=dict)
    still: dict[Target, list[dict[str, Any]]] = field(default_factory=dict)
    push_scan: list[dict[str, Any]] = field(default_factory=list)
    global_shutter: dict[str, Any] = field(default_factory=dict)
    images: dict[Target, Images] = field(default_factory=dict)
    scenes: dict[Target, Scene] = field(default_factory=dict)


_scene: Scene  # of the current tasks; inherited by the processes
_edges: list[Edge]
_plan: Plan


def _restoration_task(seed: int) -> tuple[int, list[dict[str, Any]], Images | None]:
    shake = shake_of(seed)
    clean = clean_frames(_scene, shake)
    done = [run_trial(_scene, shake, clean, noise, seed, _edges) for noise in _plan.noises]
    return seed, [images.values for images in done], done[0] if seed == 0 else None


def _push_scan_task(task: tuple[float, int]) -> dict[str, Any]:
    speed, seed = task
    return claims.push_scan_trial(_scene, speed, _plan.noises[0], seed)


def _start_process() -> None:
    torch.set_num_threads(1)


def _shared(function: Any, tasks: list[Any]) -> Iterator[Any]:
    """Results of tasks that run in separate processes, in the order of the tasks."""
    if _plan.processes == 1:
        yield from map(function, tasks)
        return
    with multiprocessing.get_context("fork").Pool(_plan.processes, _start_process) as pool:
        yield from pool.imap(function, tasks)


def run(plan: Plan, report: Any = print) -> Found:
    """Run all trials; ``report`` is called with messages of progress."""
    global _scene, _edges, _plan  # noqa: PLW0603  # scenes are too large to be sent to the processes
    _plan, found = plan, Found()
    for target, name in TARGETS.items():
        report(f"{name}: drawing the scene")
        _scene = found.scenes[target] = draw(target, plan.size)
        _edges = edges_of(_scene.still, plan.edges) if target == "chart" else []
        found.still[target] = [{"noise": noise, **still_values(_scene, noise, _edges)} for noise in plan.noises]
        found.trials[target] = []
        for seed, values, images in _shared(_restoration_task, list(range(plan.seeds))):
            report(f"{name}: trial {seed + 1} of {plan.seeds} done")
            found.trials[target] += values
            if images is not None:
                found.images[target] = images
    for speed in plan.speeds:
        if speed == 0:  # the trials of the tables
            still = [t for t in found.trials["landscape"] if t["noise"] == plan.noises[0]]
            found.push_scan += [{"speed": speed, "detection": t["detection"]} for t in still]
            continue
        report(f"push-scan: {speed:g} px/s")
        _scene = draw("landscape", plan.size, (speed, 0.0))
        found.push_scan += list(_shared(_push_scan_task, [(speed, seed) for seed in range(plan.seeds)]))
    report("global shutter")
    found.global_shutter = claims.global_shutter(draw("landscape", _SHUTTER_SIZE), seed=0)
    return found
