"""Whether the corners of a window of frames contradict the stated readout of the rows, or the exposure.

A wave displaces the rows of a frame with one frequency, which the readout determines, and continues from frame to frame
with another one, which does not depend on the readout. With the right readout, the two agree up to a multiple of the
frame rate. With another one, the wave can seem to be a tone of another frequency, and the path of the camera, which
must fit as well, decides.
"""

import math
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration.corners import reduction
from rsvib_torch.tracking.window_fit import MIN_RATIO, ROUNDS, WindowFit, WindowPath

_WITHOUT_TONES = 0.5, 0.7, 1.4, 2.0  # parts of the time of a readout that are compared where there are no tones
_LEAST_PART = 0.4  # of those that tones propose; row times are guessed from the frame rate or a table
# By how much the square of what the path leaves is less if the stated readout is wrong. 55 clips in H.264, a phone, and
# a drone: at most 1.06 with the right row time, but for 1.20 and 1.33 where corners are few or not explained; 1.19 to 5
# with 16 wrong ones, 0.5 to 2 times the right one, which tones then propose within 0.5 %
_CONTRADICTED = 1.12
# Likewise by the path alone: with the right row time 1.24 of a zoom that vibrates and 1.16 of parallax, at most 1.01 in
# 16 other clips; 1.36 to 3.7 in nine of 18 clips with 0.5 to 1.4 times the right one, whose rows wobble by the hand
_BY_PATH = 1.3
# Of what the stated readout leaves, up to which another one explains the corners as well: 1.00 without a hand. Of 22
# clips of a hand with tones, 11 leave less at another readout (noise, strong compression, 60 and 120 frames per second)
# and 11 leave 1.03 and more
_AS_WELL = 1.02
# Of the frame rate, by which the frequency within a frame is changed to find that of a wave; an eighth changes what the
# wave explains by 1 to 2 %, a quarter by 7 %, a half by 25 %
_COARSE, _FINE = np.array([-0.25, 0.25]), np.arange(-4, 5) / 8
_SAME_PART = 0.005  # between parts, which turns a tone of five periods within a frame by 5 degrees at its ends
_HARMLESS = 0.05  # difference of a readout that leaves a twentieth of the displacement of the rows
_SAME_WAVE = 0.02  # periods per frame, between frequencies from frame to frame, from which windows separate them
_NODES = 8  # of the path within an exposure, which has up to one period of a tone


@dataclass(frozen=True)
class _Wave:
    """A wave of the rows of one axis."""

    axis: int  # 0: x, 1: y
    frequency: float  # Hz, from frame to frame, up to a multiple of the frame rate
    within: float  # Hz, within a frame by the stated readout

    def alias(self, part: float, interval: float) -> float:
        """Frequency in Hz of the tone that it is if the readout takes this part of the time."""
        return self.frequency + round((self.within / part - self.frequency) * interval) / interval

    def parts(self, interval: float, most: float) -> list[float]:
        """Parts of the time of a readout with which it is one tone, up to ``most``."""
        turns = np.arange(
            math.ceil((self.within / most - self.frequency) * interval),
            (self.within / _LEAST_PART - self.frequency) * interval,
        )
        return [float(self.within / alias) for alias in self.frequency + turns / interval if alias > 0]


def _strongest_wave(fit: WindowFit, axis: int, readout: float) -> _Wave | None:
    """The wave of an axis that explains most beside the path, if it is significant."""
    without_tones, (grid, _, is_visible), rate = copy(fit), fit.searched(readout), 1.0 / fit.interval
    without_tones.tones = []

    def best(searched: Array, mask: NDArray[np.bool_], parts: Array) -> list[tuple[float, float, float, float]]:
        """Sum of squares that a wave explains, its frequencies, and its ratio, for parts of the frame rate."""
        explained = []
        for part in parts:
            wave, ratio, offsets = without_tones.strongest(axis, searched, mask, turns=part * rate * readout)
            explained.append((offsets**2, wave, wave + part * rate, ratio))
        return explained

    # 1. Its frequency from frame to frame is that of the strongest tone, or of the strongest of all waves.
    tones = [tone for tone in fit.tones if tone.axis == axis]
    if tones:
        largest = max(tones, key=lambda tone: float(np.abs(tone.knots).mean()))
        frequency, part = largest.frequency, 0.0
    else:
        _, frequency, within, ratio = max(best(grid, is_visible, _COARSE))
        part = (within - frequency) / rate
        if ratio < MIN_RATIO:
            return None
    # 2. What it explains is a parabola over its frequency within a frame, around the highest value.
    near = frequency + (grid[1] - grid[0]) * np.arange(-3, 4)
    explained = best(near, np.ones(len(near), bool), part + _FINE)
    number = min(max(int(np.argmax([squares for squares, *_ in explained])), 1), len(explained) - 2)
    before, top, after = (squares for squares, *_ in explained[number - 1 : number + 2])
    shift = 0.5 * (after - before) / max(2.0 * top - after - before, 1e-30)
    step = (_FINE[1] - _FINE[0]) * rate
    return _Wave(axis, frequency, frequency + (part + _FINE[number]) * rate + step * float(np.clip(shift, -1.0, 1.0)))


def _waves(fit: WindowFit, readout: float, is_explained: bool) -> list[_Wave]:
    """The waves of the rows, one for tones that are aliases of each other; none without tones if all is explained."""
    if not fit.tones and is_explained:
        return []
    waves = [wave for axis in (0, 1) if (wave := _strongest_wave(fit, axis, readout)) is not None]
    for tone in fit.tones:
        differences = [(tone.frequency - wave.frequency) * fit.interval for wave in waves if wave.axis == tone.axis]
        if all(abs(turns - round(turns)) > _SAME_WAVE for turns in differences):
            waves.append(_Wave(tone.axis, tone.frequency, tone.frequency))
    return waves


@dataclass(frozen=True, eq=False)
class _Readouts:
    """Readouts of rows, or of columns, that take other times than the stated one."""

    fit: WindowFit  # with the stated time
    readout: float  # s, the stated time from the first to the last row
    waves: list[_Wave]

    def parts(self) -> list[float]:
        """Parts of the stated time with which each wave is one tone, but not the same one; -1: rows are in reverse."""
        interval = self.fit.interval
        most = max(interval / self.readout, 1.0)  # rows are not read in more time than there is between two frames
        proposed = sorted(part for wave in self.waves for part in wave.parts(interval, most))
        distinct = [
            part
            for before, part in pairwise((-1.0, *proposed))
            if part > (1.0 + _SAME_PART) * before
            and (
                abs(part - 1.0) > _HARMLESS
                or any(wave.alias(part, interval) != wave.alias(1.0, interval) for wave in self.waves)
            )
        ]
        return [-1.0, 0.0, 1.0, *(distinct if self.waves else _WITHOUT_TONES)]

    def with_part(self, part: float, rounds: int) -> WindowFit:
        """The fit if rows take a part of the stated time."""
        fit = self.fit
        delay = (1.0 - part) * self.readout * (fit.corners.rows - 0.5)
        refitted = WindowFit(replace(fit.corners, times=fit.corners.times - delay[:, None]), fit.interval, fit.averaged)
        if part > 0.0:
            refitted.add_tones(sorted({(wave.axis, wave.alias(part, fit.interval)) for wave in self.waves}))
        refitted.layer, refitted.weights = fit.layer, fit.weights
        refitted.solve(rounds)
        return refitted


def _by_columns(fit: WindowFit, readout: float, timing: SensorTiming, size: tuple[int, int]) -> WindowFit:
    """The path of the corners of frames (H, W) if columns are read one after another, in the time of all rows."""
    corners, axis = fit.corners, -1 - int(timing.scan_axis)
    ends = (corners.places[:, None] + np.array([[-0.5], [0.5]]) * corners.offsets[:, None]) / np.array(size[::-1])
    rows, columns = ends[..., axis] * (1 if timing.readout_direction == "forward" else -1), ends[..., 1 - axis]
    times = corners.times + readout * (columns - rows)
    path = WindowFit(replace(corners, rows=columns[:, 0] + 0.5, times=times), fit.interval, fit.averaged)
    path.layer, path.weights = fit.layer, fit.layer.astype(np.float64)
    path.solve(ROUNDS)
    return path


def compared_readouts(fit: WindowFit, timing: SensorTiming, size: tuple[int, int], allowed: float) -> WindowPath:
    """The path of a fit, or that with another readout which explains the corners, and ``WindowPath.other_readout``.

    The frames are of size (H, W); a fit that leaves more than ``allowed`` in px does not explain the corners.
    """

    def name(part: float) -> str:
        return {-1.0: "in reverse", 0.0: "all at once"}.get(part, f"in {part:.2f} times the time")

    def with_its_tones(part: float) -> str:
        tones = dict.fromkeys(f"{wave.alias(part, fit.interval):.4g}" for wave in rows.waves)
        return f"{name(part)}, with tones of {', '.join(tones)} Hz"

    # 1. Readouts of the rows, and of the columns, and the waves that they may explain.
    readout = timing.row_time * size[int(timing.scan_axis)]
    fits, is_explained = (fit, _by_columns(fit, readout, timing, size)), fit.path().residual < allowed
    rows, columns = (_Readouts(one, readout, _waves(one, readout, is_explained)) for one in fits)
    # 2. The best of them after one round, from the weights of the stated readout, must leave less in a robust fit. It
    # may do so by waves that have not been found as tones with the stated readout.
    unexplained = {(of, part): of.with_part(part, 1).unexplained for of in (rows, columns) for part in of.parts()}
    of, part = min(unexplained, key=lambda one: unexplained[one])
    best = of.with_part(part, ROUNDS)
    least = (_CONTRADICTED if of.waves else _BY_PATH) * best.unexplained
    if least > fit.unexplained or least > rows.with_part(1.0, ROUNDS).unexplained:
        most = _AS_WELL * fit.unexplained if fit.tones else 0.0
        agreeing = [part for (of, part), value in unexplained.items() if of is rows and 0 < part != 1 and value < most]
        of_agreeing = tuple(map(with_its_tones, sorted(agreeing, key=lambda one: abs(math.log(one)))))
        blur = blur_ratio(fit, timing, size) if fit.tones else (0.0, 0.0)
        return replace(fit.path(), blur=blur, agreeing=of_agreeing)
    # 3. Frames whose columns are read one after another are moved as a whole.
    most = _CONTRADICTED * unexplained[of, part]
    as_good = sorted((value, one) for (its, one), value in unexplained.items() if its is of is rows and value < most)
    names = " or ".join([*dict.fromkeys(name(one) for _, one in as_good)][:3]) or "column by column"
    other_readout = names, math.sqrt(fit.unexplained), math.sqrt(best.unexplained)
    return replace(best.path(), other_readout=other_readout, part=part if of is rows else 0.0)


def blur_ratio(fit: WindowFit, timing: SensorTiming, size: tuple[int, int]) -> tuple[float, float]:
    """Difference of the blur of corners between frames (H, W) over the expected one, and its standard deviation.

    As in ``detection.rows.displacements.blur_ratio``, an exposure blurs to second order by ``1 + M : grad grad / 2``
    with the second moments M of the path, and the ratio is that of the squares of true and stated exposure. What all
    corners of a pair have in common does not count, because it depends on the compression of the frames.
    """
    # 1. The path of each corner within both exposures, in px of the frames in which corners are followed.
    corners, times, scale = fit.corners, fit.times, reduction(*size)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    seconds, weights = 0.5 * timing.exposure_time * nodes, 0.5 * weights
    window, (index, values) = fit.path(), fit.envelope(times)
    velocity = np.stack([window.path(at, 1) for at in corners.times.T], 1) @ corners.factors.swapaxes(1, 2)
    path = velocity[:, :, None] * seconds[:, None]  # (N, 2, nodes, 2)
    for tone in fit.tones:
        amplitude = (values * tone.knots[index]).sum(-1)[..., None]
        path[..., tone.axis] += (amplitude * tone.waves(times[..., None] + seconds, ())).real
    path = (path - (weights @ path)[:, :, None]) / scale
    # 2. What blurs them: M; and the filter and the optics, which are those of the rows that the vibration stretches.
    # Both are compared in the mean of both frames, as the patches are.
    across = np.zeros(2)
    across[-1 - int(timing.scan_axis)] = timing.row_time * scale * (1 if timing.readout_direction == "forward" else -1)
    speed = (path[:, :, -1] - path[:, :, 0]) / (seconds[-1] - seconds[0])
    stretch = np.eye(2) - speed[..., None] * across
    to_mean = np.linalg.inv(stretch.mean(1))[:, None]
    root = np.sqrt(weights)[:, None] * path  # M = root^T root
    blurs = [to_mean @ root.swapaxes(-1, -2), to_mean @ stretch]
    of_both = np.stack([part @ part.swapaxes(-1, -2) for part in blurs], 1)
    changes = (of_both[:, :, 1] - of_both[:, :, 0]).reshape(-1, 2, 4)[..., [0, 1, 3]]
    # 3. Least squares for the ratio and the size of the filter, and for what the corners of each pair have in common.
    columns = np.concatenate([changes, np.broadcast_to(np.eye(3), (len(times), 3, 3))], 1)
    heavy = fit.weights[:, None, None] * columns @ corners.blur[:, :3]
    starts = [part.start for part, _, _ in fit.pairs]
    normal = np.add.reduceat(heavy[..., :3] @ columns.swapaxes(1, 2), starts)
    right = np.add.reduceat(heavy[..., 3:], starts)
    inner = normal[:, 2:, 2:] + 1e-9 * (np.trace(normal[:, 2:, 2:], axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(3)
    full = np.concatenate([normal[:, :2, :2], right[:, :2]], 2)
    of_pairs = full - normal[:, :2, 2:] @ np.linalg.solve(inner, np.concatenate([normal[:, 2:, :2], right[:, 2:]], 2))
    total = of_pairs.sum(0)
    inverse = np.linalg.pinv(total[:, :2])
    solution = inverse @ total[:, 2]
    # 4. The standard deviation by the scatter of the pairs.
    scores = (of_pairs[..., 2] - of_pairs[..., :2] @ solution) @ inverse[0]
    return float(solution[0]), float(np.sqrt(np.square(scores).sum()))
