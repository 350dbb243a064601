"""Quality of restored images and of measured offset curves."""

from typing import Annotated

import torch
from kornia.metrics import ssim as kornia_ssim
from pydantic import Field
from torch import Tensor

from rsvib_torch.checks.arguments import FramesLike, as_tensor, checks_arguments
from rsvib_torch.checks.values import Positive

_Rim = Annotated[int, Field(ge=0)]


def _compared(image: FramesLike, reference: FramesLike, rim: int) -> tuple[Tensor, Tensor, torch.Size]:
    """Both images without their rim, float32 or float64 (N, C, H, W), and the shape of the result: (), (T,), (B, T)."""
    image, reference = as_tensor("image", image), as_tensor("reference", reference)
    for name, value in (("image", image), ("reference", reference)):
        if value.dtype.is_complex or value.dtype == torch.bool:
            raise TypeError(f"{name} must be real numbers, got {value.dtype}")
    if not 2 <= image.ndim <= 5:
        raise ValueError(
            f"image must have shape (H, W), (T, H, W), (T, C, H, W) or (B, T, C, H, W), got {tuple(image.shape)}"
        )
    misfit = (
        f"reference of shape {tuple(reference.shape)} does not fit image {tuple(image.shape)}, or holds more images"
    )
    if reference.shape[-2:] != image.shape[-2:]:
        raise ValueError(misfit)
    if min(image.shape[-2:]) <= 2 * rim:
        raise ValueError(f"rim={rim} is too large for an image of {image.shape[-2]} x {image.shape[-1]} px")
    try:
        pair = (image, reference.expand_as(image))
    except RuntimeError as error:
        raise ValueError(misfit) from error
    is_single = torch.promote_types(image.dtype, reference.dtype) in (torch.float16, torch.bfloat16, torch.float32)
    channels = 1 if image.ndim < 4 else image.shape[-3]
    first, second = (
        value[..., rim : value.shape[-2] - rim, rim : value.shape[-1] - rim]
        .to(torch.float32 if is_single else torch.float64)
        .reshape(-1, channels, *(size - 2 * rim for size in image.shape[-2:]))
        for value in pair
    )
    return first, second, image.shape[: -3 if image.ndim >= 4 else -2]


@checks_arguments
def psnr(image: FramesLike, reference: FramesLike, data_range: Positive, *, rim: _Rim = 0) -> Tensor:
    """Peak signal-to-noise ratio in dB of each image, float64: shape (), (T,) or (B, T).

    ``10 log10(data_range^2 / mean (image - reference)^2)``, the mean over the pixels and channels of one image;
    infinite where both are identical.

    Args:
        image: (H, W), or a stack (T, H, W), (T, C, H, W) or (B, T, C, H, W).
        reference: The truth, same shape, or one that broadcasts: one scene for all frames.
        data_range: Full scale of the values: 1 for frames as ``read_stack`` returns them.
        rim: Pixels to leave out at each border.

    Example:
        >>> psnr(torch.full((2, 8, 8), 0.6), torch.full((8, 8), 0.5), 1.0)
        tensor([20.0000, 20.0000], dtype=torch.float64)
    """
    first, second, shape = _compared(image, reference, rim)
    error = (first - second).flatten(1).to(torch.float64).square().mean(1)
    return (10.0 * torch.log10(data_range**2 / error)).reshape(shape)


@checks_arguments
def ssim(image: FramesLike, reference: FramesLike, data_range: Positive, *, rim: _Rim = 0) -> Tensor:
    """Structural similarity of each image (Wang et al. 2004).

    Equal to scikit-image's with ``gaussian_weights=True, sigma=1.5, use_sample_covariance=False``: Gaussian window of
    11 x 11 px, mean over the pixels whose window lies inside, and over channels. Computed in the dtype of the images:
    float64 agrees to rounding, float32 is several times faster and within 1e-5. Arguments and shape of the result as in
    ``psnr``.
    """
    first, second, shape = _compared(image, reference, rim)
    window = 11  # px, of a Gaussian of 1.5 px cut at 3.5 standard deviations, as in scikit-image
    if min(first.shape[-2:]) < window:
        raise ValueError(
            f"ssim needs at least {window} x {window} px within the rim, got {first.shape[-2]} x {first.shape[-1]}"
        )
    # the separable filters are several times faster along the channel axis than along the batch axis
    folded = [value.flatten(0, 1)[None] for value in (first, second)]
    similarity = kornia_ssim(folded[0], folded[1], window, max_val=float(data_range), eps=0.0, padding="valid")
    means: Tensor = similarity[0].unflatten(0, first.shape[:2]).flatten(1).mean(1, dtype=torch.float64)
    return means.reshape(shape)
