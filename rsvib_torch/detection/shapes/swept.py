"""Tones that fade or change their frequency: one of them an axis, from all frames of a stack."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_whole_number
from rsvib_torch.core.precision import full_precision, outside_graphs
from rsvib_torch.core.splines import gauss_legendre
from rsvib_torch.detection.band_curve import measurements_of_curve
from rsvib_torch.detection.grey_frames import GreyFrames, grey_frames
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.rows.displacements import frame_groups, measure_groups, stack_spectra
from rsvib_torch.detection.shapes.free import start_curve
from rsvib_torch.detection.shapes.spline_fit import precision_of_axis
from rsvib_torch.frames.arrays import ArrayLike
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.registration import Registration, RegistrationOptions

__all__ = ["SweptTone", "detect_swept_tone"]

_DECAYS = (-4.0, 0.0, 4.0, 10.0, 20.0)  # e-folds in the record
_MOST_SWEEP = 1.5  # of the frequency in the middle, over the record
_STARTS = 6
_CHUNK = 32  # candidates tried together
_ROUNDS = 25
_SIGNIFICANT = 14.0  # of chi-square per parameter, as for tones that stay
_EXPLAINED, _FINEST = 0.15, 0.03  # of the motion, and px, that may be left
_NODES = 4  # in an exposure or band
_SAMPLES = 24  # of the motion in the shortest period
_NAMES = ("amplitude", "frequency", "decay", "chirp", "phase")


@dataclass(frozen=True, eq=False)
class SweptTone:
    """One tone an axis that fades and sweeps: ``A exp(-g t) sin(2 pi (f t + c t^2 / 2) + phi) + v t``.

    All values are those at the time origin, in image axes (x, y); an axis without a significant tone has amplitude 0.
    A batch of stacks leads all tensors.

    Attributes:
        amplitude: (..., 2) px A.
        frequency: (..., 2) Hz f.
        decay: (..., 2) 1/s g; negative where the tone grows.
        chirp: (..., 2) Hz/s c.
        phase: (..., 2) rad phi.
        image_motion: (..., 2) px/s v.
        std: Standard deviations of amplitude, frequency, decay, chirp and phase by name, (..., 2) each.
        motion: The motion, as ``restore`` and ``simulate_frames`` take it.
        unexplained: (..., 2) px, rms displacement of rows that it does not explain, beyond their noise.
        reliable: (..., 2) bool.
        reasons: Why not, for each axis; a tuple of those for a batch.
    """

    amplitude: Tensor
    frequency: Tensor
    decay: Tensor
    chirp: Tensor
    phase: Tensor
    image_motion: Tensor
    std: dict[str, Tensor]
    motion: FreeMotion
    unexplained: Tensor
    reliable: Tensor
    reasons: tuple[Any, ...]

    def __getitem__(self, index: int) -> "SweptTone":
        """The result of one stack out of a batch."""
        rest = {name: getattr(self, name)[index] for name in self.__dataclass_fields__ if name != "std"}
        return SweptTone(**rest, std={name: value[index] for name, value in self.std.items()})


@outside_graphs
@full_precision
@torch.no_grad()
def detect_swept_tone(
    frames: ArrayLike,
    timing: SensorTiming,
    *,
    registration: Registration = "ncc",
    iterations: int = 3,
    band_rows: int = 32,
    band_step: int = 16,
    search: int = 16,
    ignore: ArrayLike | None = None,
    full_scale: float | None = None,
) -> SweptTone:
    """Detect one tone an axis whose amplitude decays or grows and whose frequency changes steadily.

    Start values come from the offsets of row bands, over a grid of frequencies, sweeps and decays; then the fit is
    repeated on displacements measured around it on the images, row by row.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) of at least two frames, tensor or NumPy array. NaN
            marks pixels that were not measured.
        timing: The sensor.
        registration: ``"ncc"``, ``"phase"`` or ``"projection"``, for the start.
        iterations: Rounds of measuring and fitting.
        band_rows: Rows of a band of the start.
        band_step: Rows from one band to the next.
        search: Search range of the start in px around the whole-frame offset.
        ignore: Bool, broadcastable to (..., H, W) of the frames: True for pixels to leave out (dead, saturated).
        full_scale: Count that means 1.0, for integer frames.

    Raises:
        TypeError: If frames are not numbers.
        ValueError: If they cannot be registered, see ``detect_motion``, or an option is out of range.
    """
    check_whole_number("iterations", iterations, at_least=1)
    stacks = grey_frames(frames, timing, full_scale, ignore)
    bands = RegistrationOptions(registration, band_rows, band_step, search)
    found = [_detect(stacks.one(index), timing, bands, iterations) for index in range(len(stacks.images))]
    return _stacked(found, timing) if stacks.batched else found[0].tone


@dataclass(frozen=True, eq=False)
class _Found:
    """A result with the parameters, about the middle of the record, that it comes from."""

    tone: SweptTone
    fits: list[Tensor]
    record: tuple[float, float]


def _stacked(found: list[_Found], timing: SensorTiming) -> SweptTone:
    """Results of stacks as one of a batch, their motions sampled as finely as the fastest of them needs."""
    step = min(_step(one.fits, one.record, timing) for one in found)
    motions = [_in_image(_motion(one.fits, one.record, timing, step), timing) for one in found]
    tones = [one.tone for one in found]
    names = (*_NAMES, "image_motion", "unexplained", "reliable")
    return SweptTone(
        **{name: torch.stack([getattr(tone, name) for tone in tones]) for name in names},
        std={name: torch.stack([tone.std[name] for tone in tones]) for name in _NAMES},
        motion=FreeMotion.stacked(motions),
        reasons=tuple(tone.reasons for tone in tones),
    )


def _in_image(motion: FreeMotion, timing: SensorTiming) -> FreeMotion:
    """A batch of one motion in row order as a single one in image axes."""
    return motion[0].from_row_order(timing)


def _detect(stack: GreyFrames, timing: SensorTiming, bands: RegistrationOptions, iterations: int) -> _Found:
    """``detect_swept_tone`` of one stack."""
    rowwise, curve, record = start_curve(stack, timing, bands)
    measured = measurements_of_curve(curve, rowwise, bands.band_step)
    highest = 0.5 / (bands.band_rows * rowwise.row_time)
    fits = [_start(measured, axis, record, highest) for axis in range(2)]
    groups = frame_groups(stack_spectra(stack.images, stack.valid), rowwise, _motion(fits, record, rowwise))
    for _ in range(iterations):
        motion = _motion(fits, record, rowwise)
        measured, _ = measure_groups(groups, rowwise, motion)
        weighed = measured.reweighted(_left(measured, motion))
        fits = [_settle(weighed, axis, record, fit[None])[0][0] for axis, fit in enumerate(fits)]
    solved = [_settle(weighed, axis, record, fit[None]) for axis, fit in enumerate(fits)]
    covariances = [covariance[0] for _, covariance, _ in solved]
    fits = [torch.where(gain > _SIGNIFICANT, fit[0], _still(fit[0])) for fit, _, gain in solved]
    motion = _motion(fits, record, rowwise)
    left = _left(measured, motion)
    honest = weighed.independent_fraction(left) * measured.share_counted(left)
    tone = _report(fits, covariances, honest, motion, measured.unexplained(left)[0], measured, record, timing)
    return _Found(tone, fits, record)


def _still(fit: Tensor) -> Tensor:
    return fit * fit.new_tensor([0.0, 0.0, 1.0, 1.0, 1.0, 1.0])


def _waves(times: Tensor, fits: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine part at times S from the middle, of [a, b, f, g, c, v] (..., 6) broadcast against S."""
    envelope = torch.exp(-fits[..., 3] * times)
    angle = 2 * math.pi * (fits[..., 2] * times + 0.5 * fits[..., 4] * times.square())
    return envelope * angle.cos(), envelope * angle.sin()


def _value(times: Tensor, fits: Tensor) -> Tensor:
    cosine, sine = _waves(times, fits)
    return fits[..., 0] * cosine + fits[..., 1] * sine + fits[..., 5] * times


def _columns(times: Tensor, fits: Tensor) -> Tensor:
    """Derivatives (..., 6) of the displacement by the parameters (..., 6)."""
    cosine, sine = _waves(times, fits)
    tone, quarter = fits[..., 0] * cosine + fits[..., 1] * sine, fits[..., 1] * cosine - fits[..., 0] * sine
    turn = 2 * math.pi * times
    whole = torch.broadcast_tensors(cosine, sine, turn * quarter, -times * tone, 0.5 * turn * times * quarter, times)
    return torch.stack(whole, -1)


def _averaged(measured: Measurements, axis: int, middle: float) -> tuple[list[Tensor], list[float]]:
    """Times (N, G) from the middle of the record over which a measured displacement is a mean, and their weights."""
    duration = measured.exposure_time + measured.average_times[axis]
    nodes, weights = gauss_legendre(_NODES)
    first = measured.moments[0] + 0.5 * (measured.exposure_time - duration) - middle
    return [first + duration * node for node in nodes.tolist()], weights.tolist()


def _relative(measured: Measurements, values: Tensor) -> Tensor:
    """Values (N, G, P) less their mean over the frames that see the row."""
    return measured.relative(values[None])[0]


def _start(measured: Measurements, axis: int, record: tuple[float, float], highest: float) -> Tensor:
    """Parameters (6,) from a grid of frequencies, sweeps and decays, the best of a few settled ones."""
    middle, span = 0.5 * (record[0] + record[1]), record[1] - record[0]
    device = measured.moments.device
    grid = []
    for frequency in torch.arange(0.5 / span, highest, 0.5 / span).tolist():
        sweep = _MOST_SWEEP * frequency / span
        steps = max(1, round(sweep * span**2 / 2.0))
        grid += [
            (0.0, 0.0, frequency, decay / span, sweep * step / steps, 0.0)
            for step in range(-steps, steps + 1)
            for decay in _DECAYS
        ]
    fits = torch.tensor(grid, dtype=torch.float64, device=device)
    weight = precision_of_axis(measured.information[0], axis)
    values = (measured.displacements[0, ..., axis] * measured.seen[0])[..., None]
    times = measured.moments[0] + 0.5 * measured.exposure_time - middle
    drift = _relative(measured, times[..., None])[..., 0]
    gains = []
    for part in fits.split(_CHUNK):
        cosine, sine = _waves(times[..., None], part)
        columns = [_relative(measured, wave) for wave in (cosine, sine)] + [drift[..., None].expand_as(cosine)]
        design = torch.stack(columns, -1)  # (N, G, C, 3)
        gram = torch.einsum("ngcp,n,ngcq->cpq", design, weight, design)
        right = torch.einsum("ngcp,n,ng->cp", design, weight, values[..., 0])
        ridge = torch.diag_embed(1e-9 * gram.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300))
        gains.append((right * torch.linalg.solve(gram + ridge, right[..., None])[..., 0]).sum(-1))
    best = torch.cat(gains).argsort(descending=True)
    chosen: list[int] = []
    for place in best.tolist():
        if all(abs(grid[place][2] - grid[other][2]) > 0.6 / span for other in chosen):
            chosen.append(place)
        if len(chosen) == _STARTS:
            break
    settled, _, gained = _settle(measured, axis, record, fits[chosen])
    start: Tensor = settled[gained.argmax()]
    return start


def _settle(
    measured: Measurements, axis: int, record: tuple[float, float], fits: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Levenberg-Marquardt from several starts side by side.

    Args:
        measured: Displacements of one stack.
        axis: Which of theirs.
        record: Its first and last moment in seconds.
        fits: (S, 6) start parameters.

    Returns:
        Parameters (S, 6), their covariances (S, 6, 6), and chi-square (S,) that the tone gains per parameter.
    """
    middle = 0.5 * (record[0] + record[1])
    weight = precision_of_axis(measured.information[0], axis)
    values = measured.displacements[0, ..., axis] * measured.seen[0]
    times, shares = _averaged(measured, axis, middle)
    known = ((measured.differences[0] * (weight > 0)).sum() * measured.independent).clamp(min=7.0)
    row_weight = weight[:, None].expand_as(values)

    def averaged(function: Callable[[Tensor, Tensor], Tensor], at: Tensor) -> Tensor:
        """(S, N, G, P) relative means over exposures of what (N, G, S, P) a function makes of times and fits."""
        mean = torch.stack([share * function(time[..., None], at) for time, share in zip(times, shares, strict=True)])
        relative: Tensor = _relative(measured, mean.sum(0).flatten(2)).unflatten(-1, (len(at), -1))
        return relative.movedim(2, 0)

    def left_of(at: Tensor) -> Tensor:
        return values - averaged(lambda time, fit: _value(time, fit)[..., None], at)[..., 0]

    def cost_of(left: Tensor) -> Tensor:
        return (row_weight * left.square()).sum((1, 2))

    left = left_of(fits)
    cost, damping = cost_of(left), torch.full_like(fits[:, 0], 1e-3)
    settled = torch.zeros_like(cost, dtype=torch.bool)
    for _ in range(_ROUNDS):
        design = averaged(_columns, fits).flatten(1, 2)  # (S, N G, 6)
        weighted = (design * row_weight.flatten()[:, None]).mT
        gram, right = weighted @ design, weighted @ left.flatten(1)[..., None]
        size = torch.where(gram.diagonal(dim1=-2, dim2=-1) > 0, gram.diagonal(dim1=-2, dim2=-1), 1.0)
        tried = fits + torch.linalg.solve(gram + torch.diag_embed(damping[:, None] * size), right)[..., 0]
        further = left_of(tried)
        gained = cost - cost_of(further)
        better = (gained > 0) & ~settled
        settled = settled | (better & (gained < 1e-9 * (cost - gained))) | (~better & (damping > 1e7))
        fits = torch.where(better[:, None], tried, fits)
        left = torch.where(better[:, None, None], further, left)
        cost = torch.where(better, cost - gained, cost)
        damping = torch.where(better, (0.1 * damping).clamp(min=1e-12), 10 * damping)
        if bool(settled.all()):
            break
    without = left_of(_still(fits))
    drift = _relative(measured, times[0][..., None])[..., 0]
    norm = (row_weight * drift.square()).sum() + 1e-300
    alone = cost_of(without) - (row_weight * drift * without).sum((1, 2)).square() / norm
    noise = cost / known
    scale = size.sqrt()[..., None]
    inverse = torch.linalg.pinv(gram / scale / scale.mT, rtol=1e-12, hermitian=True) / scale / scale.mT
    return fits, noise[:, None, None] * inverse, (alone - cost) / (5 * noise + 1e-300)


def _step(fits: list[Tensor], record: tuple[float, float], timing: SensorTiming) -> float:
    """Time between the knots of a motion: fine enough for its fastest part."""
    span = record[1] - record[0]
    fastest = max(float(fit[2].abs() + 0.5 * fit[4].abs() * span) for fit in fits)
    return max(min(1 / (_SAMPLES * fastest + 1e-9), span / 64), timing.row_time)


def _motion(
    fits: list[Tensor], record: tuple[float, float], timing: SensorTiming, step: float | None = None
) -> FreeMotion:
    """Both axes as one motion, sampled finely, as a batch of one."""
    middle, span = 0.5 * (record[0] + record[1]), record[1] - record[0]
    step = _step(fits, record, timing) if step is None else step
    times = torch.linspace(*record, math.ceil(span / step) + 1, dtype=torch.float64, device=fits[0].device)
    return FreeMotion.through(times, torch.stack([_value(times - middle, fit) for fit in fits], -1)).expanded(1)


def _left(measured: Measurements, motion: FreeMotion) -> Tensor:
    predicted = motion[0].mean_displacement(measured.moments, measured.exposure_time)
    return measured.relative(measured.displacements - predicted)


def _at_origin(fit: Tensor, middle: float) -> Tensor:
    """[A, f, g, c, phi] at time 0 of parameters (6,) about the middle."""
    a, b, frequency, decay, chirp, _ = fit.unbind()
    phase = torch.atan2(a, b) - 2 * math.pi * (frequency * middle - 0.5 * chirp * middle**2)
    amplitude = torch.hypot(a, b) * torch.exp(decay * middle)
    return torch.stack([amplitude, frequency - chirp * middle, decay, chirp, phase])


def _report(
    fits: list[Tensor],
    covariances: list[Tensor],
    honest: float,
    motion: FreeMotion,
    unexplained: Tensor,
    measured: Measurements,
    record: tuple[float, float],
    timing: SensorTiming,
) -> SweptTone:
    """Parameters at the time origin and in image axes, with standard deviations and verdict."""
    middle = 0.5 * (record[0] + record[1])
    values, stds, reasons = [], [], []
    moved = measured.relative(motion[0].mean_displacement(measured.moments, measured.exposure_time))[0]
    size = moved.square().sum(1).div(measured.differences[0].clamp(min=1.0)[:, None]).mean(0).sqrt()
    for axis, (fit, covariance) in enumerate(zip(fits, covariances, strict=True)):
        present = bool(fit[:2].abs().sum() > 0)
        value = _at_origin(fit, middle)
        slope = torch.autograd.functional.jacobian(lambda p: _at_origin(p, middle), fit)
        std = (slope @ covariance @ slope.mT / honest).diagonal().clamp(min=0.0).sqrt()
        value[4] = torch.remainder(value[4] + math.pi, 2 * math.pi) - math.pi
        values.append(value if present else 0 * value)
        stds.append(std if present else 0 * std)
        found = [] if present else ["no tone stands out"]
        if float(unexplained[axis]) > max(_EXPLAINED * float(size[axis]), _FINEST):
            found.append(f"rows move by {float(unexplained[axis]):.3g} px that no swept tone explains")
        reasons.append(tuple(found))
    if timing.readout_direction == "reverse":
        values[1][4] = torch.remainder(values[1][4], 2 * math.pi) - (math.pi if values[1][0] > 0 else 0.0)
    drift = [fits[0][5], -fits[1][5] if timing.readout_direction == "reverse" else fits[1][5]]
    order = [1, 0] if timing.scan_axis == -1 else [0, 1]
    whole, spread = torch.stack(values)[order], torch.stack(stds)[order]
    reasons = [reasons[axis] for axis in order]
    named = dict(zip(_NAMES, whole.unbind(-1), strict=True))
    return SweptTone(
        **named,
        image_motion=torch.stack(drift)[order],
        std=dict(zip(_NAMES, spread.unbind(-1), strict=True)),
        motion=_in_image(motion, timing),
        unexplained=unexplained[order],
        reliable=torch.tensor([not found for found in reasons], device=unexplained.device),
        reasons=(reasons[0], reasons[1]),
    )
