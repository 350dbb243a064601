"""Convergence of the rounds of a refinement: steps of the motion, when they are small enough, and their acceleration.

A round measures the rows around a motion and fits a motion to the measurements. ``Step`` is the difference of the two
motions at the measured rows.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import itertools
from dataclasses import dataclass, field, replace

import numpy as np

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import ToneFit, model_displacements, residual_of
from rsvib_torch.detection.tones.selection import robust_fit
from rsvib_torch.numerics.tables import Array, split_axis

_NUM_STEPS = 4  # steps that are combined; more change results of long exposures by less than their standard deviations
_MAX_EXTRAPOLATION = 4.0  # steps
_SMALL_CHANGE = 0.5  # standard deviations


@dataclass(frozen=True, eq=False)
class Step:
    """A round of measuring and fitting, as relative displacements (B, N, G, A) of the rows in px."""

    fitted: Array  # displacements by the fitted motion
    change: Array  # ``fitted`` less the displacements by the motion that the frames were warped by

    @classmethod
    def between(cls, measurements: Measurements, warped_by: ToneFit, fitted: ToneFit) -> "Step":
        """Step from the motion that the frames were warped by to the fitted motion."""
        before, after = (model_displacements(measurements, fit) for fit in (warped_by, fitted))
        return cls(after, after - before)


def is_converged(previous: ToneFit, fit: ToneFit) -> Array:
    """(B, A) bool, whether the last round changed the tones of an axis so little that the next one need not be made.

    Without long exposures a step is a tenth of the previous one or shorter. Changes of up to half a standard deviation
    are therefore small enough.
    """
    if previous.active.shape != fit.active.shape:
        return np.zeros_like(fit.active[..., 0])
    variance = split_axis(fit.covariance.diagonal(axis1=-2, axis2=-1), -1, fit.coefficients.shape[1], -1)
    std = np.sqrt(np.maximum(variance[..., : 3 * fit.frequencies.shape[-1]], 0.0))
    std = split_axis(std, -1, -1, 3)  # of Re C, Im C and f
    change = np.abs(previous.about(fit.centre).coefficients - fit.coefficients)
    same_frequency = np.abs(previous.frequencies - fit.frequencies) <= _SMALL_CHANGE * std[..., 2]
    small = (change <= _SMALL_CHANGE * std[..., :2].max(-1)) & same_frequency
    return (small | ~fit.active).all(-1)


@dataclass(eq=False)
class Acceleration:
    """Extrapolation of rounds that overshoot or converge slowly (Anderson acceleration: J. ACM 12, 547, 1965).

    A wrong motion also blurs the warped frames wrongly. With long exposures, rows therefore measure up to twice their
    residual displacement, or half of it. The measurements are corrected by the combination of the last steps that would
    have left the least change.
    """

    steps: list[Step] = field(default_factory=list)  # the last steps with the same tones

    def add(self, step: Step, *, same_tones: bool) -> None:
        """Keep a step; steps with other tones do not predict the next one."""
        self.steps = [*self.steps[1 - _NUM_STEPS :], step] if same_tones else [step]

    def applied(self, measurements: Measurements, fit: ToneFit) -> ToneFit | None:
        """The fit to the corrected measurements of the last step; None before the second step."""
        if len(self.steps) < 2:
            return None
        corrected = replace(measurements, displacements=measurements.displacements - self._correction())
        residual = residual_of(corrected, fit)
        return robust_fit(corrected, fit.frequencies, fit.active, fit.drift_order, residual, steps=1)[0]

    def _correction(self) -> Array:
        """Displacements (B, N, G, A) in px to subtract."""
        pairs = list(itertools.pairwise(self.steps))
        fitted = np.stack([after.fitted - before.fitted for before, after in pairs], -1)
        # the combination of differences of changes that is nearest to the last change, (B, n, M) for M differences
        change = np.stack([(after.change - before.change).reshape(len(fitted), -1) for before, after in pairs], -1)
        normal, right_side = change.mT @ change, change.mT @ self.steps[-1].change.reshape(len(fitted), -1, 1)
        ridge = 1e-3 * np.maximum(normal.diagonal(axis1=-2, axis2=-1).mean(-1), 1e-30)
        share = np.linalg.solve(normal + ridge[:, None, None] * np.eye(len(pairs)), right_side)[..., 0]
        share = np.clip(share, -_MAX_EXTRAPOLATION, _MAX_EXTRAPOLATION)
        return (fitted * share[:, None, None, None]).sum(-1)
