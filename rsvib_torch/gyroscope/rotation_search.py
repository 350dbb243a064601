"""Assignment of the axes of a gyroscope to those of a camera, and a first offset between their clocks.

The displacements of corners are compared with the rotations at many offsets of the clock, for each of the 24 rotations
of the axes and the 24 mirrored ones, which detect mirrored frames. Focal length, drift and zoom are fitted in closed
form.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.gyroscope.corner_tracks import CornerTracks
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates, orientation_matrix
from rsvib_torch.motion.camera import Camera, displacement_factors

MIN_FOCAL_LENGTH = 10.0  # px; the result is that of no motion, and refused
_MOST_OFFSETS = 20_000
_MOST_ROTATIONS = 1_500_000  # of offsets times corners; 2 s on one core


_ALL = tuple(
    "".join(letter if keep else letter.lower() for letter, keep in zip(letters, signs, strict=True))
    for letters in itertools.permutations("XYZ")
    for signs in itertools.product((True, False), repeat=3)
)
ORIENTATIONS = tuple(name for name in _ALL if torch.linalg.det(orientation_matrix(name)) > 0)


@dataclass(frozen=True)
class Start:
    """Start values of a fit."""

    orientation: str
    offset: float  # s
    focal_length: float  # px
    cost: float  # weighted sum of squares


def search_orientations(
    tracks: CornerTracks,
    information: Tensor,
    rates: AngularRates,
    row_time: float,
    limits: tuple[float, float],
    camera: Camera | None,
) -> tuple[list[Start], list[Start], str | None]:
    """Start values of every rotation of the axes, and at other offsets (local minima) of the best one; the best first.

    Also returns mirrored axes with less than half of the least sum of squares, None without. Corners with information
    matrices (M, 2, 2) in px^-2 are compared at offsets within ``limits`` in s.

    The focal length is that of the camera, or is fitted if there is none.
    """
    step = max(0.5 / rates.sample_rate, 4 * row_time, (limits[1] - limits[0]) / _MOST_OFFSETS)
    grid = limits[0] + step * torch.arange(max(2, math.ceil((limits[1] - limits[0]) / step) + 1), dtype=torch.float64)
    used = (information.diagonal(dim1=-2, dim2=-1).sum(-1) > 0).nonzero()[:, 0]
    used = used[:: max(1, len(used) * len(grid) // _MOST_ROTATIONS)]

    # 1. Whitened displacements by X, Y and theta, and by what is not known: the bias, in these components, and zoom.
    x, y = tracks.place[used].unbind(-1)
    factors = displacement_factors(x, y, 4) if camera is None else camera.factors(x, y, 4)
    # roots of a matrix and of its inverse differ by a rotation only; eigenvalues may be 0
    values, vectors = torch.linalg.eigh(information[used])
    white = values.clamp(min=0).sqrt()[..., None] * vectors.mT
    factors, white_offsets = white @ factors, (white @ tracks.offsets[used, :, None])[..., 0]
    times = tracks.times(row_time)[used]
    unknown = factors * torch.cat([times.diff().expand(-1, 3), torch.ones_like(x)[:, None]], -1)[:, None]
    factors = factors[..., :3]

    # 2. Products of the displacements and of the rotations, without the part that is not known.
    orthogonal = torch.linalg.qr(unknown.flatten(0, 1))[0].unflatten(0, (-1, 2))  # (M, 2, 4)
    along = torch.einsum("mic,mi->mc", factors, white_offsets)
    pairs = torch.einsum("mic,mid->mcd", factors, factors).flatten(1)
    hidden = torch.einsum("min,mic->mnc", orthogonal, factors).flatten(1)
    of_moved = torch.einsum("min,mi->n", orthogonal, white_offsets)
    energy = white_offsets.square().sum() - of_moved.square().sum()
    products, squares = [], []
    # integrals of the rates at equally spaced times, interpolated linearly: 20 times faster than the spline
    knots = np.arange(rates.start, rates.end + step, min(0.5 / rates.sample_rate, step))
    integrals = rates.rotation(
        torch.full((len(knots),), rates.start, dtype=torch.float64, device="cpu"), torch.from_numpy(knots)
    )

    def angles(at: Tensor) -> Tensor:
        return torch.from_numpy(np.stack([np.interp(at.numpy(), knots, axis) for axis in integrals.mT.numpy()], -1))

    for part in grid.split(256):
        turned = angles(part[:, None] + times[:, 1]) - angles(part[:, None] + times[:, 0])  # (offset, corner, axis)
        both = (turned[..., :, None] * turned[..., None, :]).flatten(2)
        shared = torch.einsum("mk,omj->okj", hidden, turned).unflatten(1, (4, 3))
        products.append(torch.einsum("mc,omj->ocj", along, turned) - torch.einsum("n,oncj->ocj", of_moved, shared))
        squares.append(
            torch.einsum("mk,oml->okl", pairs, both).unflatten(2, (3, 3)).unflatten(1, (3, 3))
            - torch.einsum("oncj,ondk->ocdjk", shared, shared)
        )
    product, square = torch.cat(products), torch.cat(squares)  # (offset, c, axis), (offset, c, c', axis, axis')

    # 3. The sum of squares of each orientation: X = -f yaw, Y = f pitch, theta = -roll.
    def cost_of(name: str) -> tuple[Tensor, Tensor]:
        turn = orientation_matrix(name)[[1, 0, 2]] * torch.tensor([[-1.0], [1.0], [-1.0]], dtype=torch.float64)
        p = torch.einsum("ocj,cj->oc", product, turn)
        q = torch.einsum("ocdjk,cj,dk->ocd", square, turn, turn)
        size = q[:, :2, :2].sum((1, 2)).clamp(min=1e-300)
        linear = p[:, :2].sum(-1) - q[:, :2, 2].sum(-1)
        f = (linear / size).clamp(min=MIN_FOCAL_LENGTH)
        f = f if camera is None else torch.full_like(f, camera.focal_length)
        return energy - 2 * f * linear + f.square() * size - 2 * p[:, 2] + q[:, 2, 2], f

    costs = {name: cost_of(name) for name in _ALL}

    def start_at(name: str, index: int) -> Start:
        cost, f = costs[name]
        return Start(name, float(grid[index]), float(f[index]), float(cost[index]))

    best = {name: start_at(name, int(cost.argmin())) for name, (cost, _) in costs.items()}
    starts = sorted((best[name] for name in ORIENTATIONS), key=lambda start: start.cost)
    mirrored = [name for name in _ALL if name not in ORIENTATIONS and best[name].cost < 0.5 * starts[0].cost]

    # 4. Other offsets of the best orientation.
    cost = torch.nn.functional.pad(costs[starts[0].orientation][0], (1, 1), value=math.inf)
    valleys = ((cost[1:-1] <= cost[:-2]) & (cost[1:-1] <= cost[2:])).nonzero()[:, 0].tolist()
    others = sorted((start_at(starts[0].orientation, index) for index in valleys), key=lambda start: start.cost)[1:]
    return starts, others, min(mirrored, key=lambda name: best[name].cost, default=None)
