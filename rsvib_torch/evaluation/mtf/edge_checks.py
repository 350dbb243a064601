"""What cannot be measured is refused, with the value found and what was expected."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.evaluation.mtf.edge_geometry import EdgeFit, Scatter, fit_edge, linearised
from rsvib_torch.frames.arrays import as_tensor

__all__ = ["as_real", "check_edge", "check_roi", "uneven_patches"]

_SMALLEST = 16  # px
_ANGLES = (2.0, 40.0)  # degrees
_EXPLAINED = 0.5  # of the variance, by one straight edge
_ROOM = (4.0, 3.0)  # px, and standard deviations of the line spread function, beside the edge
PATCH = 5  # px, of the sides that are looked at together
_COMPANY = 0.1  # of the contrast, that a patch of a side may differ from a plane
_CLIPPED_SHARE = 0.1  # of the pixels of a side at one value
_NOISY = 1e-3  # of the contrast
_BETTER = 0.6  # parts of the misfit that remain where clipping explains it
_OVERSHOOT = 0.05  # of the contrast: how far a clipped side would have gone on


def as_real(name: str, value: object) -> Tensor:
    """Return a tensor or array of real numbers as a tensor."""
    values = as_tensor(name, value)
    if values.dtype == torch.bool or values.dtype.is_complex:
        raise TypeError(f"{name} must hold real numbers, got {values.dtype}")
    return values


def check_roi(roi: Tensor) -> Tensor:
    """Return a ROI in float64 after looking at its shape and values."""
    if roi.ndim != 2:
        raise ValueError(f"roi must be one grey image (h, w), got shape {tuple(roi.shape)}")
    if min(roi.shape) < _SMALLEST:
        raise ValueError(f"roi must be at least {_SMALLEST} x {_SMALLEST} px, got {roi.shape[0]} x {roi.shape[1]}")
    values = roi.detach().to(torch.float64)
    broken = int((~torch.isfinite(values)).sum())
    if broken:
        raise ValueError(f"roi must be finite, got {broken} pixels that are NaN or infinite")
    if float(values.max() - values.min()) <= 1e-9 * float(values.abs().max()):
        raise ValueError(f"roi shows no edge: all pixels are {float(values[0, 0]):g}")
    return values


def check_edge(fit: EdgeFit, scatter: Scatter, columns: int, limits: tuple[float, float]) -> float:
    """Refuse what is no measurable slanted edge; return the px beside the edge that the ROI leaves.

    Args:
        fit: Of the edge.
        scatter: The pixels.
        columns: Of the turned ROI.
        limits: Lowest and highest value that a pixel can have.
    """
    model, _, distance = linearised(fit, scatter)
    residual = scatter.value - model
    explained = 1 - float(residual.var() / scatter.value.var())
    if not explained >= _EXPLAINED or not float(fit.contrast) > 0:
        raise ValueError(
            f"roi shows no edge: a straight edge explains {100 * max(explained, 0.0):.0f} % of the variance, "
            f"expected at least {100 * _EXPLAINED:.0f} %"
        )
    slope = abs(float(fit.slope(scatter)))
    angle = math.degrees(math.atan(slope))
    if not _ANGLES[0] <= angle <= _ANGLES[1]:
        problem = "hardly slanted" if angle < _ANGLES[0] else "too near to 45 degrees"
        raise ValueError(
            f"the edge is {problem}: {angle:.2f} degrees from the nearest image axis, expected "
            f"{_ANGLES[0]:g} ... {_ANGLES[1]:g}"
        )
    rows = len(scatter.value) // columns
    if slope * rows < 1:
        raise ValueError(
            f"the edge crosses {slope * rows:.2f} px over {rows} px of length, expected at least 1: "
            "take a longer roi or a steeper angle"
        )
    rays = distance.view(rows, columns)
    room = float(torch.minimum(-rays[:, 0].max(), rays[:, -1].min()))
    wanted = max(_ROOM[0], _ROOM[1] * float(fit.width))
    if room < wanted:
        raise ValueError(
            f"the edge comes within {max(room, 0.0):.1f} px of the border of the roi, expected at least {wanted:.1f} px"
        )
    _refuse_clipped(fit, scatter, distance, limits)
    patches, noise = uneven_patches(fit, scatter, columns)
    worst, contrast = float(patches.max()), float(fit.contrast)
    if worst > _COMPANY * contrast + 6 * noise:
        row, column = divmod(int(patches.argmax()), patches.shape[1])
        raise ValueError(
            f"roi shows more than one edge: {100 * worst / contrast:.0f} % of its contrast near "
            f"{row + PATCH // 2} px along and {column + PATCH // 2} px across the edge, expected even sides"
        )
    return room


def uneven_patches(fit: EdgeFit, scatter: Scatter, columns: int) -> tuple[Tensor, float]:
    """Means over small patches of what the fit leaves of the sides, without sign, and what noise makes of them."""
    model, _, distance = linearised(fit, scatter)
    beside = distance.abs() > 4 * fit.width + 2
    left = torch.where(beside, scatter.value - model, 0.0).view(-1, columns)
    patches = torch.nn.functional.avg_pool2d(left[None, None], PATCH, stride=1)[0, 0].abs()
    steps = (scatter.value - model).view(-1, columns).diff(dim=1).abs()
    # 0.954: median of the difference of two normal numbers, without sign
    return patches, float(steps.median()) / 0.954 / PATCH


def _refuse_clipped(fit: EdgeFit, scatter: Scatter, distance: Tensor, limits: tuple[float, float]) -> None:
    """Refuse sides that stop at one value where noise, or the rise of the edge, says that they would go on."""
    far = distance.abs() > 4 * fit.width
    sides = [scatter.value[(distance < 0) & far], scatter.value[(distance > 0) & far]]
    if min(len(side) for side in sides) == 0:
        return
    extremes = [float(scatter.value.min()), float(scatter.value.max())]
    shares = [float((side == value).double().mean()) for side, value in zip(sides, extremes, strict=True)]
    for index, name in enumerate(("dark", "bright")):
        value, share, other = extremes[index], shares[index], sides[1 - index]
        if share < _CLIPPED_SHARE:
            continue
        # black without light has no noise either: that one side is flat says something of the bright side only
        at_limit = value <= limits[0] if index == 0 else value >= limits[1]
        lone = shares[1 - index] < 0.1 * share and float(other.std()) > _NOISY * float(fit.contrast)
        clipped = lone and (index == 1 or not at_limit)
        if at_limit and not clipped:
            noisy = float((sides[index] - value).square().mean().sqrt()) > _NOISY * float(fit.contrast)
            clipped = noisy or _goes_on(fit, scatter, index, extremes)
        if clipped:
            raise ValueError(
                f"the {name} side of the edge is clipped: {100 * share:.0f} % of its pixels are exactly {value:g}"
            )


def _goes_on(fit: EdgeFit, scatter: Scatter, side: int, extremes: list[float]) -> bool:
    """Whether the other pixels say that the side would have gone on beyond the value that it stops at."""
    free = (scatter.value != extremes[0]) & (scatter.value != extremes[1])
    inner = Scatter(scatter.value[free], scatter.x[free], scatter.y[free], scatter.half)
    # a wider start: what was clipped looks sharper than it is
    wider = fit_edge(inner, replace(fit, sigma=fit.sigma + 0.5 * fit.width))
    level = float(wider.sides[side, 0])
    beyond = extremes[0] - level if side == 0 else level - extremes[1]
    near = (linearised(fit, inner)[2].abs() < 2 * fit.width).to(inner.value.dtype)
    misfit, misfit_wider = (float(near @ (inner.value - linearised(f, inner)[0]).square()) for f in (fit, wider))
    return beyond > _OVERSHOOT * float(fit.contrast) and misfit_wider < _BETTER * misfit
