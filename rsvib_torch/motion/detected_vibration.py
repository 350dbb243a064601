"""A detected vibration with its uncertainty and verdict: what restoration needs of a detection."""

from dataclasses import dataclass, field, fields
from typing import ClassVar

from torch import Tensor

from rsvib_torch.checks.values import described
from rsvib_torch.files.reading import Table
from rsvib_torch.motion.vibration import Vibration, VibrationStd, image_motion_line, tone_head, tone_places, tone_rows
from rsvib_torch.results.presentation import (
    AXIS_NAMES,
    PHYSICAL_HEAD,
    JudgedResult,
    axis_head,
    check_pixel_size,
    joined_columns,
    physical_tone,
    plain_values,
    verdict_table,
)
from rsvib_torch.results.reason import Findings
from rsvib_torch.text import measured_text, text_table, wrapped

_UNITS_OF_AXES = ("px", "px", "rad", "relative")  # in names of columns


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

    The fields are those of ``DetectionResult``.
    """

    _MADE_BY: ClassVar[str] = "from detect_vibration; of other results, pass .motion"  # for errors about arguments

    vibration: Vibration
    std: VibrationStd
    gain: Tensor
    residual: Tensor
    reliable: Tensor
    findings: Findings
    assumptions: tuple[object, ...]
    std_if_hidden_tone: VibrationStd | None = field(default=None, kw_only=True)

    @classmethod
    def of(cls, detection: "DetectedVibration") -> "DetectedVibration":
        """A detection without what derived classes add to it."""
        if not isinstance(detection, DetectedVibration):
            raise TypeError(f"detection must be a DetectedVibration, got {described(detection)}")
        return DetectedVibration(**{entry.name: getattr(detection, entry.name) for entry in fields(DetectedVibration)})

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
        rows = tone_rows(self.vibration, self.std, self.std_if_hidden_tone)
        head = tone_head(self.vibration.num_axes)
        table, *verdict = verdict_table(head, rows, self.batch_shape, self.reliable, self.reasons)
        if not self.batch_shape:
            verdict += [wrapped(f"assumed: {text}") for text in self.assumptions]
        if any("(± " in cell for cells in rows for cell in cells):
            verdict.append("(±): if another tone is hidden in the record")
        return "\n".join([table, *image_motion_line(self.vibration, self.std), *verdict])

    def physical_summary(self, pixel_size: float) -> str:
        """Amplitudes of displacement, velocity and acceleration of the tones of x and y, for a pixel size in m."""
        check_pixel_size(pixel_size)
        rows = []
        for at, labels in tone_places(self.vibration):
            amplitude, frequency = float(self.vibration.amplitude[at]), float(self.vibration.frequency[at])
            if at[-2] < 2 and amplitude > 0:
                relative = float(self.std.amplitude[at]) / amplitude
                values = physical_tone(amplitude, frequency, pixel_size).values()
                rows.append([*labels, measured_text(frequency), *(measured_text(v, relative * v) for v in values)])
        return text_table([*axis_head(self.batch_shape), "frequency (Hz)", *PHYSICAL_HEAD], rows)

    def table(self, *, pixel_size: float | None = None) -> dict[str, list[object]]:
        """One row per tone and axis (and result of a batch); an axis without a tone has one row with tone 0.

        The phase refers to the time origin of the vibration, which is that of its stack or window. Amplitudes of roll
        and zoom have columns of their own. ``reasons`` are codes of ``Reason``. Arguments as in ``Result.table``.

        Example:
            >>> import rsvib_torch as rsv
            >>> from rsvib_torch.datasets import example_frames
            >>> frames, timing, _ = example_frames()
            >>> table = rsv.detect_vibration(frames, timing).table(pixel_size=5e-6)
            >>> table["axis"], table["tone"], [round(value, 1) for value in table["amplitude_um"]]
            (['x', 'y'], [1, 1], [10.5, 8.0])
        """
        return joined_columns(self.tone_lines(pixel_size))

    def tone_lines(self, pixel_size: float | None = None) -> list[Table]:
        """Lines of ``table``."""
        pixel_size = check_pixel_size(pixel_size)
        vibration, hidden = self.vibration, self.std_if_hidden_tone or self.std
        lines: list[Table] = []
        for at, _ in tone_places(vibration):
            *batch, axis, tone = at
            is_tone, unit = float(vibration.amplitude[at]) > 0, _UNITS_OF_AXES[axis]
            line: Table = {"index": ", ".join(map(str, batch))} if batch else {}
            middle = self._middle_time(tuple(batch))
            line |= {} if middle is None else {"middle_time_s": middle}
            line |= {"axis": AXIS_NAMES[axis], "tone": is_tone * (tone + 1)}
            for name, unit_name in (("frequency", "Hz"), ("amplitude", unit), ("phase", "rad")):
                for kind, values in (("", vibration), ("_std", self.std), ("_std_if_hidden_tone", hidden)):
                    line[f"{name}{kind}_{unit_name}"] = plain_values(getattr(values, name)[at]) if is_tone else None
            line[f"image_motion_{unit}_per_s"] = float(vibration.image_motion[at[:-1]])
            line |= {"reliable": bool(self.reliable[at[:-1]]), "reasons": self.codes(at[:-1])}
            if pixel_size is not None and axis < 2:
                amplitude, frequency = float(vibration.amplitude[at]), float(vibration.frequency[at])
                physical = physical_tone(amplitude, frequency, pixel_size)
                line |= physical if is_tone else dict.fromkeys(physical)
                line["image_motion_um_per_s"] = 1e6 * pixel_size * line["image_motion_px_per_s"]
            lines.append(line)
        return lines

    def _middle_time(self, batch: tuple[int, ...]) -> float | None:
        """Middle of the frames of a result in s; None without an offset curve."""
        return None
