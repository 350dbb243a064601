"""Cramér-Rao bound of the parameters of a vibration: the smallest standard deviation of an unbiased estimate."""

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_choice, check_number
from rsvib_torch.evaluation.bound.information import (
    Recording,
    gradient_information,
    projected_information,
    random_information,
    scale_of_information,
)
from rsvib_torch.frames.orientation import frames_to_row_order
from rsvib_torch.imaging import simulate_frames
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd

__all__ = ["cramer_rao_bound"]

BoundMethod = Literal["projection", "gradients", "random"]
_METHODS: dict[str, Callable[[Recording, float], Tensor]] = {
    "projection": lambda recording, _: projected_information(recording),
    "gradients": lambda recording, _: gradient_information(recording),
    "random": random_information,
}

# axis, name of the field, tone
_Parameter = tuple[int, str, int]


def _parameters(motion: Vibration, acceleration: bool) -> list[_Parameter]:
    """Unknown parameters: those of all tones of non-zero amplitude, and the image motion of both axes."""
    parameters: list[_Parameter] = []
    for axis in range(2):
        for tone in range(motion.amplitude.shape[-1]):
            if float(motion.amplitude[axis, tone]) > 0:
                parameters += [(axis, name, tone) for name in ("amplitude", "frequency", "phase")]
        parameters += [(axis, "image_motion", 0)]
        parameters += [(axis, "image_acceleration", 0)] if acceleration else []
    return parameters


def _sensitivity(motion: Vibration, parameter: _Parameter, times: Tensor) -> Tensor:
    """Derivative of the displacement at ``times`` by a parameter."""
    axis, name, tone = parameter
    if name == "image_motion":
        return times
    if name == "image_acceleration":
        return 0.5 * times.square()
    amplitude, frequency, phase = (value[axis, tone] for value in (motion.amplitude, motion.frequency, motion.phase))
    angle = 2 * math.pi * frequency * times + phase
    if name == "amplitude":
        return angle.sin()
    return amplitude * angle.cos() * (2 * math.pi * times if name == "frequency" else 1.0)


def _deviations(information: Tensor, typical: Tensor) -> Tensor:
    """Square roots of the diagonal of the inverse; infinite where there is no information.

    Args:
        information: (P, P).
        typical: (P,), information for a known scene; eigenvalues below 1e-8 of it count as zero.
    """
    scale = typical.clamp(min=1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(information * scale[:, None] * scale)
    least = 1e-8
    blind = values < least
    shares = vectors.square()
    variance = shares @ torch.where(blind, 0.0, 1 / values.clamp(min=least))
    variance = torch.where(shares @ blind.double() > least, math.inf, variance)
    deviations: Tensor = variance.sqrt() * scale
    return deviations


def cramer_rao_bound(
    scene: Tensor,
    timing: SensorTiming,
    vibration: Vibration,
    num_frames: int = 2,
    *,
    noise: float,
    frame_size: tuple[int, int] | None = None,
    method: BoundMethod = "projection",
    acceleration: bool = False,
) -> VibrationStd:
    """Cramér-Rao bound of the parameters of a vibration, for white Gaussian noise and an unknown scene.

    No unbiased estimate has a smaller standard deviation. With D the derivatives of the frames by the parameters and
    A the operator that forms the frames, ``J = D' (1 - A (A' A)^-1 A') D / noise^2`` is the information if the scene is
    unknown too, and the bound is the root of the diagonal of its inverse.
    All parameters are unknown together: amplitude, frequency and phase (at the time origin) of all tones, and the
    image motion. ``docs/bound.md`` has the derivation.

    Args:
        scene: (H, W) noise-free still scene, floating point, full scale 1, larger than the frames.
        timing: The sensor.
        vibration: The true motion, in image axes (not a batch).
        num_frames: Frames taken of the scene.
        noise: Standard deviation of the noise of a pixel as a fraction of full scale.
        frame_size: (height, width) of the frames, as in ``simulate_frames``.
        method: ``"projection"``, exact for an unknown deterministic scene; ``"gradients"``, its closed approximation
            row by row, several times faster; or ``"random"``, the same for a random Gaussian scene with the power
            spectrum of this one: larger if part of the spectrum is below the noise, since the scene is estimated
            from the same frames.
        acceleration: Whether the image acceleration is unknown as well (else it is known).

    Returns:
        Standard deviations in the layout of ``detection.std``: infinite without information (amplitude and phase
        at a blind frequency), 0 for tones of amplitude 0 and for a known acceleration.

    Raises:
        TypeError: If the scene is not a floating-point tensor.
        ValueError: If the scene does not fit the frames and motion, there are fewer than two frames, or an option is
            out of range.

    Example:
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> scene = torch.rand(128, 96, generator=torch.Generator().manual_seed(0))
        >>> bound = cramer_rao_bound(scene, timing, Vibration(0.5, 700.0), noise=0.01, frame_size=(90, 60))
        >>> bool((bound.amplitude < 0.05).all())
        True
    """
    check_choice("method", method, tuple(_METHODS))
    noise = check_number("noise", noise, above=0.0)
    if not isinstance(scene, Tensor) or not scene.dtype.is_floating_point:
        raise TypeError("scene must be a floating-point tensor whose full scale is 1")
    if scene.ndim != 2:
        raise ValueError(f"scene must have shape (H, W), got {tuple(scene.shape)}")
    if num_frames < 2:
        raise ValueError(f"num_frames must be at least 2, got {num_frames}")
    # the simulation checks the sizes and the motion
    frames = simulate_frames(scene.double(), timing, vibration, num_frames, frame_size=frame_size)
    motion = vibration.to_row_order(timing).to(scene.device)
    parameters = _parameters(motion, acceleration)
    frames = frames_to_row_order(frames, timing)
    recording = Recording(
        scene=frames_to_row_order(scene.double(), timing),
        timing=timing.in_row_order(),
        motion=motion,
        num_frames=num_frames,
        size=(frames.shape[-2], frames.shape[-1]),
        axes=tuple(axis for axis, _, _ in parameters),
        sensitivity=lambda times: torch.stack([_sensitivity(motion, p, times) for p in parameters]),
    )
    deviations = noise * _deviations(_METHODS[method](recording, noise), scale_of_information(recording))

    std = {name: torch.zeros_like(motion.amplitude) for name in ("amplitude", "frequency", "phase")}
    std |= {name: torch.zeros_like(motion.image_motion) for name in ("image_motion", "image_acceleration")}
    for (axis, name, tone), deviation in zip(parameters, deviations, strict=True):
        std[name][(axis, tone) if std[name].ndim == 2 else axis] = deviation
    std["period"] = std["frequency"] / torch.where(motion.frequency > 0, motion.frequency, 1.0).square()
    if timing.scan_axis == -1:
        std = {name: value.flip(0) for name, value in std.items()}
    return VibrationStd(**std)
