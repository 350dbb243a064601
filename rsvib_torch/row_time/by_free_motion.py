"""Row time from frames with a smooth motion of any shape.

A motion that is smooth over the blanking time continues from the end of one frame to the begin of the next. A spline
in time with as few knots as explain the displacements of the rows is fitted together with the row time: at a wrong row
time, the continuation fails and more knots are needed.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math

import numpy as np
from scipy import linalg

from rsvib_torch.detection.shapes.free import normal_bands
from rsvib_torch.execution.progress import steps
from rsvib_torch.numerics.splines import spline_taps
from rsvib_torch.numerics.tables import Array
from rsvib_torch.row_time.by_tones import MAX_CHI_SQUARE, Candidate, FramePlaces, RowTimeFit, refined

DEGREE = 7  # a simulated motion of 8 Hz bandwidth needs knots of 11 ms to its noise, and of 8 ms with degree 3
_GRID_FRAMES = 24  # frames whose minima over the grid of row times are refined with all frames
GRID_STEP = 0.02  # of the row time; minima of the residual are 0.1 wide or wider for motions that are accepted


def row_time_of_splines(
    places: FramePlaces, num_rows: int, low: float, high: float, directions: tuple[float, ...]
) -> tuple[RowTimeFit, float] | None:
    """Row time at which the fewest knots explain the displacements, and their distance in s; None if no motion does."""
    places = places.centred(num_rows)
    first_places, known = places.of_first_frames(_GRID_FRAMES), float(places.measurements.num_measurements.sum())
    count = max(1, math.ceil(math.log(high / low) / GRID_STEP))
    sizes = [low * (high / low) ** (i / count) for i in range(count + 1)]
    grid = sorted(direction * size for direction in directions for size in sizes)
    period, spacing = places.period, places.period
    blank = period - num_rows * high
    while spacing > max(0.7 * blank, 0.1 * period):
        advance, costs = steps(len(grid), "row times"), []
        for tried in grid:
            costs.append(_evaluated(first_places, tried, spacing)[0].chi_square)
            advance()
        minima = [i for i, cost in enumerate(costs) if cost <= min(costs[max(i - 1, 0) : i + 2])]
        lowest = sorted(minima, key=costs.__getitem__)[:6]
        found = sorted((_refined(places, grid[i], spacing, low, high) for i in lowest), key=lambda one: one.chi_square)
        # knots twice as close explain noise only
        closer = _refined(places, found[0].row_time, 0.5 * spacing, low, high)
        # numbers of coefficients of both axes
        coarse, fine = (2 * _grid(places, found[0].row_time, step)[1][2] for step in (spacing, 0.5 * spacing))
        noise, added = closer.chi_square / max(1.0, known - fine), fine - coarse
        if found[0].chi_square - closer.chi_square < noise * (added + 3.0 * math.sqrt(2.0 * added)):
            break
        spacing /= 2**0.25
    else:
        return None
    if spacing < 0.7 * (period - num_rows * abs(found[0].row_time)):
        return None
    # with knots that are a little closer, the errors of the spline are below the noise
    finer = spacing / 2**0.25
    best = _refined(places, found[0].row_time, finer, low, high)
    std = best.std * math.sqrt(noise)
    others = tuple(
        one
        for one in found[1:]
        if one.chi_square < found[0].chi_square + noise * MAX_CHI_SQUARE
        and abs(one.row_time - best.row_time) > 5 * (std + one.std * math.sqrt(noise))
    )
    return RowTimeFit(best.row_time, std, others), finer


def _grid(places: FramePlaces, row_time: float, spacing: float) -> tuple[Array, tuple[float, float, int]]:
    """Times (N, G) in s of the rows, and first knot, distance and number of knots about ``spacing`` apart."""
    times = places.times(row_time)[0]
    first, last = float(times.min()), float(times.max())
    cells = max(1, math.ceil((last - first) / spacing))
    return times, (first, (last - first) / cells, cells + DEGREE)


def _evaluated(places: FramePlaces, row_time: float, spacing: float) -> tuple[Candidate, float]:
    """Splines of both axes at a row time, and the Gauss-Newton step in s, with the coefficients fitted again."""
    # 1. The coefficients that each row depends on.
    measured = places.measurements
    times, grid = _grid(places, row_time, spacing)
    index, basis = spline_taps(times, *grid, degree=DEGREE)
    _, slope = spline_taps(times, *grid, degree=DEGREE, derivative=1)
    weights = measured.inverse_variances[0].T
    bands = normal_bands(index, basis, measured.visible[0], weights, grid[2])

    def fitted(values: Array, weight: Array, factor: Array) -> tuple[Array, Array]:
        """Derivatives (N, G) by the time of a spline that is fitted to values (N, G), and the residual."""
        right = np.bincount(index.ravel(), (basis * (weight * values)[..., None]).ravel(), grid[2])
        solution = linalg.cho_solve_banded((factor, True), right, check_finite=False)[index]
        return (slope * solution).sum(-1), values - measured.relative((basis * solution).sum(-1)[None])[0]

    cost, step, information = 0.0, 0.0, 0.0
    for axis, (weight, band) in enumerate(zip(weights[..., None], bands, strict=True)):
        # 2. The spline.
        band[0] += 1e-10 * band[0].mean() + 1e-300
        factor = linalg.cholesky_banded(band, lower=True, check_finite=False)
        velocity, residual = fitted(measured.displacements[0, ..., axis], weight, factor)
        # 3. The change of the displacements by the row time that no change of the coefficients cancels.
        by_row_time = measured.relative((velocity * places.rows[0])[None])[0]
        _, unexplained = fitted(by_row_time, weight, factor)
        cost += float((weight * np.square(residual)).sum())
        step += float((weight * unexplained * residual).sum())
        information += float((weight * np.square(unexplained)).sum())
    independent = float(np.squeeze(measured.independent))
    information = max(information * independent, 1e-300)
    return Candidate(row_time, information**-0.5, cost * independent), step * independent / information


def _refined(places: FramePlaces, row_time: float, spacing: float, low: float, high: float) -> Candidate:
    return refined(lambda tried: _evaluated(places, tried, spacing), row_time, low, high)
