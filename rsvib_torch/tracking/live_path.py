"""The path of a camera whose frames come one by one, and the displacement of each frame in a steady image.

The path is the sum of the steps that the rows of neighbouring frames show, not of those that are predicted: where a
heel strikes, a prediction is wrong by several px, and a roll of the camera looks like an acceleration of the rows.
"""

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Self

import cv2
import numpy as np
import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.numerics.tables import Array
from rsvib_torch.tracking.window_fit import ROUNDS, robust_weights

_HEIGHT = 240  # px, to which frames are reduced to compare them as a whole
_LEAST_PEAK = 0.1  # of a phase correlation; that of frames without a scene in common is lower

_zeros = partial(np.zeros, 2)


@dataclass(frozen=True, eq=False)
class LivePath:
    """The path so far, and the displacement of the last frame in the steady image."""

    moved: Array = field(default_factory=_zeros)  # (2,) px to the last measured frame, in row order
    places: tuple[Array, ...] = ()  # (3,) time, x and y of the frames that the steady image follows
    shift: Array = field(default_factory=_zeros)  # (2,) px, of the last frame
    held: Array = field(default_factory=_zeros)  # (2,) px, part of it that is left from before the path was known

    def steadied(self, time: float, place: Array, step: float, duration: float) -> Self:
        """The path with the displacement of a frame at a ``time``, a ``step`` behind the frame before, in s.

        It leads from the place of the frame to a straight line through the last ``duration``. While the place is not
        known (NaN), and from where it is known again, the displacement of the frames before fades: nothing jumps.
        """
        fade = math.exp(-step / duration)
        if np.isnan(place).any():
            return replace(self, places=(), shift=fade * self.shift, held=fade * self.shift)
        places = tuple(one for one in (*self.places, np.append(time, place)) if one[0] >= time - duration)
        line = np.polyfit(np.array(places)[:, 0] - time, np.array(places)[:, 1:], min(len(places) - 1, 1))
        held = fade * self.held
        return replace(self, places=places, shift=place - line[-1] + held, held=held)


def step_of_rows(measurements: Measurements, displacements: Array, middle: float) -> Array:
    """(2,) px, how far the row in the middle of the frame moves between two frames, by a line through all rows.

    ``displacements`` (1, N, 2, 2) are measured, without tones; ``middle`` in s is the mean exposure of that row.
    """
    offsets = np.diff(displacements[0], axis=1)[:, 0]  # (N, 2)
    times = (measurements.exposure_starts[0].mean(-1) + 0.5 * measurements.exposure_time - middle)[:, None]
    known = measurements.visible[0].min(-1)[:, None] * measurements.information[0].diagonal(axis1=1, axis2=2)
    weights, step = known, np.zeros(2)
    for _ in range(ROUNDS):
        share = weights / np.maximum(weights.sum(0), 1e-30)
        time, offset = (share * times).sum(0), (share * offsets).sum(0)
        slope = (share * (times - time) * offsets).sum(0) / np.maximum((share * (times - time) ** 2).sum(0), 1e-30)
        step = offset - slope * time
        left = np.abs(offsets - step - slope * times)
        weights = known * robust_weights(left, np.median(left, 0))
    return step


def step_of_frames(first: Tensor, second: Tensor) -> Array | None:
    """(2,) px, how far the content of frames (1, 1, H, W) moves, within 1 px; None if they have nothing in common."""
    factor = max(1, round(first.shape[-2] / _HEIGHT))
    before, after = (torch.nn.functional.avg_pool2d(one, factor)[0, 0].float().cpu().numpy() for one in (first, second))
    step, peak = cv2.phaseCorrelate(before, after, cv2.createHanningWindow(before.shape[::-1], cv2.CV_32F))
    return factor * np.array(step) if peak > _LEAST_PEAK else None
