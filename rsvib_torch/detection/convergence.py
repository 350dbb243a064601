"""Convergence of the rounds of a refinement: steps of the motion, when they are small enough, and their acceleration.

A round measures the rows around a motion and fits a motion to the measurements. ``Step`` is the difference of the two
motions at the measured rows.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import itertools
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import ToneFit, residual_of
from rsvib_torch.detection.tones.selection import robust_fit
from rsvib_torch.motion.motion import Motion

__all__ = ["Acceleration", "Step", "is_converged"]

_KEPT = 4  # steps that are combined; more change results of long exposures by less than their standard deviations
# A step was inexact if the next round corrects more than this part of it. Without long exposures, 0.1 is corrected
_INEXACT = 0.3
_MAX_EXTRAPOLATION = 4.0  # steps


@dataclass(frozen=True, eq=False)
class Step:
    """A round of measuring and fitting, as relative displacements (B, N, G, A) of the rows in px.

    Attributes:
        fitted: Displacements by the fitted motion.
        change: ``fitted`` less the displacements by the motion that the frames were warped by.
    """

    fitted: Tensor
    change: Tensor

    @classmethod
    def between(cls, measurements: Measurements, warped_by: Motion, fitted: Motion) -> "Step":
        """Step from the motion that the frames were warped by to the fitted motion."""
        before, after = (
            measurements.relative(motion.mean_displacement(measurements.exposure_starts, measurements.exposure_time))
            for motion in (warped_by, fitted)
        )
        return cls(after, after - before)

    def ratio_to(self, previous: "Step") -> Tensor:
        """(B,) length of the step over the length of the previous one."""
        square, previous_square = (step.change.square().sum((1, 2, 3)) for step in (self, previous))
        return (square / previous_square.clamp(min=1e-30)).sqrt()

    def is_inexact_after(self, previous: "Step") -> Tensor:
        """(B,) bool, whether the previous step was too short or too long by more than 30 %: this one corrects it."""
        product = (self.change * previous.change).sum((1, 2, 3))
        return (product / previous.change.square().sum((1, 2, 3)).clamp(min=1e-30)).abs() > _INEXACT


def is_converged(previous: ToneFit, fit: ToneFit, ratio: Tensor | None) -> Tensor:
    """(B, A) bool, whether the next round is expected to change the tones of an axis by 8 % of their std.

    Without long exposures a step is a tenth of the previous one or shorter. Changes of up to half a standard deviation
    are therefore small enough, and up to three standard deviations if the measured ratio of two steps allows it.

    Args:
        previous: The fit of the previous round.
        fit: The fit of this round.
        ratio: (B,) length of the last step over that of the step before; None if unknown.
    """
    if previous.active.shape != fit.active.shape:
        return torch.zeros_like(fit.active[..., 0])
    deviation = fit.covariance.diagonal(dim1=-2, dim2=-1)
    deviation = deviation.unflatten(-1, (fit.coefficients.shape[1], -1)).clamp(min=0.0).sqrt()
    std = deviation[..., : 3 * fit.frequencies.shape[-1]].unflatten(-1, (-1, 3))  # of Re C, Im C and f
    change = (previous.about(fit.centre).coefficients - fit.coefficients).abs()
    max_change_std = change.new_full((), 0.5)
    if ratio is not None:
        max_change_std = (0.08 / ratio.clamp(min=1e-3)).clamp(0.5, 3.0)[:, None, None]
    small = (change <= max_change_std * std[..., :2].amax(-1)) & (
        (previous.frequencies - fit.frequencies).abs() <= max_change_std * std[..., 2]
    )
    converged: Tensor = (small | ~fit.active).all(-1)
    return converged


@dataclass(eq=False)
class Acceleration:
    """Extrapolation of rounds that overshoot or converge slowly (Anderson acceleration: J. ACM 12, 547, 1965).

    A wrong motion also blurs the warped frames wrongly. With long exposures, rows therefore measure up to twice their
    residual displacement, or half of it. The measurements are corrected by the combination of the last steps that would
    have left the least change.

    Attributes:
        steps: The last steps with the same tones.
    """

    steps: list[Step] = field(default_factory=list)

    def ratio(self, step: Step) -> Tensor | None:
        """(B,) length of a step over the length of the last one; None if there is none."""
        return step.ratio_to(self.steps[-1]) if self.steps else None

    def add(self, step: Step, *, same_tones: bool) -> None:
        """Keep a step; steps with other tones do not predict the next one."""
        self.steps = [*self.steps[1 - _KEPT :], step] if same_tones else [step]

    def clear(self) -> None:
        """Forget all steps."""
        self.steps = []

    def applied(self, measurements: Measurements, fit: ToneFit) -> ToneFit | None:
        """The fit to the corrected measurements of the last step; None if the last two steps need no correction."""
        if len(self.steps) < 2:
            return None
        where = self.steps[-1].is_inexact_after(self.steps[-2])
        if not bool(where.any()):
            return None
        corrected = replace(measurements, displacements=measurements.displacements - self._correction(where))
        residual = residual_of(corrected, fit)
        return robust_fit(corrected, fit.frequencies, fit.active, fit.model, residual, steps=1)[0]

    def _correction(self, where: Tensor) -> Tensor:
        """Displacements (B, N, G, A) in px to subtract, 0 in the stacks that ``where`` (B,) does not contain."""
        pairs = list(itertools.pairwise(self.steps))
        fitted = torch.stack([after.fitted - before.fitted for before, after in pairs], -1)
        # the combination of differences of changes that is nearest to the last change, (B, n, M) for M differences
        change = torch.stack([after.change - before.change for before, after in pairs], -1).flatten(1, -2)
        gram, right = change.mT @ change, change.mT @ self.steps[-1].change.flatten(1)[..., None]
        ridge = 1e-3 * gram.diagonal(dim1=-2, dim2=-1).mean(-1).clamp(min=1e-30)
        eye = torch.eye(len(pairs), dtype=torch.float32, device="cpu").to(gram)
        share = torch.linalg.solve(gram + ridge[:, None, None] * eye, right)[..., 0]
        share = share.clamp(-_MAX_EXTRAPOLATION, _MAX_EXTRAPOLATION) * where[:, None]
        correction: Tensor = (fitted * share[:, None, None, None]).sum(-1)
        return correction
