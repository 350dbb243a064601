"""How strong the prior has to be: what predicts pixels best that the scene was not fitted to."""

from collections.abc import Callable

import torch
from torch import Tensor

from rsvib_torch.restoration.scene_model.observation import RowKernels
from rsvib_torch.restoration.scene_model.row_prior import RowPrior
from rsvib_torch.restoration.scene_model.sampled_rows import Explained, sample_rows

__all__ = ["Strengths", "prior_strength"]

_STRENGTHS = (2.0, 1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
_DOUBT = (0.014, 0.002)  # by how much a prior half, or twice, as strong has to predict better, in logarithms
_CLEAR = 200.0  # times what the kernel between rows cannot follow: less noise hides behind that
_FIRST = 3  # of them are nearly always enough
_ROWS = 512  # at most, from the middle of the frames
_FREQUENCIES = 24
_LOWEST = 0.02  # cycles per px; the taper spreads what lies below
_SMALLEST = 64  # rows and columns that a choice can be made from
_ALIKE = 0.2  # in the logarithm of what counts as noise


def _cross_validation(explained: Explained, strengths: Tensor) -> int:
    """Index of the strength, of those from strong to weak, that generalised cross-validation asks for.

    ``n |r|^2 / (n - freedom)^2`` of Craven and Wahba (1979) estimates the squared error of predicting a pixel from all
    others. For all frequencies together, those with the largest errors decide; its geometric mean over the frequencies
    counts all alike. Too weak a prior costs less than one that is too strong, so that the weaker one is taken; and what
    the noise asks for, strength 1, as long as hardly anything speaks against it.
    """
    left = explained.count - explained.freedom
    together = explained.power.sum(-1).log() - 2 * left.sum(-1).log()
    one_by_one = (explained.power.log() - 2 * left.log()).mean(-1)
    octaves = strengths.log2()
    doubt = torch.maximum(-_DOUBT[0] * octaves, _DOUBT[1] * octaves)
    return int(torch.maximum((together + doubt).argmin(), (one_by_one + doubt).argmin()))


@torch.no_grad()
def prior_strength(
    images: Tensor, kernels: RowKernels, prior: RowPrior, noise_power: Tensor, *, certain: bool = True
) -> float:
    """Factor on the prior for restoring one scene.

    The prior is fitted to the power of the frames less that of the noise. Where dense texture passes for noise, or the
    scene is unlike its mean spectrum, a weaker one is better: it leaves smaller errors where a pixel is predicted from
    all others.

    Args:
        images: (M, C, R, W) of one scene, in row order.
        kernels: How they see it.
        prior: Fitted to them.
        noise_power: In the units of the prior.
        certain: The noise is known, and not taken from one frame, where texture adds to it: only then can the prior
            be too weak.

    Returns:
        One of a few factors.
    """
    height, width = images.shape[-2:]
    if min(height, width) < _SMALLEST:
        return 1.0
    count = min(height, _ROWS)
    top = (height - count) // 2
    part = kernels.rows(top, count)
    chosen = torch.linspace(_LOWEST * width, width // 2, min(_FREQUENCIES, width // 4), device=images.device).long()
    place = (chosen / width * 2 * (prior.power.shape[-1] - 1)).round().long()
    sample = sample_rows(images[..., top : top + count, :], part, chosen)
    certain = certain and bool(noise_power > _CLEAR * prior.blind.mean())
    strengths = [strength for strength in _STRENGTHS if certain or strength <= 1]
    reach = kernels.reach
    precisions = [prior.precision(noise_power, strength, reach)[..., place] for strength in strengths]
    tried = sample.explain(precisions[:_FIRST])
    choice = _cross_validation(tried, tried.power.new_tensor(strengths[:_FIRST]))
    if choice == _FIRST - 1:
        tried = tried.joined(sample.explain(precisions[_FIRST:]))
        choice = _cross_validation(tried, tried.power.new_tensor(strengths))
    return strengths[choice]


class Strengths:
    """Strengths of one scene after the other; those with as much noise, and as blind, share one."""

    def __init__(self) -> None:
        self._known: list[tuple[float, float]] = []

    def of(self, noise: Tensor, choose: Callable[[], float]) -> float:
        """The strength for one scene.

        Args:
            noise: Power of what counts as noise.
            choose: Gives a strength where none is known of a scene with as much.
        """
        logarithm = float(noise.detach().log())
        for known, strength in self._known:
            if abs(logarithm - known) < _ALIKE:
                return strength
        self._known.append((logarithm, choose()))
        return self._known[-1][1]
