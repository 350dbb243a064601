"""Solution on the finer grid, with more noise assumed if the frames differ from their model, and its warnings.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.numerics.fourier import squared_modulus
from rsvib_torch.restoration.exact.scene_solver import SceneProblem
from rsvib_torch.restoration.restoration_warning import warn_of_restoration

_BLOCK = 16  # rows of a frame whose displacement error is measured together
_SOLUTIONS = 10  # at most; one in general
# Residual power at a horizontal frequency, in units of the noise power, above which the prior excludes a pattern there:
# with the true motion at most 1 (one photograph: 1.9), with gratings beyond half a cycle per px 50 to 1e5.
_MAX_EXCESS = 1.5
_MOST_FREQUENCIES = 0.4  # share of the frequencies of a pattern: 0.04 to 0.3; 0.3 to 1 with a wrong motion
# Effect of the displacement error and residual, in units of the noise, above which a warning is raised. With the true
# motion at most 0.02 and 0.97; with an error of the phases of 0.05 rad (amplitudes 3 and 5 px) at least 0.16 and 0.85
# (drawn and photographed scenes, noise 0.002 to 0.02, 2 and 8 frames).
_MAX_EFFECT, _MAX_RESIDUAL = 0.1, 1.5


@dataclass(frozen=True)
class FrameDifference:
    """Differences of frames from the prediction of their scene."""

    residual: float  # standard deviation in units of the noise
    error: float  # displacement error in px, rms over the blocks of rows of all frames and both axes
    effect: float  # standard deviation of the difference that the displacement error causes, in units of the noise
    expected: float  # the same of displacements that the problem neglects
    noticed: bool = False  # whether the motion is inaccurate, or the scene changes

    @property
    def power(self) -> float:
        """Power of noise and differences, in units of the noise power."""
        return max(1 + self.effect**2, self.residual**2)

    def exceeds(self, effect: float, residual: float) -> bool:
        """Whether the effect, or the residual, is larger than given values and the expected effect explain."""
        return self.effect > math.hypot(effect, self.expected) or self.residual > math.hypot(residual, self.expected)


@torch.no_grad()
def _difference(problem: SceneProblem, predicted: Tensor, width: int, neglected: float) -> FrameDifference:
    """Differences of the data of one scene from a prediction (M, C, R, L), without the ends of rows and columns.

    The displacement error of a block of rows is the least-squares factor of the gradient of the prediction in the
    residual. The variance that noise of the residual causes in it is subtracted.
    """
    # 1. The residual and the gradients of the prediction, by the noise of each row, in blocks of rows.
    data, level = problem.data[0], problem.level[0]
    weight, rows = problem.observation.kernels.weight, data.shape[-2]
    inner = slice(min(16, rows // 4), -min(16, rows // 4)), slice(min(16, width // 4), width - min(16, width // 4))
    residual = data - predicted
    gradients = [0.5 * (predicted.roll(-1, axis) - predicted.roll(1, axis)) for axis in (-1, -2)]
    scale = (weight / weight[:, inner[0]].mean()).sqrt()[:, None, :, None]
    values = torch.stack([residual, *gradients]).to(torch.float64).mul_(scale)[..., *inner]
    size = min(_BLOCK, values.shape[-2])
    count = values.shape[-2] // size
    values = values[..., : count * size, :].unflatten(-2, (count, size)).movedim(2, 3).flatten(3)  # (3, M, n, values)
    difference, slopes = values[0], values[1:].movedim(0, -1)
    # 2. The displacement error of each block, and what noise causes in its square.
    power = difference.square().mean(-1)
    normal = slopes.transpose(-2, -1) @ slopes
    normal.diagonal(dim1=-2, dim2=-1).add_(1e-6 * level.to(torch.float64).square() * difference.shape[-1])
    error = torch.linalg.solve(normal, slopes.transpose(-2, -1) @ difference[..., None])[..., 0]
    chance = power[..., None] * torch.linalg.inv(normal).diagonal(dim1=-2, dim2=-1)
    squares = (error.square() - chance).mean((0, 1)).clamp(min=0.0)
    # 3. Its effect on the frames, and that of the displacements that the problem neglects.
    steepness = slopes.square().mean((0, 1, 2))
    effect, expected = (squares * steepness).sum().sqrt(), neglected * steepness.amax().sqrt()
    figures = torch.stack([power.mean().sqrt() / level, squares.sum().sqrt(), effect / level, expected / level])
    return FrameDifference(*figures.tolist())


@torch.no_grad()
def _excess(problem: SceneProblem, predicted: Tensor, width: int) -> Tensor:
    """Power (U,) of the tapered residual at each horizontal frequency, in units of the noise power."""
    weight, rows = problem.observation.kernels.weight, predicted.shape[-2]
    inner = slice(min(16, rows // 4), -min(16, rows // 4))
    taper = torch.hann_window(width + 2, periodic=False, dtype=predicted.dtype, device=predicted.device)[1:-1]
    residual = (problem.data[0] - predicted)[..., inner, :width] * (taper / taper.square().sum().sqrt())
    power = squared_modulus(torch.fft.rfft(residual, n=predicted.shape[-1])).mean(1)
    mean = (power * weight[:, inner, None]).mean((0, 1)) / weight[:, inner].mean()
    return (mean / problem.level[0].square()).to(problem.precision.dtype)


def finer_scene(problem: SceneProblem, width: int, neglected: float) -> tuple[Tensor, FrameDifference]:
    """Scene (1, C, 2 R, 2 L) on the finer grid, and the differences of its frames of ``width`` px.

    A fine pattern in a scene with otherwise little detail is far above the spectrum of the prior, and remains in the
    residual at its horizontal frequencies. The prior is weakened there by the power of the residual: gratings at 0.75
    cycles per px keep all of their contrast instead of a tenth.

    If this does not explain the residual, the frames differ from their model, in general by a wrong motion. The
    differences then count as noise: with an error of the phases of 0.05 rad, 27.5 dB become 32.6 dB (chart, noise
    0.002, 2 frames; 32.8 dB on pixels), 34.4 become 38.1 dB with 8 frames (34.7 dB on pixels). Displacements that the
    problem neglects, of standard deviation ``neglected`` px, count as noise as well, but do not contradict the motion.
    """
    factor, relaxed, largest = 1.0, torch.ones_like(problem.precision[0, 0]), math.inf
    allowed, noticed = _MAX_EFFECT, False
    for _ in range(_SOLUTIONS):
        # 1. The scene, and the differences of its frames from their prediction.
        solver = replace(problem, precision=factor / relaxed * problem.precision).solver()
        coefficients = solver.fit(problem.data)
        predicted = solver.predict(coefficients.detach())[0]
        difference, excess = _difference(problem, predicted, width, neglected), _excess(problem, predicted, width)
        # 2. A pattern at a few frequencies: weaken the prior there, while the residual decreases.
        before, largest = largest, float(excess.amax())
        # a pattern leaves a tenth of its effect, a wrong motion at least a fifth
        allowed = max(_MAX_EFFECT, 0.15 * difference.effect) if before == math.inf else allowed
        narrow = float((excess > _MAX_EXCESS).double().mean()) < _MOST_FREQUENCIES
        if narrow and factor == 1 and _MAX_EXCESS < largest < 0.7 * before:
            relaxed = relaxed * excess.clamp(min=1.0)
            continue
        # 3. Other differences count as noise, and the prior is weakened nowhere.
        noticed = difference.exceeds(allowed, _MAX_RESIDUAL)
        differs = difference.effect > allowed or difference.residual > _MAX_RESIDUAL
        if not differs or difference.power < 1.2 * factor:
            break
        factor, relaxed = difference.power, torch.ones_like(relaxed)
    return solver.image(coefficients), replace(difference, noticed=noticed)


def phase_spread(places: Tensor, frequency: float) -> Tensor:
    """``1 - |mean exp(2 pi i f x)|^2`` over displacements x (M, ...): 0 if frames sample a wave at the same phase."""
    mean = torch.polar(torch.ones_like(places), 2 * math.pi * frequency * places).mean(0).abs()
    return 1 - mean.square()


def warn_of_frames(differences: list[FrameDifference], places: Iterable[Tensor]) -> None:
    """Warn if frames on a finer grid do not fit their model, or do not sample between each other's pixels.

    ``places`` are the mean displacements (M, R, 2) of the rows of the frames of each scene.
    """
    noticed = [difference for difference in differences if difference.noticed]
    if noticed:
        worst = max(noticed, key=lambda difference: difference.power)
        warn_of_restoration(
            f"the frames differ from their model by {worst.residual:.1f} times the noise, rows are displaced by about "
            f"{worst.error:.2g} px more than the vibration states: it is not accurate enough for scale=2, or the scene "
            "changes between the frames; detail between the pixels is restored only in part and may be false"
        )
    # the factor on the information on aliased detail: 0.5 on average for two frames
    spread = [phase_spread(place, 1.0).mean(0) for place in places]
    if bool((torch.stack(spread).median(0).values < 0.1).any()):
        warn_of_restoration(
            "the frames of a scene sample the same points of it along at least one axis: scale=2 cannot separate "
            "detail beyond half a cycle per px from its alias there; restore more vibrating frames jointly"
        )
