"""Displacement of every scene row in every frame, by weighted least squares on image gradients.

Frames are first warped to the scene by a known motion. With the scene s, its gradient g = (ds/dx, ds/dy) and the
residual displacement d of a row in one frame, the warped frame differs from the scene by ``e = -g . d`` plus noise of
variance sigma^2. The weighted least-squares estimate of d solves, for each row,

    ``H d = b``,  ``H = sum_x w g g^T / sigma^2``,  ``b = -sum_x w g e / sigma^2``

and H is the information matrix (inverse covariance) of d. The scene is unknown. The mean of the warped frames replaces
it, cleaned by a Wiener filter, and e is the difference of a frame from that mean. The noise of the mean is independent
of the noise of these differences, so that b has no bias, and the filter brings the variance close to the Cramer-Rao
bound. Detail of the scene is a third regressor beside the gradients, which removes differences in contrast.

Rows lie on axis -2 in readout order.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from threading import get_ident

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.execution.parallel import chunks, in_parallel
from rsvib_torch.numerics.interpolation import fast_length
from rsvib_torch.registration.row_spectra import combined, differences, inner_columns, mean_over_frames

BLOCK = 16  # px, side of the blocks of pixels that share a weight
_SMOOTH = 16  # spectral values averaged along each axis for the power of scene and noise
# of the bias if A(u) was constant. Three drawn scenes behind optics of 0.3 and 0.4 px had biases of 6e-3 and 2.4e-3 px,
# and 4e-2 and 2.5e-2 px with a constant A
_SHARE_OF_ALIASING = 1 / 8
# part of the power; less aliased detail is not attenuated. Rms errors of amplitudes over the bound of 46 to 60 axes of
# a camera that aliases, without and with this: two frames 13.3, 12.3; four 21.7, 16.8; eight 12.3, 11.6; roll 10.4,
# 9.1. Medians decrease by 8 to 19 %. Scenes behind soft optics are not affected
_LEAST_ALIASED = 1e-3
# of the mean of all rows. Rows of bars or of a clipped sky have no noise, only detail that the Wiener filter spreads
# from their neighbours: without this, 40 black rows of 360 changed amplitudes by 1 %, 13 standard deviations
_LEAST_VARIANCE = 0.01
_NOISE_STEP = 4  # along the rows, every fourth frequency gives the noise power


@dataclass(frozen=True, eq=False)
class RowGradients:
    """Gradients of the scene for the rows of a group of G frames, and their products with differences of the frames."""

    # (B, S, A + 1, L) weight times the derivatives of the scene by the A components of the motion, x and y first, and
    # the detail of the scene, less their means
    images: Tensor
    products: Tensor  # (B, S, A + 1, A + 1) float64 sums of their products
    # (B, S, A + 1, G) float64 sums of their products with the differences of the frames; for two frames (B, S, A + 1,
    # 1), those of the first
    residual_products: Tensor
    variance: Tensor  # (B, S) float64, noise variance of a pixel in a frame
    # (B, S, 4, 5) float64, sums gx gx, gx gy, gy gy, gx e and gy e over the quarters of each row from left to right,
    # with e the residual difference between the last and the first frame. A displacement that depends on the row only
    # is equal in all of them.
    quarters: Tensor
    aliasing: Tensor  # (B,) float64 px, expected size of the bias of displacements by aliasing (``_aliasing_bias``)

    def stacks(self, index: Tensor) -> "RowGradients":
        """The gradients of some stacks; they are copied."""
        return RowGradients(*(values[index] for values in vars(self).values()))

    def without_images(self) -> "RowGradients":
        """The gradients without their images, which take most of the memory and serve further rounds."""
        return replace(self, images=self.images.new_empty(0))


def row_gradients(
    warp: Callable[[slice], Tensor],
    runs: list[slice],
    shift: Tensor,
    visible: Tensor,
    size: tuple[int, int],
    valid: Tensor | None,
    factors: Callable[[slice], Tensor] | None = None,
) -> RowGradients:
    """Gradients of the scene, noise, and the weight of every pixel, from frames warped by a motion.

    Args:
        warp: Function from a slice of the S rows of the scene to the frames of a group warped to them, (B, G, s, U), as
            ``RowSpectra.warped``. Threads call it.
        runs: Slices of the rows that are warped at a time.
        shift: (B, G, S) px, displacement along the rows that the warp removes.
        visible: (B, G, S) float64, 1 where a scene row is visible in a frame.
        size: Columns of a frame, and length of the transforms along the rows.
        valid: (B, S, W) bool, pixels of the scene that are valid in all frames; None for all.
        factors: Displacements (B, s, L, 2, A) of the pixels of some rows by unit components of the motion, x and y
            first; the derivatives by all of them are regressors. None if the displacement depends on the row only.
    """
    (batch, frames, count), (width, length) = visible.shape, size
    mean, noise, different = _compare(warp, runs, visible)
    detail, along, across, aliasing = _scene_detail(mean, noise, length)
    inner = functional.pad(inner_columns(width, shift, detail.real), (0, length - width))
    parts = chunks(count, 4 * length * batch * (4 + frames), visible.device, multiple=BLOCK)
    regressors = 3 if factors is None else 1 + factors(slice(0, 1)).shape[-1]
    images_of_row = regressors + (1 if frames == 2 else frames)
    memory: dict[int, Tensor] = {}  # of each thread, used for all its parts

    def pixels(part: slice) -> _Rows:
        scene_detail, part_visible = detail[:, part].contiguous(), visible[:, :, part]
        if get_ident() not in memory:
            memory[get_ident()] = inner.new_empty(batch, parts[0].stop, images_of_row, length)
        planes = memory[get_ident()][:, : scene_detail.shape[1]]
        planes[:, :, 0], planes[:, :, 1] = (
            torch.fft.irfft(spectrum, n=length) for spectrum in (scene_detail * along, across[:, part])
        )
        if factors is not None:
            by_unit = factors(part).to(planes.dtype)
            by_component = by_unit[..., 0, :] * planes[:, :, 0, :, None] + by_unit[..., 1, :] * planes[:, :, 1, :, None]
            planes[:, :, : regressors - 1] = by_component.movedim(-1, 2)
        for place, spectrum in enumerate((scene_detail, *different[:, :, part].unbind(1)), regressors - 1):
            planes[:, :, place] = torch.fft.irfft(spectrum, n=length)
        weight = inner * (part_visible.sum(1) > 1)[..., None].to(inner.dtype)
        if valid is not None:
            weight = weight * functional.pad(valid[:, part], (0, length - width))
        return _Rows(planes, weight, part_visible, regressors)

    edges = [width * number // 4 for number in range(1, 4)]
    images = inner.new_empty(batch, count, regressors, length)
    fitted = in_parallel(lambda part: _fit_rows(pixels(part), edges, images[:, part]), parts, visible.device)
    fits, blocks = ([part[place] for part in fitted] for place in (0, 1))
    block_weight = _block_weight(*(torch.cat(values, 1) for values in zip(*blocks, strict=True)))
    within = [slice(part.start // BLOCK, -(-part.stop // BLOCK)) for part in parts]
    lost = (block_weight < 1).any(-1).any(0).tolist()
    reweighted_places = [place for place in range(len(parts)) if any(lost[within[place]])]

    def fit_again(place: int) -> tuple[Tensor, ...]:
        rows = pixels(parts[place])
        spread = block_weight[:, within[place]].repeat_interleave(BLOCK, 1).repeat_interleave(BLOCK, 2)
        weight = rows.weight * spread[:, : rows.weight.shape[1], :length]
        return _fit_rows(replace(rows, weight=weight), edges, images[:, parts[place]])[0]

    for place, fit in zip(reweighted_places, in_parallel(fit_again, reweighted_places, visible.device), strict=True):
        fits[place] = fit
    sums, solution, square = (torch.cat(values, 1) for values in zip(*fits, strict=True))
    products, right_side = _products(sums.sum(2))
    means = _means(products)
    variance = square / (products[..., -1, -1] - regressors - 1).clamp(min=1.0)
    return RowGradients(
        images,
        products=products[..., :-1, :-1] - means * products[..., -1:, :-1],
        residual_products=right_side[..., :-1, :] - means * right_side[..., -1:, :],
        variance=variance.maximum(_LEAST_VARIANCE * variance.mean(-1, keepdim=True)),
        quarters=_quarters(sums, solution, visible),
        aliasing=aliasing,
    )


def residual_products(
    warp: Callable[[slice], Tensor], runs: list[slice], gradients: RowGradients, visible: Tensor
) -> Tensor:
    """``RowGradients.residual_products`` of other frames, or of a similar motion; arguments as in ``row_gradients``."""
    length = gradients.images.shape[-1]

    def products_of_run(rows: slice) -> Tensor:
        pixels = torch.fft.irfft(differences(warp(rows), visible[:, :, rows]).transpose(1, 2), n=length)
        return torch.matmul(gradients.images[:, rows], pixels.transpose(-2, -1))

    return torch.cat(in_parallel(products_of_run, runs, visible.device), 1).double()


def row_equations(products: Tensor, gradients: RowGradients, visible: Tensor) -> tuple[Tensor, Tensor]:
    """Normal equations ``H d = b`` of the residual displacement d of every scene row in each frame.

    With the ``products`` P of the gradients g and the detail q (``gradients.residual_products``, or those of other
    frames), the detail is eliminated (Schur complement): ``H = (P_gg - P_gq P_qg / P_qq) / sigma^2``, and b likewise.
    ``visible`` (B, G, S) is 1 where a scene row is visible in a frame.

    Returns:
        H (B, S, A, A) in px^-2 and b (B, G, S, A) in px^-1, float64. ``H^-1 b`` is the displacement in px
        relative to the mean over the group, and H its information matrix in one frame. Both are 0 for rows that are
        visible in fewer than two frames or have no detail.
    """
    target = -(torch.cat([products, -products], -1) if visible.shape[1] == 2 else products).permute(0, 3, 1, 2)
    scene = gradients.products
    detail = scene[..., -1, -1]
    safe = detail.clamp(min=1e-300)
    usable = (detail > 0) & (gradients.variance > 0)
    matrix = scene[..., :-1, :-1] - scene[..., :-1, -1:] * scene[..., -1:, :-1] / safe[..., None, None]
    target = target[..., :-1] - scene[:, None, :, :-1, -1] * (target[..., -1:] / safe[:, None, :, None])
    factor = torch.where(usable, 1 / torch.where(usable, gradients.variance, 1.0), 0.0)
    return matrix * factor[..., None, None], target * factor[:, None, :, None]


@dataclass(frozen=True, eq=False)
class _Rows:
    """Pixels of some rows of the scene."""

    planes: Tensor  # (B, s, A + 1 + G, L) derivatives, detail, and the differences of the frames (``differences``)
    weight: Tensor  # (B, s, L) of the pixels
    visible: Tensor  # (B, G, s), 1 where a row is visible in a frame
    regressors: int  # number A + 1 of derivatives and detail


def _fit_rows(rows: _Rows, edges: list[int], out: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Least-squares fit of the differences of the frames by gradients, detail and a constant, row by row.

    The images of ``RowGradients`` are written into ``out`` (B, s, A + 1, L). The result has the products from
    ``_sums_of_parts``, whose ``edges`` are given, the coefficients (B, s, G, A + 2) of the fit and the weighted sum (B,
    s) of its squared residuals in one frame; and the arguments of ``_block_weight``.
    """
    images, residual = rows.planes[:, :, : rows.regressors], rows.planes[:, :, rows.regressors :]
    weighted = torch.mul(images, rows.weight[:, :, None], out=out)
    sums = _sums_of_parts(weighted, rows, edges)
    products, right_side = _products(sums.sum(2))
    solution = _solve(products, right_side.transpose(-2, -1))
    factors = solution.to(weighted.dtype)
    fitted = torch.matmul(factors[..., :-1], images).add_(factors[..., -1:])
    energy = torch.sub(residual, fitted, out=fitted).square_().sum(2) * rows.weight
    freedom = (rows.visible.sum(1) - 1).clamp(min=1.0) * (residual.shape[2] / rows.visible.shape[1])
    energy /= freedom[..., None].to(energy.dtype)
    slope = (weighted[:, :, 0] * images[:, :, 0]).addcmul_(weighted[:, :, 1], images[:, :, 1])
    blocks = _sum_of_blocks(energy), _sum_of_blocks(slope), _sum_of_blocks(rows.weight)
    means = _means(products).to(weighted.dtype)
    for image, mean, weight in zip(weighted, means, rows.weight, strict=True):
        # as a product of matrices: several times faster than with a factor for each row
        image.baddbmm_(mean, weight[:, None], alpha=-1)
    return (sums, solution, energy.sum(-1).double()), blocks


def _products(sums: Tensor) -> tuple[Tensor, Tensor]:
    """Products (B, s, A + 2, A + 2) of images and ones, and (B, s, A + 2, G) with the differences, of whole rows."""
    images = sums.shape[-2] - 1
    return torch.cat([sums[..., :images], sums[..., -1:]], -1), sums[..., images:-1]


def _means(products: Tensor) -> Tensor:
    """Weighted means (B, s, A + 1, 1) of the images."""
    return products[..., :-1, -1:] / products[..., -1:, -1:].clamp(min=1e-6)


def _sums_of_parts(weighted: Tensor, rows: _Rows, edges: list[int]) -> Tensor:
    """Products (B, s, parts, A + 2, A + 2 + G) of weighted images and ones with images, differences and ones."""
    count, parts = weighted.shape[2], len(edges) + 1
    sums = weighted.new_empty(*weighted.shape[:2], parts, count + 1, 1 + rows.planes.shape[2], dtype=torch.float64)
    for part, (first, end) in enumerate(itertools.pairwise([0, *edges, None])):
        columns = slice(first, end)
        images, weight = weighted[..., columns], rows.weight[..., columns]
        planes = rows.planes[..., columns].transpose(-2, -1)
        part_sums = sums[:, :, part]
        part_sums[..., :count, :-1] = torch.matmul(images, planes)
        part_sums[..., count:, :-1] = torch.matmul(weight[:, :, None], planes)
        part_sums[..., :count, -1] = part_sums[..., count, :count]
        part_sums[..., count, -1] = weight.sum(-1)
    return sums


def _solve(products: Tensor, right_side: Tensor) -> Tensor:
    """Coefficients (B, s, G, A + 2) of the fit, with a relative regularisation of 1e-6; 0 for rows without detail."""
    diagonal = products.diagonal(dim1=-2, dim2=-1)
    usable = (diagonal > 0).all(-1)[..., None]
    scale = torch.where(usable, diagonal.clamp(min=1e-300).rsqrt(), 0.0)
    eye = torch.eye(scale.shape[-1], dtype=scale.dtype, device=scale.device)
    unit = (
        products * scale[..., :, None] * scale[..., None, :]
        + torch.where(usable, scale.new_tensor(1e-6), 1.0)[..., None] * eye
    )
    solution = torch.linalg.solve(unit, (right_side * scale[..., None, :]).transpose(-2, -1)).transpose(-2, -1)
    return solution * scale[..., None, :]


def _sum_of_blocks(values: Tensor) -> Tensor:
    """Sums (B, N, M) over blocks of values (B, s, L); the last ones of either axis may be smaller."""
    rows, columns = values.shape[1:]
    if -rows % BLOCK:
        values = functional.pad(values, (0, 0, 0, -rows % BLOCK))
    strips = values.unflatten(1, (-1, BLOCK)).sum(2)
    return functional.pad(strips, (0, -columns % BLOCK)).unflatten(2, (-1, BLOCK)).sum(3)


def _block_weight(energy: Tensor, slope: Tensor, share: Tensor) -> Tensor:
    """Weight (B, N, M) in 0 ... 1 of blocks, small where the residual exceeds noise and a small shift.

    Objects that move by themselves, clouds and parallax leave such residuals. The weight is ``1 / (1 + (r - 1)^2)`` for
    r > 1, with r the mean square of the residual over ``9 median + (0.15 px)^2 |g|^2``. Over each block, ``energy`` and
    ``slope`` are sums of the squared residual and gradient, ``share`` is that of the weights.
    """
    is_used = share > 0
    mean, slope = energy / share.clamp(min=1e-6), slope / share.clamp(min=1e-6)
    typical = torch.where(is_used, mean, torch.nan).flatten(1).nanmedian(1).values[:, None, None]
    ratio = mean / (9.0 * typical + 0.15**2 * slope).clamp(min=1e-30)
    return 1 / (1 + (ratio - 1).clamp(min=0.0).square())


def _quarters(sums: Tensor, solution: Tensor, visible: Tensor) -> Tensor:
    """Sums over the parts of each row, as in ``RowGradients.quarters``; the ``solution`` is (B, s, G, A + 2)."""
    count = solution.shape[-1] - 1
    images, ones = solution[:, :, None].transpose(-2, -1).split((count, 1), dim=-2)
    target = sums[..., :2, count:-1] - sums[..., :2, :count] @ images - sums[..., :2, -1:] @ ones  # (B, s, parts, 2, G)
    change = target[..., -1] - target[..., 0] if target.shape[-1] > 1 else -2 * target[..., 0]
    products = torch.stack([sums[..., 0, 0], sums[..., 0, 1], sums[..., 1, 1]], dim=-1)
    return torch.cat([products, change], dim=-1) * (visible[:, 0] * visible[:, -1])[..., None, None]


def _compare(warp: Callable[[slice], Tensor], runs: list[slice], visible: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean (B, R, U) of warped frames, its noise (B, R, U / 4) and their ``differences``, spectra along S scene rows.

    R - S rows of zeros follow, so that transforms across rows are fast. Every fourth frequency gives the noise.
    """

    def compare_run(rows: slice) -> tuple[Tensor, Tensor, Tensor]:
        warped, part_visible = warp(rows), visible[:, :, rows]
        noise = _noise_of_mean(warped[..., ::_NOISE_STEP], part_visible)
        return mean_over_frames(warped, part_visible), noise, differences(warped, part_visible)

    means, noises, different = zip(*in_parallel(compare_run, runs, visible.device), strict=True)
    missing = fast_length(visible.shape[2]) - visible.shape[2]
    mean, noise = (
        torch.cat([*parts, parts[0].new_zeros(len(visible), missing, parts[0].shape[-1])], 1)
        for parts in (means, noises)
    )
    return mean, noise, torch.cat(different, 2)


def _scene_detail(mean: Tensor, noise: Tensor, length: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Detail of the scene and its derivatives, by a Wiener filter ``1 - N / P`` of the mean of the frames.

    P is the power spectrum of the mean and N that of its noise, both smoothed over 16 x 16 frequencies. The pass band
    excludes shading (below 1/64 cycles/px) and the frequencies that interpolation attenuates; those that are aliased
    are attenuated. ``length`` is that of the transforms along rows. The result has the spectrum (B, R, U) of the
    detail, the factors (B, 1, U) in px^-1 that turn it into the derivative along the rows, the spectrum (B, R, U) of
    the derivative across them, and the size of the bias (B,) in px by aliasing. Neighbours in memory belong to one
    frequency. Both derivatives have the size with which they predict the differences of the frames.
    """
    # 1. Powers. Transforms across rows leave the rows contiguous in memory, and all later loops run along them.
    spectrum, noise = (torch.fft.fft(rows, dim=-2).transpose(-2, -1) for rows in (mean, noise))
    u = torch.fft.rfftfreq(length, dtype=torch.float64, device=mean.device)
    v = torch.fft.fftfreq(spectrum.shape[-1], dtype=torch.float64, device=mean.device)
    total, noise_power = _smoothed(spectrum, _SMOOTH), _smoothed(noise, _SMOOTH // _NOISE_STEP)
    x, y = (functional.avg_pool1d(f.abs()[None], _SMOOTH, ceil_mode=True)[0] for f in (u, v))  # means of blocks
    bands = _pass_bands(x, y)
    # 2. The filter.
    wiener = (1 - noise_power / total.clamp(min=torch.finfo(total.dtype).tiny)).clamp(min=0.0)
    filtered = wiener * _with_little_aliasing(total - noise_power, noise_power, x, *bands)
    torch.view_as_real(spectrum).mul_(_in_pass_band(filtered, u, v)[..., None])
    # 3. A filter that attenuates frequencies of the scene makes derivatives d too small for least squares: with the
    # true ones g, the sum of ``d g`` is larger than that of ``d^2``.
    passed = filtered * torch.outer(*bands).to(filtered.dtype)
    products, squares = passed * wiener * total, passed.square() * total
    larger_x, larger_y = (
        ((products * f).sum((1, 2)) / (squares * f).sum((1, 2)).clamp(min=1e-30)).clamp(min=1.0)[:, None, None]
        for f in (x.square().to(filtered.dtype)[:, None], y.square().to(filtered.dtype))
    )
    detail = torch.fft.ifft(spectrum)
    spectrum *= (2j * math.pi * v).to(spectrum.dtype) * larger_y
    across = torch.fft.ifft(spectrum)
    aliasing = _aliasing_bias(total - noise_power, x, *bands)
    along = (2j * math.pi * u).to(spectrum.dtype) * larger_x
    return detail.transpose(-2, -1), along, across.transpose(-2, -1), aliasing


def _in_pass_band(factors: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Factors (B, U, S) of all frequencies u along and v across rows in cycles/px, from those (B, U / 16, S / 16)."""
    along, across = _pass_bands(u, v)
    # high pass: 1 - exp(-(u^2 + v^2) / (1/64)^2)
    slow_along, slow_across = along * torch.exp(-((64 * u) ** 2)), across * torch.exp(-((64 * v) ** 2))
    along, across, slow_along, slow_across = (x.to(factors.dtype) for x in (along, across, slow_along, slow_across))
    passed = torch.outer(along, across).addr_(slow_along, slow_across, alpha=-1)
    blocks = factors[:, :, None, :, None].expand(-1, -1, _SMOOTH, -1, _SMOOTH).flatten(3).flatten(1, 2)
    return blocks[:, : len(u), : len(v)] * passed


def _with_little_aliasing(scene_power: Tensor, noise_power: Tensor, u: Tensor, along: Tensor, across: Tensor) -> Tensor:
    """Factors (B, U / 16, 1) that attenuate detail along rows where its aliased part exceeds the noise.

    A scene whose power falls as ``exp(-k u)`` has the power ``exp(-k u) + exp(-k (1 - u))`` in the frames, proportional
    to ``cosh(k (1/2 - u))``. The second term is aliased. k follows from the powers at two frequencies, and the size of
    that term from the power at 1/2, which is twice as large. Arguments as of ``_aliasing_bias``.
    """
    passed = (along > 0.5)[:, None] & (across > 0.5)
    across = across.to(scene_power.dtype)
    power = (scene_power @ across).clamp(min=torch.finfo(scene_power.dtype).tiny)
    highest, below = power[:, -2:].mean(1), 0.5 - u.to(power.dtype)
    place = int((u - 0.35).abs().argmin())
    fall = torch.acosh((power[:, place] / highest).clamp(1.0, 1e6)) / below[place]
    aliased = 0.5 * highest[:, None] * torch.exp(-fall[:, None] * below)
    noise = noise_power.masked_fill(~passed, math.inf).amin((1, 2))[:, None] * across.sum()
    return (1 / (1 + aliased / (2 * noise + _LEAST_ALIASED * power)))[..., None]


def _pass_bands(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Low passes of the gradients along rows, where detail may be aliased, and across them, where splines attenuate it.

    They are 1 below a frequency in cycles/px, 0 above another one, and half a cosine between.
    """
    along, across = (
        0.5 + 0.5 * torch.cos(math.pi * ((frequency.abs() - low) / (high - low)).clamp(0.0, 1.0))
        for frequency, low, high in ((u, 0.40, 0.48), (v, 0.24, 0.34))
    )
    return along, across


def _aliasing_bias(scene_power: Tensor, u: Tensor, along: Tensor, across: Tensor) -> Tensor:
    """Expected size (B,) in px of the bias of displacements by aliasing, that of the scene itself.

    An aliased part of power A(u) in frames of power P(u) biases a displacement of a quarter of a pixel by ``sum 2 pi u
    A / sum (2 pi u)^2 P`` over the pass band of the gradients. At u = 1/2, A is the power of the scene (B, U / 16, S /
    16, smoothed); it falls quickly towards lower u. ``u`` (U / 16,) are the frequencies along rows in cycles/px;
    ``along`` (U / 16,) and ``across`` (S / 16,) are the pass bands.
    """
    power = scene_power.to(torch.float64)
    at_nyquist = (power[:, -1] @ across / across.sum()).clamp(min=0.0)
    slope = 2 * math.pi * u * along
    squares = (slope.square() @ power @ across.square()).clamp(min=1e-300)
    bias: Tensor = _SHARE_OF_ALIASING * at_nyquist * slope.sum() * across.sum() / squares
    return bias.clamp(max=1.0)  # px; without a scene, its power is that of rounding


def _smoothed(spectrum: Tensor, frequencies: int) -> Tensor:
    """Mean power (B, U / frequencies, S / 16) of blocks of a spectrum (B, U, S), up to a factor."""
    parts = torch.view_as_real(spectrum).flatten(-2)
    blocks = []
    for part in chunks(parts.shape[1], 4 * parts.shape[2] * len(parts), parts.device, multiple=frequencies):
        power = parts[:, part].square()
        num_whole = power.shape[1] // frequencies * frequencies
        blocks.append(power[:, :num_whole].unflatten(1, (-1, frequencies)).mean(2))
        if num_whole < power.shape[1]:
            blocks.append(power[:, num_whole:].mean(1, keepdim=True))
    return functional.avg_pool1d(torch.cat(blocks, 1), 2 * _SMOOTH, ceil_mode=True)


def _noise_of_mean(warped: Tensor, visible: Tensor) -> Tensor:
    """Difference (B, S, U) of the first and last frame that contain a row, with the noise of their mean; or 0."""
    count = visible.shape[1]
    order = torch.arange(count, device=visible.device)[:, None]
    first = torch.where(visible > 0, order, count).amin(1, keepdim=True)
    last = torch.where(visible > 0, order, -1).amax(1, keepdim=True)
    sign = ((order == last).double() - (order == first).double()) * (last > first)
    # the difference of two frames has twice the noise variance of a frame, the mean of n frames 1/n of it
    return combined(warped, sign * (0.5 / visible.sum(1, keepdim=True).clamp(min=1.0)).sqrt())
