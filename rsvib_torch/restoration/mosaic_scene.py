"""Restoration of colour mosaics: three components of the scene from frames that measure one colour per pixel.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from itertools import product

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.execution.progress import steps
from rsvib_torch.frames.pixels import interpolated_colours, measures
from rsvib_torch.numerics.interpolation import extend_rows
from rsvib_torch.options import ExactOptions
from rsvib_torch.restoration.finer_grid import fit_polynomial_prior, phase_spread
from rsvib_torch.restoration.frame_motion import FrameMotion, MovingFrames, joint_groups, warn_of_restoration
from rsvib_torch.restoration.noise import noise_levels
from rsvib_torch.restoration.observation import SCALE, Observation, RowKernels
from rsvib_torch.restoration.priors import check_prior
from rsvib_torch.restoration.scene_solver import (
    MIN_LEVEL,
    SceneProblem,
    measured_values,
    scene_period,
    with_missing_values,
)

# Luminance, red - blue, and magenta - green. Orthonormal, so that white noise stays white; the three components of a
# scene are nearly independent, those of the colours are not.
_COMPONENTS = ((3**-0.5,) * 3, (2**-0.5, 0.0, -(2**-0.5)), (6**-0.5, -2 * 6**-0.5, 6**-0.5))
# Of the filled values, in units of the noise. With 0.05, the noise level is up to 40 % too low, and images of four
# frames lose 0.5 to 1.3 dB (noise 0.003 and 0.01); 0.01 takes 1.2 to 1.4 times as long for six and eight frames.
_ACCURACY = 0.02


def restore_mosaic(moving: MovingFrames, colours: Tensor, options: ExactOptions) -> Tensor:
    """Colour images (B, groups, 3, scale H, scale W) from mosaics: all frames of a group and all colours together.

    The scene is unknown on a grid of half pixels, and each pixel measures one of its colours. Luminance and two colour
    differences have independent priors, fitted to frames whose missing colours are first interpolated and then
    predicted from the restored scene. ``similar_patches`` removes noise from it, and interpolates the colours of each
    frame where the frames do not determine them, as with one frame.

    ``colours`` are those of the frames. ``noise="auto"`` is estimated from the residual of the frames of a group; that
    of one frame is too low rather than too high.
    """
    # 1. Check the options, and list the frames of each result.
    frames, motion = moving.images, moving.motion
    height, width = frames.shape[-2:]
    check_prior(options.prior, scale=options.scale, mosaic=True)
    groups = joint_groups(frames.shape[1], options.joint)
    # 2. The displacement of each row during its exposure, and the period that it requires.
    displacement, node_weights = motion.exposures
    length = scene_period(motion, width)
    advance = steps(len(frames) * len(groups), "frames")
    images: list[Tensor] = []
    for stack, mosaic in enumerate(frames):
        # 3. The colours of a stack, interpolated where they are not measured, and the level of its noise.
        measured = measures(colours[stack])
        linear = interpolated_colours(mosaic, colours[stack])
        floor = None
        if moving.clipped is not None:
            floor = torch.where(measured & moving.clipped[stack], mosaic, -torch.inf)
            measured = measured & ~moving.clipped[stack]
        if moving.ignore is not None:
            measured = measured & ~moving.ignore[stack]
        if options.noise == "auto":  # of colours whose noise was halved by interpolation
            level = 2 * noise_levels(linear.detach()[None], motion.of([stack])).square().mean().sqrt()
        else:
            level = torch.as_tensor(options.noise, dtype=frames.dtype, device=frames.device)
        level = level.clamp(min=MIN_LEVEL)
        for members, reference in groups:
            # 4. Colours are interpolated first if the frames of a scene do not determine them; this halves their noise.
            part = (linear[members], measured[members], None if floor is None else floor[members], level)
            displacements = displacement[stack, members] - motion.shift[stack, reference]
            if len(members) == 1 or _same_colours(displacements.detach(), node_weights):
                values, pattern = mosaic[members].expand_as(part[0]), measures(colours[stack][:1])[0]
                filled = similar_patches(part[0], values, pattern, level, rounds=8, steps=6)
                part = (filled, torch.ones_like(part[1]), None, level / 2)
            # 5. The observation operator, of three components of the scene, and the scene.
            of_frames, weight = motion.of([stack], members), frames.new_ones(3 * len(members))
            kernels = RowKernels.of_rows(displacements.repeat(3, 1, 1, 1), node_weights, weight, height, points=SCALE)
            observation = Observation(kernels, height, length, frames.dtype, 3)
            along = of_frames.shift[0, :, 0] - motion.shift[stack, reference, 0]
            images.append(_scene(*part, of_frames, observation, along, options))
            advance()
    return torch.stack(images).unflatten(0, (-1, len(groups)))


def _scene(
    images: Tensor,
    known: Tensor,
    floor: Tensor | None,
    level: Tensor,
    motion: FrameMotion,
    observation: Observation,
    along: Tensor,
    options: ExactOptions,
) -> Tensor:
    """Colours (3, scale H, scale W) of the scene of frames (M, 3, H, W), whose colours are ``known`` or interpolated.

    ``floor`` (M, 3, H, W) are lower bounds of saturated colours, else -inf, ``level`` is that of the noise, and
    ``along`` (M,) are px by which the frames are moved along the rows relative to the restored one. An unknown noise
    level is estimated from the residual of the first fit, if there are several frames.
    """
    # 1. Deviations from the mean, extended to the period, and which of them are measured, (3, M, 1, R, L). White noise
    # in place of the data of several frames is a second channel.
    count, width, scale, length = len(images), images.shape[-1], options.scale, observation.period
    mean = images.mean((0, 2, 3))[:, None, None]
    components = images.new_tensor(_COMPONENTS)
    data = extend_rows(images - mean, length).transpose(0, 1)[:, :, None]
    unknown = ~known.transpose(0, 1)[:, :, None]
    measured = measured_values(along.expand(3, -1), unknown, data.shape, width, ends=True)
    noise = torch.randn(data.shape, generator=torch.Generator(data.device).manual_seed(0), device=data.device)
    noise = noise.to(data.dtype) * level * measured

    def problem(colours: Tensor, full: Tensor, level: Tensor, strength: float) -> SceneProblem:
        """The components of colours (3, M, C, R, L), with priors fitted to those of ``full`` frames (M, 3, H, W)."""
        levels, reach = level.expand(1, count), observation.kernels.blur_reach
        parts = torch.einsum("kc,mcrl->kmrl", components, full - mean)
        priors = [fit_polynomial_prior(part[None, :, None], motion, levels, length) for part in parts]
        precision = torch.cat([prior.precision(level.square(), strength, reach) for prior in priors], 2)
        mixed = torch.einsum("kc,cmnrl->kmnrl", components, colours)
        return SceneProblem(mixed, observation, precision, level.expand(3), components)

    # 2. Fit twice, with priors fitted to predicted instead of interpolated colours: 1 to 3 dB for eight frames. The
    # interpolated ones lack detail, so that their prior is too strong: 0.01 instead of 1 gains 2 to 3 dB for eight
    # frames, 1.4 dB for two, 0.1 dB for one (noise 0.002; 0.0 dB at noise 0.01).
    colours = torch.cat([data, noise], 2) if count > 1 else data
    first = problem(colours, images.detach(), level, 0.01 * options.regularisation)
    solver = first.solver(keep=True)
    filled = with_missing_values(first, solver, measured, iterations=12, accuracy=_ACCURACY)
    gain = None
    with torch.no_grad():
        coefficients = solver.fit(filled.data)
        predicted = filled.mixed(observation.A(coefficients))
        full = torch.where(known, images, predicted[:, :, 0, :, :width].transpose(0, 1) + mean)
        if count > 1:
            # the noise of the frames, and of the scene in its units: relative to white noise in place of the data
            residual, unexplained = ((colours - predicted) * measured).unbind(2)
            residual_level = level * (residual.square().sum() / unexplained.square().sum()).sqrt()
            gain = solver.image(coefficients)[:, 1].square().mean().sqrt() / level
            if options.noise == "auto":
                level = residual_level.clamp(min=MIN_LEVEL)
            elif bool(residual_level > 1.5 * level):
                warn_of_restoration(
                    f"the frames differ from their model by {float(residual_level / level):.1f} times the stated "
                    "noise: the vibration is not accurate enough, the scene changes between the frames, or noise "
                    "is too low; colours may be false"
                )
    second = problem(filled.mixed(filled.data)[:, :, :1], full, level, options.regularisation)
    if floor is not None:
        floor = functional.pad(floor - mean, (0, length - width), value=-torch.inf).transpose(0, 1)[:, :, None]
    solver = second.solver(keep=True)
    second = with_missing_values(second, solver, measured, floor, iterations=20, accuracy=_ACCURACY)
    scene = second.mixed(solver.image(solver.fit(second.data)))[:, 0] + mean
    scene = scene[:, :: SCALE // scale, : SCALE * width : SCALE // scale]
    if gain is None:
        return scene
    # 3. Remove the noise that is left; the points of each pixel are four images, one at a time: less memory.
    points = functional.pixel_unshuffle(scene, scale).unflatten(0, (3, -1)).movedim(1, 0).split(1)
    points = [similar_patches(part, part, None, gain * level, rounds=2, steps=2) for part in points]
    return functional.pixel_shuffle(torch.cat(points).movedim(0, 1).flatten(0, 1), scale)


def _same_colours(displacement: Tensor, node_weights: Tensor) -> bool:
    """Whether frames with displacements (M, R, N, 2) px measure the same colour at the same points; with a warning."""
    place = (displacement * node_weights[:, None]).sum(-2)
    same = bool((phase_spread(place, 0.5).median(0).values < 0.1).all())  # at 1/2 cycle per px, the pattern of colours
    if same:
        warn_of_restoration(
            "the frames of a scene measure the same colours at the same points of it: the other colours are "
            "interpolated, as from one frame; restore more vibrating frames jointly"
        )
    return same


_PATCH = 4  # px; 3 px: -0.6 to -1.2 dB, 5 px: -0.3 to +0.1 dB in three times the time
_REACH = 7  # px to the patches that are compared; 10 px: -0.1 to +0.1 dB
_GROUP = 64  # patches; 48 or 96: -0.3 to +0.1 dB
# Variance that every patch has at least, in units of that of the images (1e-4: -0.1 to -0.5 dB), and of the sum of the
# variances of its group, for factors in single precision
_LEAST, _LEAST_OF_GROUP = 1e-5, 1e-6
_REFERENCES = 1024  # at a time: less memory


def similar_patches(
    images: Tensor, values: Tensor, measured: Tensor | None, level: Tensor | float, *, rounds: int, steps: int
) -> Tensor:
    """Colour images (N, C, H, W) whose groups of similar patches are Gaussian, from noisy or missing values.

    Groups are chosen again in each of the ``rounds``, from the images of the round before, and have ``steps`` of
    expectation maximisation. ``values`` have noise of standard deviation ``level``; the mask ``measured`` (C, H, W) has
    the same number at every pixel, and repeats every two rows and columns; None if all are measured.
    """
    if min(images.shape[-2:]) < _PATCH + _REACH:
        return images
    for _ in range(rounds):
        images = _round(images, values, measured, level, steps)
    return images


def _round(images: Tensor, values: Tensor, measured: Tensor | None, level: Tensor | float, steps: int) -> Tensor:
    """Images whose overlapping patches are the means of their posteriors in all groups that contain them."""
    # 1. All patches, as vectors (N patches, n), and the places of the pattern with the values measured at each.
    count, _, height, width = images.shape
    rows, columns = height - _PATCH + 1, width - _PATCH + 1  # of patches
    period = 1 if measured is None else 2
    patches, given = (functional.unfold(part, _PATCH).mT.flatten(0, 1) for part in (images.detach(), values))
    size = patches.shape[-1]
    if measured is None:
        known = torch.arange(size, device=images.device)[None]
    else:
        masks = functional.unfold(measured[None].to(images.dtype), _PATCH)[0].mT.unflatten(0, (rows, columns))
        known = masks[:period, :period].flatten(0, 1).nonzero()[:, 1].view(period**2, -1)
    first = torch.arange(count, device=images.device) * (rows * columns)
    least = (_LEAST * images.detach().var()).clamp(min=1e-20)  # of constant images 0
    # 2. The group of each reference patch, and the posterior of its patches; sums over the groups of a patch.
    total, weight = torch.zeros_like(patches), patches.new_zeros(len(patches))
    starts, places = _references(height, images.device), _references(width, images.device)
    for reference_rows in starts.split(max(1, _REFERENCES // (count * len(places)))):
        group = _similar(images.detach(), reference_rows, places, period)
        group = (group + first[:, None, None, None]).flatten(0, 1)  # (references, phases, patches)
        result = _posterior(patches[group], given[group], known, level, least, steps)
        total = total.index_add(0, group.flatten(), result.flatten(0, -2))
        weight += torch.bincount(group.flatten(), minlength=len(weight))

    # 3. Mean over the groups and over the patches that contain a pixel.
    def joined(parts: Tensor) -> Tensor:
        return functional.fold(parts.unflatten(0, (count, -1)).mT, (height, width), _PATCH)

    return joined(total) / joined(weight[:, None].expand(-1, size))


def _references(size: int, device: torch.device) -> Tensor:
    """First rows or columns of patches that cover ``size`` px, even if it is."""
    starts = torch.arange(0, size - _PATCH + 1, _PATCH, device=device)
    return starts if size % _PATCH == 0 else torch.cat([starts, starts.new_tensor([size - _PATCH])])


def _similar(images: Tensor, starts: Tensor, places: Tensor, period: int) -> Tensor:
    """Numbers (N, references, period^2, patches) of the patches nearest to those at rows and columns of references.

    Patches of each place in a pattern of a period are chosen separately.
    """
    # 1. The rows that contain the references, and the same with their surroundings, infinite outside of the image.
    height, width = images.shape[-2:]
    begin, end = int(starts[0]), int(starts[-1]) + _PATCH
    part = images[..., begin:end, :]
    ends = (max(0, begin - _REACH), min(height, end + _REACH))
    above, below = begin - ends[0], ends[1] - end
    wide = functional.pad(
        images[..., ends[0] : ends[1], :], (_REACH, _REACH, _REACH - above, _REACH - below), value=torch.inf
    )
    # 2. For each place in the pattern, the distances of the patches at all moves that lead to it, and the nearest ones.
    numbers = []
    for phase in product(range(period), repeat=2):
        moves = [
            move
            for move in product(range(-_REACH, _REACH + 1), repeat=2)
            if all((step - place) % period == 0 for step, place in zip(move, phase, strict=True))
        ]
        distances = []
        for down, right in moves:
            top, left = _REACH + down, _REACH + right
            shifted = wide[..., top : top + part.shape[-2], left : left + width]
            difference = (shifted - part).square().sum(-3)
            distance = functional.avg_pool2d(difference, _PATCH, stride=1)
            distances.append(distance[..., starts - begin, :][..., places].flatten(1))
        nearest = torch.stack(distances, -1).topk(_GROUP // period**2, dim=-1, largest=False).indices
        move = torch.tensor(moves, device=images.device)[nearest]  # (N, references, patches, 2)
        base = torch.cartesian_prod(starts, places)
        place = base[:, None] + move
        numbers.append(place[..., 0] * (width - _PATCH + 1) + place[..., 1])
    return torch.stack(numbers, dim=2)


def _posterior(
    patches: Tensor, values: Tensor, known: Tensor, level: Tensor | float, least: Tensor, steps: int
) -> Tensor:
    """Patches (G, Q, k, n) of G groups, of which the values ``known`` (Q, m) are measured at each place Q."""
    groups, phases, count, size = patches.shape
    values = values.gather(-1, known[:, None].expand(groups, phases, count, -1))
    unknown = patches.new_zeros(size, size)
    result = patches
    for step in range(steps):
        mean, covariance, factor, gain = _model(result, unknown, known, level, least)
        with torch.set_grad_enabled(torch.is_grad_enabled() and step == steps - 1):
            innovation = (values - mean[:, known][:, :, None]).mT
            innovation = torch.linalg.solve_triangular(factor, innovation, upper=False)
            result = mean[:, None, None] + innovation.mT @ gain
        rows = gain.flatten(1, 2)
        unknown = covariance - rows.mT @ rows / phases
    return result


@torch.no_grad()
def _model(
    patches: Tensor, unknown: Tensor, known: Tensor, level: Tensor | float, least: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mean (G, n) and covariance C (G, n, n) of groups, L of A C A' + s^2 = L L' and L^-1 A C for each place."""
    groups, phases, count, _ = patches.shape
    mean = patches.mean((1, 2))
    deviation = (patches - mean[:, None, None]).flatten(1, 2)
    covariance = deviation.mT @ deviation / (phases * count) + unknown
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    variance.add_(least + _LEAST_OF_GROUP * variance.sum(-1, keepdim=True))
    rows = covariance[:, known]  # (G, Q, m, n)
    square = rows.gather(-1, known[:, None].expand(groups, phases, known.shape[-1], -1))
    square.diagonal(dim1=-2, dim2=-1).add_(level**2)
    factor = torch.linalg.cholesky(square)
    return mean, covariance, factor, torch.linalg.solve_triangular(factor, rows, upper=False)
