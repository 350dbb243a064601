"""The path and the vibration of a camera over all frames of a video, from overlapping windows of frames."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration.corners import Corners, reduction
from rsvib_torch.tracking.window_checks import compared_readouts
from rsvib_torch.tracking.window_fit import ROUNDS, WindowPath, averaging, fit_window, robust_weights
from rsvib_torch.tracking.window_tones import Tone

WINDOW_FRAMES = 96  # of one fit; amplitudes and frequencies may change from window to window
# px, of the reduced frames. A window whose corners are left with more is fitted again in short windows, with tones that
# sweep; clips with parallax and compression have 0.05 to 0.17, a tone of 1.5 px that sweeps by 24 Hz/s leaves 0.8
_UNEXPLAINED = 0.3
_SHORT_FRAMES = 24  # of such a window
_SLOPES = 6.0 * np.arange(-6, 7)  # Hz/s, by which they may sweep; a difference of 3 Hz/s turns the ends by 1.5 rad


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The path and the vibration of a camera over all frames of a video; windows overlap by half."""

    windows: tuple[WindowPath, ...]
    allowed: float  # px, residual of a window that is explained

    def _weights(self, times: Array) -> Array:
        """(W, N) weights of the windows at times, which change linearly between the middles of neighbours."""
        centres = [window.origin for window in self.windows]
        return np.stack([np.interp(times, centres, unit) for unit in np.eye(len(centres))])

    def _mean(self, times: Array, values: Callable[[WindowPath], Array]) -> Array:
        """(N, 4) mean of values (N, 4) of the windows at times."""
        total = np.zeros((len(times), 4))
        for weight, window in zip(self._weights(times), self.windows, strict=True):
            if weight.any():
                total += weight[:, None] * values(window)
        return total

    def places(self, times: Array) -> Array:
        """(N, 4) components of the path at increasing times (N,) in s, 0 at the first."""
        steps = self._mean(0.5 * (times[1:] + times[:-1]), lambda window: np.diff(window.path(times), axis=0))
        return np.concatenate([np.zeros((1, 4)), np.cumsum(steps, 0)])

    def derivatives(self, times: Array, order: int) -> Array:
        """(N, 4) first or second derivative of the path, per s or s^2 of the stated readout of the rows."""
        return self._mean(times, lambda window: window.part**order * window.path(times, order))

    def tones(self, time: float) -> list[Tone]:
        """Tones that displace the rows, around a time in s, which is the origin of their phases."""
        weights = self._weights(np.array([time]))[:, 0]
        return [
            replace(at_time, frequency=window.part * at_time.frequency)
            for weight, window in zip(weights, self.windows, strict=True)
            if weight > 0 and window.part > 0
            for tone in window.tones
            for at_time in [tone.at(time - window.origin, time - window.origin, float(weight))]
        ]

    def nearest(self, time: float) -> WindowPath:
        """The window whose middle is nearest to a time in s."""
        return min(self.windows, key=lambda window: abs(window.origin - time))


def camera_path(
    pairs: Iterable[Corners | None], timing: SensorTiming, size: tuple[int, int], *, has_tones: bool = True
) -> CameraPath:
    """Path of a camera from the corners of all pairs of neighbouring frames (None where there are too few).

    A ``ValueError`` is raised if no window of frames has corners in a quarter of its pairs.
    """
    readout = timing.row_time * size[int(timing.scan_axis)]
    averaged = averaging(timing.exposure_time, timing.row_time, size)
    allowed, windows = _UNEXPLAINED * reduction(*size), list[WindowPath]()
    waiting: list[Corners | None] = []

    def fit() -> None:
        known = [pair for pair in waiting if pair is not None]
        if len(known) >= max(2, len(waiting) // 4):
            result = fit_window(Corners.joined(known), timing.frame_period, averaged, readout, has_tones)
            # waves without tones are not searched for again (a third of the time) where no readout explained a window
            is_tried = any(one.residual > allowed and one.other_readout is None for one in windows)
            limit = math.inf if is_tried else allowed
            window = compared_readouts(result, timing, size, limit) if has_tones else result.path()
            windows.extend(swept(window) or [window])

    def swept(window: WindowPath) -> list[WindowPath]:
        """Short windows with tones that sweep, from the windows before on, if they explain the corners."""
        short: list[WindowPath] = []
        # behind a tone that sweeps, three steady ones may explain the last frames as well
        continued = bool(windows) and any(tone.slope for tone in windows[-1].tones)
        if not has_tones or (window.residual < allowed and not continued):
            return short
        least = (1.2 if continued else 0.5) * window.residual
        if window.other_readout is not None:  # tones that sweep explain less than the other readout does
            least = min(least, window.other_readout[2])
        firsts = range(0, len(waiting) - _SHORT_FRAMES // 2, _SHORT_FRAMES // 2)
        for first in firsts:
            known = [pair for pair in waiting[first : first + _SHORT_FRAMES] if pair is not None]
            if len(known) < _SHORT_FRAMES // 2 or 2 * sum(one.residual >= least for one in short) > len(firsts):
                return []  # the median of all will not be less
            joined = Corners.joined(known)
            if not windows or joined.times.mean() > windows[-1].origin:
                short.append(fit_window(joined, timing.frame_period, averaged, readout, slopes=_SLOPES).path())
        return short if short and np.median([one.residual for one in short]) < least else []

    fitted = 0
    for pair in pairs:
        waiting.append(pair)
        if len(waiting) == WINDOW_FRAMES:
            fit()
            waiting, fitted = waiting[WINDOW_FRAMES // 2 :], WINDOW_FRAMES // 2
    if len(waiting) > fitted:
        fit()
    if not windows:
        raise ValueError(
            "no motion was found that the corners of the frames have in common: the frames show different scenes, or "
            "no detail"
        )
    return CameraPath(tuple(windows), allowed)


def shake(corners: Corners) -> tuple[Array, float]:
    """How a frame moves against the one before: (2,) px of its centre, and px rms of twelfths of its rows beside that.

    The motion of the frame is a displacement with roll and zoom; rows that move apart from it show a rolling shutter.
    """
    columns = corners.factors
    weight = corners.layer.astype(np.float64)
    for _ in range(ROUNDS):
        heavy = columns * weight[:, None, None]
        gram = np.einsum("nai,naj->ij", heavy, columns) + 1e-9 * np.eye(4)
        motion = np.linalg.solve(gram, np.einsum("nai,na->i", heavy, corners.offsets))
        residual = corners.offsets - columns @ motion
        length = np.hypot(*residual.T)
        weight = robust_weights(length, float(np.median(length)))
    part = np.where(corners.layer, (corners.rows * 12).astype(np.int64), -1)
    bands = [np.median(residual[part == number], 0) for number in range(12) if (part == number).sum() > 4]
    return motion[:2], float(np.sqrt(np.mean(np.square(bands)))) if bands else 0.0
