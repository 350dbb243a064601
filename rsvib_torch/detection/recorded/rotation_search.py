"""Assignment of the axes of a gyroscope to those of a camera, and a first offset between their clocks.

The displacements of the row bands between frames give components (X, Y, theta) of every band. For each of the 24
rotations of the axes (and the 24 mirrored ones, to detect mirrored frames), and for many offsets of the clock, a focal
length and a drift of each component are fitted in closed form.

Invariant: the displacement depends on the row only (docs/architecture.md), in parts of the columns.
"""

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.detection.recorded.band_vectors import BandVectors
from rsvib_torch.motion.gyroscope_rates import AngularRates

MIN_FOCAL_LENGTH = 10.0  # px; the result is that of no motion, and refused


def orientation_matrix(name: str) -> Tensor:
    """(3, 3) matrix from rates about the axes of the gyroscope to those about the axes of the camera.

    Example:
        >>> orientation_matrix("YxZ").tolist()
        [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    matrix = torch.zeros(3, 3, dtype=torch.float64, device="cpu")
    for row, letter in enumerate(name):
        matrix[row, "xyz".index(letter.lower())] = 1.0 if letter.isupper() else -1.0
    return matrix


_ALL = tuple(
    "".join(letter if keep else letter.lower() for letter, keep in zip(letters, signs, strict=True))
    for letters in itertools.permutations("XYZ")
    for signs in itertools.product((True, False), repeat=3)
)
# rotations first, then mirrored assignments
ORIENTATIONS = tuple(name for name in _ALL if torch.linalg.det(orientation_matrix(name)) > 0)
MIRRORED = tuple(name for name in _ALL if name not in ORIENTATIONS)


@dataclass(frozen=True)
class OrientationSearch:
    """Least sums of squares of each orientation."""

    names: tuple[str, ...]  # orientations, best first
    costs: tuple[float, ...]  # their least weighted sums of squares
    offsets: tuple[float, ...]  # offset of the clock in s of each
    focal_lengths: tuple[float, ...]  # focal length in px of each
    # another local minimum of the best orientation below twice its least; None if there is none
    other_offset: float | None
    mirrored: str | None  # whether a mirrored orientation has a sum below half of the least


def search_orientations(
    vectors: BandVectors,
    weight: Tensor,
    rates: AngularRates,
    row_time: float,
    exposure_time: float,
    limits: tuple[float, float],
    focal_length: float | None,
) -> OrientationSearch:
    """Least sums of squares of the components of all bands, with weights (M,), over offsets within ``limits`` in s.

    The focal length in px may be unknown.
    """
    components, weights, first, last = _bands(vectors, weight, row_time, exposure_time)
    every = max(1, len(first) // 1500)  # 1500 bands are enough for a start
    components, weights, first, last = (values[::every] for values in (components, weights, first, last))
    duration = (last - first)[:, None]

    def without_drift(values: Tensor, own: Tensor) -> Tensor:  # (..., M, C), weights (M, C)
        slope = (own * duration * values).sum(-2, keepdim=True) / (own * duration**2).sum(0).clamp(min=1e-300)
        return values - slope * duration

    step = max(0.5 / rates.sample_rate, 4 * row_time, (limits[1] - limits[0]) / 20000)  # at most 20,000 offsets
    count = max(2, math.ceil((limits[1] - limits[0]) / step) + 1)
    grid = torch.linspace(*limits, count, dtype=torch.float64)
    moved = without_drift(components, weights)
    energy = (weights * moved.square()).sum(0)  # (3,)
    products, squares = [], []
    for part in grid.split(64):
        turned = rates.rotation(part[:, None] + first, part[:, None] + last)
        for axis in range(3):
            of_axis = weights[:, axis : axis + 1].expand(-1, 3)
            rest = without_drift(turned, of_axis)
            products.append((of_axis * moved[:, axis, None] * rest).sum(-2))
            squares.append((of_axis * rest.square()).sum(-2))
    # (offset, component, axis of the gyroscope)
    product, square = (
        torch.cat([torch.stack(values[at : at + 3], 1) for at in range(0, len(values), 3)])
        for values in (products, squares)
    )
    # X = -f yaw, Y = f pitch, R theta = -R roll
    axes = {name: orientation_matrix(name) for name in _ALL}
    costs, focal = {}, {}
    for name, matrix in axes.items():
        of_x, of_y, of_roll = -matrix[1], matrix[0], -matrix[2]
        along = product[:, 0] @ of_x + product[:, 1] @ of_y
        size = square[:, 0] @ of_x.square() + square[:, 1] @ of_y.square()
        f = (
            (along / size.clamp(min=1e-300)).clamp(min=MIN_FOCAL_LENGTH)
            if focal_length is None
            else torch.full_like(size, focal_length)
        )
        R = vectors.radius
        turned = R**2 * (square[:, 2] @ of_roll.square()) - 2 * R * (product[:, 2] @ of_roll)
        costs[name] = energy.sum() - 2 * f * along + f**2 * size + turned
        focal[name] = f
    best = {name: int(cost.argmin()) for name, cost in costs.items()}
    least = {name: float(costs[name][at]) for name, at in best.items()}
    names = sorted(ORIENTATIONS, key=least.__getitem__)
    cost = costs[names[0]]
    padded = torch.nn.functional.pad(cost, (1, 1), value=math.inf)
    valleys = (padded[1:-1] <= padded[:-2]) & (padded[1:-1] <= padded[2:]) & (cost < 2.0 * cost.amin() + 1e-300)
    valleys[best[names[0]]] = False
    others = valleys.nonzero()[:, 0]
    mirrored = min(MIRRORED, key=least.__getitem__)
    return OrientationSearch(
        names=tuple(names),
        costs=tuple(least[name] for name in names),
        offsets=tuple(float(grid[best[name]]) for name in names),
        focal_lengths=tuple(float(focal[name][best[name]]) for name in names),
        other_offset=float(grid[others[cost[others].argmin()]]) if len(others) else None,
        mirrored=mirrored if least[mirrored] < 0.5 * least[names[0]] else None,
    )


def _bands(
    vectors: BandVectors, weight: Tensor, row_time: float, exposure_time: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Components (N, 3) in px of the bands, their weights (N, 3), and mid-exposures (N,) in both frames."""
    bands, inverse = torch.unique(vectors.pair * vectors.num_rows + vectors.row, return_inverse=True)
    factors = vectors.factors()
    times = vectors.times(row_time) + 0.5 * exposure_time

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(len(bands), *values.shape[1:]).index_add(0, inverse, values)

    normal = total(weight[:, None, None] * factors.mT @ factors)
    right = total(weight[:, None] * (factors.mT @ vectors.offsets[..., None])[..., 0])
    mean = total(weight[:, None] * times) / total(weight).clamp(min=1e-300)[:, None]
    size = normal.diagonal(dim1=-2, dim2=-1)
    solvable = torch.linalg.eigvalsh(normal)[:, 0] > 1e-6 * size.amax(-1).clamp(min=1e-300)
    regular = torch.where(solvable[:, None, None], normal, torch.eye(3, dtype=normal.dtype))
    components = torch.linalg.solve(regular, right)
    inverse_variance = torch.linalg.inv(regular).diagonal(dim1=-2, dim2=-1).reciprocal()
    good = solvable & (total(weight) > 0)
    return components[good], inverse_variance[good], mean[good, 0], mean[good, 1]
