"""Strength of the prior by generalised cross-validation."""

from collections.abc import Callable

import torch
from torch import Tensor

from rsvib_torch.restoration.scene_model.observation import RowKernels
from rsvib_torch.restoration.scene_model.row_prior import RowPrior
from rsvib_torch.restoration.scene_model.sampled_rows import Explained, sample_rows

__all__ = ["Strengths", "prior_strength", "select_strength"]

_STRENGTHS = (2.0, 1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # factors on the prior, from strong to weak


def _cross_validation(explained: Explained, strengths: Tensor) -> int:
    """Index of the strength, of those from strong to weak, selected by generalised cross-validation.

    ``n |r|^2 / (n - freedom)^2`` of Craven and Wahba (1979) estimates the squared error of predicting a pixel from all
    others. The sum over the frequencies is dominated by those with the largest errors; the geometric mean gives all the
    same weight. The weaker of the two selected priors is used, because one that is too weak has the smaller error.
    """
    residual_freedom = explained.count - explained.freedom
    of_sum = explained.power.sum(-1).log() - 2 * residual_freedom.sum(-1).log()
    geometric = (explained.power.log() - 2 * residual_freedom.log()).mean(-1)
    octaves = strengths.log2()
    # strength 1 follows from the noise level: another must reduce the logarithm by this much per octave, weaker or
    # stronger
    handicap = torch.maximum(-0.014 * octaves, 0.002 * octaves)
    return int(torch.maximum((of_sum + handicap).argmin(), (geometric + handicap).argmin()))


@torch.no_grad()
def prior_strength(
    images: Tensor, kernels: RowKernels, prior: RowPrior, noise_power: Tensor, *, certain: bool = True
) -> float:
    """Factor on the prior for restoring one scene.

    The prior is fitted to the power spectrum of the frames minus that of the noise. A weaker one predicts pixels better
    where dense texture is taken for noise, or where the scene differs from its mean spectrum.

    Args:
        images: (M, C, R, W) of one scene, in row order.
        kernels: Kernels of the images.
        prior: Fitted to them.
        noise_power: In the units of the prior.
        certain: Whether the noise level is given or estimated from several frames. That of a single frame includes
            texture, so that the prior cannot be too weak.

    Returns:
        One of a few factors.
    """
    height, width = images.shape[-2:]
    if min(height, width) < 64:  # too few values for a choice
        return 1.0
    count = min(height, 512)  # rows from the middle
    top = (height - count) // 2
    part = kernels.rows(top, count)
    # 24 frequencies from 0.02 cycles per px, below which the taper mixes them
    chosen = torch.linspace(
        0.02 * width, width // 2, min(24, width // 4), device=images.device, dtype=torch.float32
    ).long()
    place = (chosen.to(torch.float32) / width * 2 * (prior.power.shape[-1] - 1)).round().long()
    sample = sample_rows(images[..., top : top + count, :], part, chosen)
    # less noise than 200 times the interpolation error of the kernel cannot be distinguished from it
    certain = certain and bool(noise_power > 200.0 * prior.interpolation_power.mean())
    strengths = [strength for strength in _STRENGTHS if certain or strength <= 1]
    reach = kernels.reach
    return select_strength(
        strengths, [prior.precision(noise_power, strength, reach)[..., place] for strength in strengths], sample.explain
    )


def select_strength(
    strengths: list[float], precisions: list[Tensor], explain: Callable[[list[Tensor]], Explained]
) -> float:
    """The strength that cross-validation selects.

    Args:
        strengths: From strong to weak.
        precisions: Of the prior with each strength.
        explain: Residual power and degrees of freedom of the data for some of the precisions.
    """
    first = 3  # weaker priors are rarely selected: they are tried only if the weakest of these is
    tried = explain(precisions[:first])
    choice = _cross_validation(tried, tried.power.new_tensor(strengths[:first]))
    if choice == first - 1:
        tried = tried.joined(explain(precisions[first:]))
        choice = _cross_validation(tried, tried.power.new_tensor(strengths))
    return strengths[choice]


class Strengths:
    """Strengths of the prior for the scenes of a stack: those with about the same noise share one."""

    def __init__(self) -> None:
        self._chosen: list[tuple[float, float]] = []

    def of(self, noise: Tensor, choose: Callable[[], float]) -> float:
        """The strength for one scene.

        Args:
            noise: Power of the noise and of the interpolation error.
            choose: Returns the strength; called unless that of a scene with the same power, to 20 %, was chosen before.
        """
        logarithm = float(noise.detach().log())
        for other, strength in self._chosen:
            if abs(logarithm - other) < 0.2:
                return strength
        self._chosen.append((logarithm, choose()))
        return self._chosen[-1][1]
