"""Search for ROIs of slanted edges in the image of a chart."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from rsvib_torch.checks.arguments import check_fields, check_shapes, checks_arguments
from rsvib_torch.checks.arrays import ArrayLike, as_tensor
from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.evaluation.mtf.edge import (
    EdgeFit,
    Scatter,
    as_real,
    check_edge,
    fit_edge,
    linearised,
    straighten,
    uneven_patches,
)

_Length = Annotated[int, Field(ge=16)]
_Contrast = Annotated[float, Field(gt=0, le=1)]
_Side = Literal["left", "right", "top", "bottom"]


@dataclass(frozen=True)
class SlantedEdge:
    """A ROI with one slanted edge.

    Attributes:
        top: First row.
        left: First column.
        height: Rows.
        width: Columns.
        angle: Degrees from the nearest image axis, positive clockwise (as ``MtfCurve.angle``).
        near_vertical: Whether the nearest axis is the vertical one.
        bright_side: Which side of the edge is bright.
        contrast: Bright minus dark, in the image's grey values.
    """

    top: int
    left: int
    height: int
    width: int
    angle: float
    near_vertical: bool
    bright_side: _Side
    contrast: float

    def __post_init__(self) -> None:
        check_fields(self)

    @checks_arguments
    def crop(self, image: ArrayLike) -> Tensor:
        """The ROI (..., height, width) of an image of the same size, or of a stack of them."""
        pixels = as_tensor("image", image)
        check_shapes({"image": pixels}, {"image": "... H W"})
        return pixels[..., self.top : self.top + self.height, self.left : self.left + self.width]


@checks_arguments
def find_slanted_edges(
    image: ArrayLike, *, min_length: _Length = 32, max_length: _Length = 160, min_contrast: _Contrast = 0.1
) -> list[SlantedEdge]:
    """Find ROIs for ``slanted_edge_mtf``: straight edges, 2 ... 30 degrees off an axis, between even sides.

    Around each line segment in the image, the widest ROI is used that contains only the edge
    and even sides.

    Args:
        image: (H, W), tensor or NumPy array, linear in light; any scale.
        min_length: px, shortest edge.
        max_length: px of a longer edge that are used, from its middle.
        min_contrast: Smallest step, as a part of the range between the image's 1 and 99 % quantiles.

    Returns:
        The edges, those of the largest contrast times length first; no two of them overlap by more than half.

    Example:
        >>> from rsvib_torch.datasets import resolution_chart
        >>> edges = find_slanted_edges(resolution_chart(512, 512))
        >>> len(edges), {round(abs(edge.angle), 1) for edge in edges}
        (16, {5.0})
    """
    grey = as_real("image", image)
    if grey.ndim != 2 or not grey.numel() or not bool(torch.isfinite(grey).all()):
        raise ValueError(f"image must be one finite grey image (H, W), got shape {tuple(grey.shape)}")
    check_whole_number("max_length", max_length, at_least=min_length)
    values = grey.detach().to(torch.float64)
    low, high = (values.flatten().kthvalue(max(1, int(q * (values.numel() - 1)) + 1)).values for q in (0.01, 0.99))
    least = min_contrast * float(high - low)
    if least == 0.0:
        return []
    found = [
        _roi_around(turned, line, rows, turned is values, least)
        for turned in (values, values.mT)
        for line, rows in _lines(turned, float(low), float(high), min_length, max_length)
    ]
    edges = [edge for edge in found if edge is not None]
    edges.sort(key=lambda edge: -edge.contrast * (edge.height if edge.near_vertical else edge.width))
    kept: list[SlantedEdge] = []
    for edge in edges:
        if all(_overlap(edge, other) < 0.5 for other in kept):
            kept.append(edge)
    return kept


def _lines(
    values: Tensor, low: float, high: float, min_length: int, max_length: int
) -> list[tuple[tuple[float, float], range]]:
    """Near-vertical lines, ``column = a + b row``, along edges, with the rows that they span.

    The detector (von Gioi et al. 2010) has the image in 8 bits between ``low`` and ``high``.
    """
    ends = 5  # px that are removed at either end, because of corners
    counts = ((values - low) * (255 / (high - low))).round().clamp(0, 255).to(torch.uint8).cpu().numpy()
    segments = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE).detect(np.ascontiguousarray(counts))[0]
    lines = []
    for x, y, end_x, end_y in () if segments is None else segments.reshape(-1, 4).astype(float).tolist():
        if abs(end_y - y) < max(min_length - 2, 1):
            continue
        slope = (end_x - x) / (end_y - y)
        begin, end = math.ceil(min(y, end_y)) + ends, math.floor(max(y, end_y)) + 1 - ends
        surplus = max(end - begin - max_length, 0) // 2
        begin, end = begin + surplus, end - surplus
        if end - begin >= max(min_length - 2 * ends, 16) and 2.0 <= math.degrees(math.atan(abs(slope))) <= 30.0:
            lines.append(((x - slope * y, slope), range(begin, end)))
    return lines


def _roi_around(
    values: Tensor, line: tuple[float, float], rows: range, near_vertical: bool, least: float
) -> SlantedEdge | None:
    """The widest ROI around a line that contains only the edge and even sides; None if there is none."""
    ends = sorted(line[0] + line[1] * row for row in (rows[0], rows[-1]))
    for beside in (40, 32, 24, 16, 12, 8):  # px on either side
        begin, end = round(ends[0]) - beside, round(ends[1]) + beside + 1
        if begin < 0 or end > values.shape[1]:
            continue
        roi = values[rows.start : rows.stop, begin:end]
        if not _plain_sides(roi, (line[0] + line[1] * rows.start - begin, line[1]), least):
            continue
        height, width = roi.shape
        box = (rows.start, begin, height, width) if near_vertical else (begin, rows.start, width, height)
        scatter = straighten(roi if near_vertical else roi.T)
        if scatter.near_vertical != near_vertical:
            continue
        fit = fit_edge(scatter)
        if not _alone(fit, scatter, least):
            continue
        sides: tuple[_Side, _Side] = ("right", "left") if near_vertical else ("bottom", "top")
        side = sides[int(scatter.mirrored)]
        return SlantedEdge(*box, fit.angle(scatter), near_vertical, side, float(fit.contrast))
    return None


def _plain_sides(roi: Tensor, line: tuple[float, float], least: float) -> bool:
    """Fast check that both sides of a line, more than 5 px from it, are planes to 9 % of the contrast."""
    height, width = roi.shape
    y, x = (torch.arange(n, dtype=roi.dtype, device=roi.device) for n in (height, width))
    distance = x - line[0] - line[1] * y[:, None]
    levels, uneven = [], []
    for side in (distance < -5.0, distance > 5.0):
        at = side.nonzero().to(roi.dtype)
        design = torch.cat([torch.ones_like(at[:, :1]), at / max(height, width) - 0.5], dim=1)
        normal = design.T @ design
        normal.diagonal().add_(1e-9 * len(at))
        plane = torch.linalg.solve(normal, design.T @ roi[side])
        residual = roi[side] - design @ plane
        levels.append(float(roi[side].mean()))
        uneven.append(float(residual.square().mean().sqrt()))
    step = abs(levels[1] - levels[0])
    return step > 0.8 * least and max(uneven) < 0.09 * step


def _alone(fit: EdgeFit, scatter: Scatter, least: float) -> bool:
    """Whether the edge explains 98.5 % of the variance of its ROI, and the sides are even to 1 % of the contrast."""
    try:
        check_edge(fit, scatter)
    except ValueError:
        return False
    model, _, _ = linearised(fit, scatter)
    residual = scatter.value - model
    contrast = float(fit.contrast)
    explained = 1 - float(residual.var() / scatter.value.var())
    tilt = float(fit.sides[:, 1:].abs().max())
    patches, noise = uneven_patches(fit, scatter)
    uneven = float(patches.square().mean().sqrt())
    return contrast >= least and explained >= 0.985 and tilt < 0.5 * contrast and uneven < 0.01 * contrast + 1.5 * noise


def _overlap(first: SlantedEdge, second: SlantedEdge) -> float:
    """Common area of two ROIs of one direction, as a part of the smaller."""
    if first.near_vertical != second.near_vertical:
        return 0.0
    down = min(first.top + first.height, second.top + second.height) - max(first.top, second.top)
    right = min(first.left + first.width, second.left + second.width) - max(first.left, second.left)
    smaller = min(first.height * first.width, second.height * second.width)
    return max(down, 0) * max(right, 0) / smaller
