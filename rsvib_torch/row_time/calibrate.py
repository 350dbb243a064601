"""Row time of a camera from frames of flickering light."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rsvib_torch.checks.arguments import Channels, FramesOrFiles, checks_arguments
from rsvib_torch.checks.values import Positive
from rsvib_torch.results.presentation import JudgedResult
from rsvib_torch.results.reason import Reason
from rsvib_torch.row_time.flicker import MIN_PERIODS, find_bands, row_profiles
from rsvib_torch.text import measured_text, wrapped

ScanAxis = Literal[-2, -1, "y", "x"]


@dataclass(frozen=True, eq=False, repr=False)
class RowTimeCalibration(
    JudgedResult,
    units={
        **dict.fromkeys(("row_time", "row_time_std", "candidates"), "s"),
        **{"period_rows": "rows", "flicker_frequency": "Hz", "frame_rows": "row times"},
    },
):
    """Result of a calibration; undetermined values are None, with the reason in ``notes``.

    Attributes:
        row_time: T_row in seconds; None if it is not determined.
        row_time_std: Its standard deviation, without that of the flicker frequency or frame rate.
        period_rows: Period of the bands in rows; None without flickering light.
        contrast: Amplitude of the bands' fundamental over their mean, at most 2; None without flickering light.
        flicker_frequency: In Hz, as given or found; None without flickering light.
        frame_rows: Row times from one frame to the next, where the frame rate is known.
        readout_direction: ``"forward"`` or ``"reverse"``, from the motion of the frames; None if it is unknown.
        notes: Reasons for undetermined values, and warnings.
        candidates: Row times in seconds that explain the motion of the frames, negative for a reverse readout; empty
            for a calibration with flickering light.
        reliable: Whether a single row time explains the frames.
        findings: Each ``Reason`` why not; ``reasons`` has their texts.
    """

    row_time: Positive | None
    row_time_std: float | None
    period_rows: float | None = None
    contrast: float | None = None
    flicker_frequency: float | None = None
    frame_rows: float | None = None
    readout_direction: Literal["forward", "reverse"] | None = None
    notes: tuple[str, ...] = ()
    candidates: tuple[float, ...] = ()
    reliable: bool = True
    findings: tuple[Reason, ...] = ()

    def summary(self) -> str:
        """The measured values of the sensor, and what is not determined."""
        lines = ["row time unknown"]
        if self.row_time is not None and self.row_time_std is not None:
            lines = [f"row time {measured_text(1e6 * self.row_time, 1e6 * self.row_time_std)} us"]
        if self.flicker_frequency is not None:
            lines += [
                f"flicker {self.flicker_frequency:.6g} Hz",
                f"bands of {self.period_rows:.3f} rows, contrast {self.contrast:.3g}",
            ]
        if self.frame_rows is not None:
            lines.append(f"frame period {self.frame_rows:.2f} row times")
        if self.readout_direction is not None:
            lines.append(f"readout direction {self.readout_direction}")
        if not self.reliable:
            lines += ["not reliable:", *(wrapped(f" - {reason}") for reason in self.reasons)]
        return "\n".join([*lines, *map(wrapped, self.notes)])


@checks_arguments
def calibrate_row_time(
    frames: FramesOrFiles,
    flicker_frequency: Positive,
    *,
    frame_rate: Positive | None = None,
    scan_axis: ScanAxis = -2,
    full_scale: float | None = None,
    channels: Channels = None,
) -> RowTimeCalibration:
    """Row time from frames of a light that flickers at a known frequency: ``T_row = 1 / (f P)``, bands of P rows.

    The brightness of the rows is fitted as that of the scene times a waveform that repeats every P rows. Shading along
    the rows is part of the fit; several frames of a still scene whose bands lie at different rows eliminate its
    texture.

    Bands do not show the readout direction: it is that of most cameras, ``"forward"``, unless detection names another
    one, see ``detect_vibration``.

    Args:
        frames: (T, H, W) or (T, C, H, W); floats of full scale 1, integers, or files.
        flicker_frequency: f in Hz. Mains light flickers at twice the frequency of the mains.
        frame_rate: Frames per second, T >= 2 consecutive ones.
        scan_axis: Axis along which rows follow each other, as in ``SensorTiming``.
        full_scale: Count that means 1.0, for integers other than 8 bit.
        channels: As in ``detect_vibration``.

    Returns:
        Row time with its standard deviation, and the other values that the arguments determine.

    Raises:
        ValueError: If there is no flicker in the frames, it is too fast or too slow for the camera, or the frames are
            black or saturated.

    Example:
        >>> import torch
        >>> rows = torch.arange(512)
        >>> light = 0.4 + 0.2 * torch.cos(2 * torch.pi * rows / 64)
        >>> found = calibrate_row_time(light[None, :, None].expand(1, 512, 16), 1000.0)
        >>> round(1e6 * found.row_time, 3)
        15.625
    """
    frequency = float(flicker_frequency)
    if frame_rate is not None and frequency < MIN_PERIODS * frame_rate:
        raise ValueError(
            f"flicker_frequency={frequency:g} Hz is slower than a frame of {frame_rate:g} per second: fewer than "
            f"{MIN_PERIODS:g} periods fit into one; use a faster flicker"
        )
    profiles = row_profiles(frames, scan_axis, full_scale, channels)
    bands, scene = find_bands(profiles)
    height = profiles.rows.shape[1]
    row_time = 1 / (frequency * bands.period)
    notes: list[str] = []
    if frame_rate is not None:
        _check_readout(row_time, frequency, height, frame_rate)
    if scene == "smooth" and len(profiles.rows) > 1:
        notes.append("the bands lie at the same rows in all frames, or the scene moves: its texture is not eliminated")
    return RowTimeCalibration(
        row_time=row_time,
        row_time_std=row_time * bands.period_std / bands.period,
        period_rows=bands.period,
        contrast=float(np.abs(bands.coefficients[:, 0]).mean()),
        flicker_frequency=frequency,
        frame_rows=None if frame_rate is None else 1 / (frame_rate * row_time),
        notes=tuple(notes),
    )


def _check_readout(row_time: float, frequency: float, height: int, frame_rate: float) -> None:
    """Raise if the rows do not fit into a frame, or if another row time would cause the same bands."""
    longest = 1 / (frame_rate * height)
    if row_time > 1.001 * longest:
        raise ValueError(
            f"a row time of {1e6 * row_time:.3f} us does not fit: {height} rows would take longer than a frame at "
            f"frame_rate={frame_rate:g} per second; check flicker_frequency={frequency:g} Hz"
        )
    others = [turns / frequency + sign * row_time for turns in (1, 2) for sign in (-1, 1)]  # the shortest ones
    possible = sorted(time for time in (row_time, *others) if time <= longest)
    if len(possible) > 1:
        listed = ", ".join(f"{1e6 * time:.3f}" for time in possible)
        raise ValueError(
            f"flicker_frequency={frequency:g} Hz is ambiguous: row times of {listed} us cause the same bands; "
            f"use at most {0.5 / longest:.0f} Hz"
        )
