"""A detected vibration with its uncertainty and verdict: what restoration needs of a detection."""

from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

from torch import Tensor

from rsvib_torch.core.checks import described
from rsvib_torch.core.presentation import JudgedResult, verdict_table
from rsvib_torch.core.text import wrapped
from rsvib_torch.motion.vibration import Vibration, VibrationStd, image_motion_line, tone_head, tone_rows


@dataclass(frozen=True, eq=False, repr=False)
class DetectedVibration(
    JudgedResult,
    shapes={
        "gain": "... A K",
        **dict.fromkeys(("residual", "reliable"), "... A"),
        **dict.fromkeys(("findings", "assumptions"), "..."),
    },
):
    """A detection without its offset curve: everything that restoration needs. A batch leads all tensors.

    Attributes:
        vibration: The vibration in image axes; an axis without a significant tone has amplitude 0.
        std: Standard deviations of its parameters, given the tones that were found; infinite where unknown.
        std_if_hidden_tone: The same if the record may contain a further tone, which few frames cannot exclude; None:
            not larger.
        gain: (..., 2, K) offset gain of Eq. (7) from displacement to offset between the first two frames.
        residual: (..., 2) px, mean absolute difference of measured and fitted offsets.
        reliable: (..., 2) bool, verdict for each axis (x, y).
        findings: Each ``Reason`` against each axis that is not reliable; a tuple of those for a batch. ``reasons`` has
            their texts.
        assumptions: What the frames cannot contradict, one sentence for each; a tuple of those for a batch.
    """

    _MADE_BY: ClassVar[str] = "from detect_vibration; of other results, pass .motion"  # for errors about arguments

    vibration: Vibration
    std: VibrationStd
    gain: Tensor
    residual: Tensor
    reliable: Tensor
    findings: tuple[Any, ...]
    assumptions: tuple[Any, ...]
    std_if_hidden_tone: VibrationStd | None = field(default=None, kw_only=True)

    @classmethod
    def of(cls, detection: "DetectedVibration") -> "DetectedVibration":
        """A detection without what derived classes add to it."""
        if not isinstance(detection, DetectedVibration):
            raise TypeError(f"detection must be a DetectedVibration, got {described(detection)}")
        return DetectedVibration(**{part.name: getattr(detection, part.name) for part in fields(DetectedVibration)})

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = tuple(self.batch_shape)
        if (tuple(self.std.batch_shape), tuple(self.reliable.shape[:-1])) != (shape, shape):
            raise ValueError(
                f"vibration, std and reliable must have the same batch dimensions, got {shape}, "
                f"{tuple(self.std.batch_shape)} and {tuple(self.reliable.shape[:-1])}"
            )
        if not shape and not all(isinstance(sentence, str) for sentence in self.assumptions):
            raise TypeError("assumptions must be texts")

    def summary(self) -> str:
        """Tones of each axis with standard deviations, then the verdict; of a batch, a table with one row per axis."""
        rows = [cells for _, cells in tone_rows(self.vibration, self.std, hidden=self.std_if_hidden_tone)]
        head = tone_head(axes=self.vibration.num_axes)
        table, *verdict = verdict_table(head, rows, self.batch_shape, self.reliable, self.reasons)
        if not self.batch_shape:
            verdict += [wrapped(f"assumed: {text}") for text in self.assumptions]
        if any("(± " in cell for cells in rows for cell in cells):
            verdict.append("(±): if another tone is hidden in the record")
        return "\n".join([table, *image_motion_line(self.vibration, self.std), *verdict])
