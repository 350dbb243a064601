"""Result of the verdict on a restoration: the outcome of every pair of frames, with what it was determined from."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.results.presentation import JudgedResult
from rsvib_torch.results.reason import Reason
from rsvib_torch.text import measured_text, text_table, wrapped

Outcome = Literal["helps", "unknown", "partly", "worse"]
OUTCOMES: tuple[Outcome, ...] = ("helps", "unknown", "partly", "worse")  # in order of concern

DISPLACEMENTS = ("misfit_before", "misfit_after", "resolution")  # fields of a verdict with one value for each axis

# Thresholds of the two scores of the verdict, fitted on 720 restorations with known truth, see docs/ablation.md.
_PARTLY_RESIDUAL = 0.35  # of the displacement between the raw frames; above, a part of the vibration was not undone
_WORSE_RESIDUAL = 0.8  # of that displacement; above, the vibration was not undone
_GAIN_ERROR = 2.0  # dB; error of the estimated gain, up to which its sign is not used
_FINEST = 0.03  # px; misfit that is negligible in any image
_CROSSTALK = 0.05  # error of a misfit along one axis, relative to the displacement along the other


@dataclass(frozen=True, eq=False, repr=False)
class RestorationVerdict(
    JudgedResult,
    units={"misfit_before": "px", "misfit_after": "px", "resolution": "px", "predicted_gain": "dB"},
    shapes={**dict.fromkeys(DISPLACEMENTS, "P 2"), "predicted_gain": "P"},
):
    """Verdict on a restoration from P pairs of frames of one scene.

    Displacements are root-mean-square values over the pixels that both frames contain.

    Attributes:
        misfit_before: (P, 2) px, displacement between the raw frames, axes (x, y).
        misfit_after: (P, 2) px, displacement between a raw frame and its prediction, which is the other frame
            restored and blurred by the motion of the first.
        resolution: (P, 2) px, misfits below this cannot be distinguished from zero.
        predicted_gain: (P,) dB, improvement: estimated PSNR of the restored frames minus that of the raw ones. It is
            valid where the motion is right and complete, NaN where it is not and has the opposite sign of the outcome.
        outcome: For each pair: ``"helps"``; ``"partly"``: the vibration explains only a part of the displacement,
            and restored frames may be better or worse; ``"worse"``; ``"unknown"``: cannot be determined from this pair
            (vibration too small, or at a blind frequency; frames without contrast; too many missing pixels).
        findings: The ``Reason`` objects of each pair; none where restoration helps. ``reasons`` has their texts.
    """

    misfit_before: Tensor
    misfit_after: Tensor
    resolution: Tensor
    predicted_gain: Tensor
    outcome: tuple[Outcome, ...]
    findings: tuple[tuple[Reason, ...], ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("outcome", "findings"):
            if len(getattr(self, name)) != len(self.predicted_gain):
                raise ValueError(f"{name} must have {len(self.predicted_gain)} entries, one for each pair of frames")

    @property
    def reasons(self) -> tuple[str, ...]:
        """For each pair, the texts of its ``findings``."""
        return tuple("; ".join(reason.with_axis for reason in of_pair) for of_pair in self.findings)

    @property
    def overall(self) -> Outcome:
        """The outcome of greatest concern over all pairs."""
        return max(self.outcome, key=OUTCOMES.index)

    def summary(self) -> str:
        """The verdict in one line, and a table of the pairs of frames."""
        rows = []
        for pair, (outcome, gain) in enumerate(zip(self.outcome, self.predicted_gain.tolist(), strict=True)):
            sizes = torch.stack([self.misfit_before[pair], self.misfit_after[pair]], -1).flatten()
            rows.append([str(pair), outcome, *(measured_text(size, digits=2) for size in sizes), f"{gain:+.1f}"])
        head = ("pair", "outcome", "x before (px)", "x after (px)", "y before (px)", "y after (px)", "improvement (dB)")
        return f"{wrapped(self.sentence)}\n{text_table(head, rows)}"

    @property
    def sentence(self) -> str:
        """The verdict in one line."""
        worst = self.outcome.index(self.overall)
        gain = float(self.predicted_gain.nanmean())
        counted = f" ({self.outcome.count(self.overall)} of {len(self.outcome)} pairs)" if len(self.outcome) > 1 else ""
        sentences = {
            "helps": "restored frames agree" + ("" if math.isnan(gain) else f"; estimated improvement {gain:+.1f} dB"),
            "unknown": f"cannot determine whether restoration helps{counted}: {self.reasons[worst]}",
            "partly": f"the motion is wrong in part, restored may be worse than raw{counted}: {self.reasons[worst]}",
            "worse": f"restored is no better than raw{counted}: {self.reasons[worst]}",
        }
        return sentences[self.overall]


def outcome_of_pair(
    before: list[float],
    after: list[float],
    resolution: list[float],
    moves: list[bool],
    offset: list[float],
    gain: float,
    *,
    one_image: bool = False,
) -> tuple[Outcome, tuple[Reason, ...]]:
    """Outcome of one pair, and the reasons for it; none if restoration helps.

    Scores are the residual displacement relative to that of the raw frames, and the estimated gain in dB. The gain
    decides where the residual is small, because it is valid only where the motion is right. ``before`` and ``after``
    are the misfits (x, y) in px of the raw and of the restored frames, ``offset`` is what the vibration predicts for
    the raw ones, and below the ``resolution`` a misfit cannot be distinguished from 0. ``moves`` are the axes with
    motion. ``one_image`` states that both frames were restored to one image, whose gain is not valid for a wrong
    motion.
    """
    outcomes: list[tuple[Outcome, Reason | None]] = []
    motion_is_complete = True
    for axis, name in enumerate("xy"):
        least, size, remaining = max(resolution[axis], _FINEST), before[axis], after[axis]
        if not moves[axis]:
            motion_is_complete &= size <= least
            continue
        negligible = max(least, _CROSSTALK * before[1 - axis])
        visible = max(size, offset[axis])
        details = {"before": size}
        if math.isinf(least):
            outcomes.append(("unknown", Reason("no_contrast", name)))
        elif remaining <= negligible and visible <= least:
            outcomes.append(("unknown", Reason("displaced_alike", name, visible, least)))
        elif remaining <= max(negligible, _PARTLY_RESIDUAL * size):
            outcomes.append(("helps", None))
        elif remaining > _WORSE_RESIDUAL * size:
            # less noise may outweigh a motion that was not undone, but not a motion that does not exist
            outweighed = size > least and gain > _GAIN_ERROR and not one_image
            remains = Reason("motion_remains", name, remaining, max(_WORSE_RESIDUAL * size, negligible), details)
            outcomes.append(("partly" if outweighed else "worse", remains))
        else:
            remains = Reason("motion_remains", name, remaining, max(_PARTLY_RESIDUAL * size, negligible), details)
            outcomes.append(("partly", remains))
    if not outcomes:
        return "unknown", (Reason("nothing_undone"),)
    outcome = max((outcome for outcome, _ in outcomes), key=OUTCOMES.index)
    reasons = tuple(reason for kind, reason in outcomes if kind == outcome and reason is not None)
    if outcome in ("partly", "worse") or gain >= 0 or not motion_is_complete:
        return outcome, reasons
    if gain < -_GAIN_ERROR:
        return "worse", (Reason("noise_outweighs", None, gain, -_GAIN_ERROR),)
    return "unknown", reasons or (Reason("improvement_uncertain", None, gain, -_GAIN_ERROR),)
