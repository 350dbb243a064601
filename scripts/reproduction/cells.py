"""Cells of Tables 2, 3 and 4: values of the paper, of its methods and of the default methods."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from reproduction.paper import AXES, AXIS_NAMES, DETECTED, RESTORED, TARGETS, Target
from reproduction.trials import METHODS, RESTORED_BY

TABLES: dict[Target, str] = {"chart": "Table 2", "landscape": "Table 3"}
FRAMES = ("frame p", "frame p + 1")
NAMES = {"paper": "the paper's methods", "default": "default methods", "joint": "both frames jointly"}
_METRICS = {
    "psnr": ("PSNR", "dB", 2),
    "ssim": ("SSIM", "", 4),
    "mtf_x": ("MTF at Nyquist, horizontal", "", 4),
    "mtf_y": ("MTF at Nyquist, vertical", "", 4),
}
Trials = Sequence[dict[str, Any]]


@dataclass(frozen=True)
class Spread:
    """Mean and worst of the trials."""

    mean: float
    worst: float


@dataclass(frozen=True)
class Cell:
    """A value of the paper and the reproduced values.

    Attributes:
        table: Table of the paper.
        target: Scene.
        row: Quantity.
        column: Frame or axis.
        unit: Unit, or an empty text.
        digits: Decimals.
        paper: The paper's value.
        ours: Mean and worst value of the methods ``"paper"`` and ``"default"``, and of ``"joint"`` restoration.
        higher_is_better: False for errors.
        still: Value of a camera at rest with the same noise, where applicable.
    """

    table: str
    target: Target
    row: str
    column: str
    unit: str
    digits: int
    paper: float
    ours: dict[str, Spread]
    higher_is_better: bool
    still: float | None = None

    def better(self, method: str, which: str = "worst") -> bool:
        """Whether a method is better than the paper in the worst trial or on average."""
        value = getattr(self.ours[method if method in self.ours else "default"], which)
        return bool(value > self.paper if self.higher_is_better else value < self.paper)


def at_noise(trials: Trials, noise: float) -> list[dict[str, Any]]:
    """The trials with this noise."""
    return [trial for trial in trials if trial["noise"] == noise]


def spread(values: Sequence[float], *, higher_is_better: bool) -> Spread:
    """Mean and worst; NaN if a value is missing."""
    array = np.asarray(values, dtype=float)
    return Spread(float(array.mean()), float(array.min() if higher_is_better else array.max()))


def detection_cells(target: Target, trials: Trials) -> list[Cell]:
    """Relative errors of Table 2 or 3."""
    cells = []
    for axis in AXES:
        for quantity in ("period", "amplitude"):
            ours = {
                method: spread(
                    [abs(t["detection"][method][axis][f"{quantity}_error"]) for t in trials], higher_is_better=False
                )
                for method in METHODS
            }
            paper = getattr(DETECTED[target][axis], f"{quantity}_error")
            where = AXIS_NAMES[axis]
            cells.append(Cell(TABLES[target], target, f"error of the {quantity}", where, "%", 4, paper, ours, False))
    return cells


def metric(quality: dict[str, Any], name: str, frame: int) -> float:
    """PSNR, SSIM or the MTF at Nyquist (straight line) of a frame."""
    if name.startswith("mtf"):
        return float(quality["mtf"][frame][name[-1]]["straight"]["nyquist"])
    return float(quality[name][frame])


def restoration_cells(target: Target, trials: Trials, still: dict[str, Any]) -> list[Cell]:
    """Restored values and improvements of Table 4."""
    cells = []
    for name, printed in RESTORED[target].items():
        label, unit, digits = _METRICS[name]
        for frame, column in enumerate(FRAMES):
            before = [metric(trial["degraded"], name, frame) for trial in trials]
            after = {m: [metric(trial["restoration"][m], name, frame) for trial in trials] for m in RESTORED_BY}
            values = {m: spread(found, higher_is_better=True) for m, found in after.items()}
            gains = {
                m: spread([100 * (a / b - 1) for a, b in zip(found, before, strict=True)], higher_is_better=True)
                for m, found in after.items()
            }
            reached = metric(still, name, 0)
            possible = float(np.mean([100 * (reached / b - 1) for b in before]))
            head = ("Table 4", target)
            cells += [
                Cell(*head, f"{label}, restored", column, unit, digits, printed.restored[frame], values, True, reached),
                Cell(*head, f"{label}, improvement", column, "%", 1, printed.improvement[frame], gains, True, possible),
            ]
    return cells


def all_cells(trials: dict[Target, Trials], still: dict[Target, Trials], noise: float) -> list[Cell]:
    """Every cell of the three tables at a noise."""
    cells: list[Cell] = []
    for target in TARGETS:
        cells += detection_cells(target, at_noise(trials[target], noise))
    for target in TARGETS:
        cells += restoration_cells(target, at_noise(trials[target], noise), at_noise(still[target], noise)[0])
    return cells


def mtf_against_still(trials: Trials, still: dict[str, Any], method: str, axis: str, kind: str) -> np.ndarray:
    """MTF of restored frames over that of the camera at rest, (trials and frames, F)."""
    if kind not in still["mtf"][0][axis]:
        return np.empty((0, 0))
    reference = np.array(still["mtf"][0][axis][kind]["curve"])
    return np.array(
        [
            np.array(frame[axis][kind]["curve"]) / reference
            for trial in trials
            for frame in trial["restoration"][method]["mtf"]
            if kind in frame[axis]
        ]
    )


def collected(trials: Trials, value: Callable[[dict[str, Any]], float]) -> np.ndarray:
    """One value of each trial."""
    return np.array([value(trial) for trial in trials])
