"""Edge of a ROI: model of a blurred edge, its fit to all pixels, and checks that it can be measured."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


def edge_spread(distance: Tensor, sigma: Tensor, slope: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Edge and line spread function of Gaussian optics and square pixels, and the derivative of the first by sigma.

    The pixel, projected on the normal of the edge, is the convolution of two boxes, as wide as the cosine and the sine
    of the edge's angle. With the error function of the optics it is a second difference of its second integral, ``J(x)
    = ((x^2 + sigma^2) Phi(x / sigma) + sigma x phi(x / sigma)) / 2``. Distances are in px along the normal, positive on
    the bright side; ``slope`` is the tangent of the angle between edge and pixel.
    """
    cosine = torch.rsqrt(1 + slope.square())
    wide, narrow = 0.5 * cosine, 0.5 * cosine * slope.abs()
    # evaluated on the dark side: on the bright side, differences of large numbers lose precision
    outside = -distance.abs()
    value, first, second = (torch.zeros_like(distance) for _ in range(3))
    for shift, sign in ((wide + narrow, 1), (wide - narrow, -1), (narrow - wide, -1), (-wide - narrow, 1)):
        x = outside + shift
        density = torch.exp(-0.5 * (x / sigma).square()) / math.sqrt(2 * math.pi)
        below = 0.5 * torch.special.erfc(x / (-math.sqrt(2.0) * sigma))
        value += sign * 0.5 * ((x.square() + sigma.square()) * below + sigma * x * density)
        first += sign * (x * below + sigma * density)
        second += sign * below
    scale = 1 / (4 * wide * narrow)
    value, first, second = scale * value, scale * first, scale * sigma * second
    bright = distance > 0
    return torch.where(bright, 1 - value, value), first, torch.where(bright, -second, second)


# --- Fit ---


@dataclass(frozen=True)
class Scatter:
    """Pixels (N,) of a ROI turned so that the edge is near-vertical and brightens to the right."""

    value: Tensor  # grey values
    x: Tensor  # columns from the middle of the ROI, px
    y: Tensor  # rows from the middle of the ROI, px
    half: tuple[float, float]  # half width and half height of the ROI in px
    columns: int  # of the turned ROI
    near_vertical: bool  # whether the edge was near-vertical before the ROI was turned
    mirrored: bool  # whether the ROI was mirrored

    def basis(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Legendre polynomials (..., 4) along the edge, and their slopes per px."""
        u = y / self.half[1]
        values = torch.stack([torch.ones_like(u), u, 1.5 * u**2 - 0.5, 2.5 * u**3 - 1.5 * u], dim=-1)
        slopes = torch.stack([torch.zeros_like(u), torch.ones_like(u), 3 * u, 7.5 * u**2 - 1.5], dim=-1)
        return values, slopes / self.half[1]


@dataclass(frozen=True)
class EdgeFit:
    """Parameters of edge, blur and sides."""

    line: Tensor  # (4,) coefficients of the edge's column as polynomial of the row, px
    sigma: Tensor  # () Gaussian blur of the optics, px
    sides: Tensor  # (2, 3) dark and bright side: value in the middle, slopes to the right and down per half ROI

    @property
    def contrast(self) -> Tensor:
        """Bright minus dark in the middle of the ROI."""
        return self.sides[1, 0] - self.sides[0, 0]

    @property
    def width(self) -> Tensor:
        """Standard deviation of the line spread function in px."""
        return (self.sigma.square() + 1 / 12).sqrt()  # with the variance of a pixel aperture

    def slope(self, scatter: Scatter) -> Tensor:
        """Columns per row in the middle of the edge."""
        return (scatter.basis(scatter.y.new_zeros(()))[1] * self.line).sum()

    def angle(self, scatter: Scatter) -> float:
        """Degrees between the edge and the nearest image axis in the middle of the edge, positive clockwise."""
        turn = math.degrees(math.atan(float(self.slope(scatter))))
        return turn if scatter.mirrored == scatter.near_vertical else -turn

    def distance(self, scatter: Scatter) -> tuple[Tensor, Tensor]:
        """Distance of every pixel along the normal, and its derivatives (N, 4) by the line."""
        values, slopes = scatter.basis(scatter.y)
        slope = slopes @ self.line
        aside = scatter.x - values @ self.line
        cosine = torch.rsqrt(1 + slope.square())
        derivative = -values * cosine[:, None] - slopes * (aside * slope * cosine**3)[:, None]
        return aside * cosine, derivative

    def planes(self, scatter: Scatter) -> tuple[Tensor, Tensor]:
        """Values (N, 2) of dark and bright side at every pixel, and their regressors (N, 3)."""
        ones = torch.ones_like(scatter.x)
        regressors = torch.stack([ones, scatter.x / scatter.half[0], scatter.y / scatter.half[1]], dim=-1)
        return regressors @ self.sides.T, regressors


# part of the range of the values of a region by which its sides differ at least; otherwise the start of the fit is not
# finite
_LEAST_STEP = 1e-3


def straighten(roi: Tensor) -> Scatter:
    """Turn a ROI so that its edge is near-vertical and brightens to the right."""
    soft = torch.nn.functional.avg_pool2d(roi[None, None], 5, stride=1)[0, 0]
    across, down = soft.diff(dim=1).square().mean(), soft.diff(dim=0).square().mean()
    near_vertical = bool(across >= down)
    if not near_vertical:
        roi = roi.mT
    mirrored = bool(roi[:, : roi.shape[1] // 4 + 1].mean() > roi[:, -(roi.shape[1] // 4 + 1) :].mean())
    if mirrored:
        roi = roi.flip(1)
    height, width = roi.shape
    half = (0.5 * (width - 1), 0.5 * (height - 1))
    x, y = (torch.arange(n, dtype=roi.dtype, device=roi.device) - 0.5 * (n - 1) for n in (width, height))
    x, y = x.expand(height, width), y[:, None].expand(height, width)
    return Scatter(roi.flatten(), x.flatten(), y.flatten(), half, width, near_vertical, mirrored)


def _start_edge(scatter: Scatter) -> EdgeFit:
    """Start of the fit, from the sum of every row: robust to noise."""
    columns = scatter.columns
    image = scatter.value.view(-1, columns)
    few = max(2, columns // 12)
    low, high = image[:, :few].mean(), image[:, -few:].mean()
    if float(high - low) < _LEAST_STEP * float(image.max() - image.min()):
        raise ValueError("no edge: both sides of the roi are equally bright; choose a part with a single edge")
    dark = ((high - image) / (high - low)).mean(1) * columns  # columns of each row
    basis = scatter.basis(scatter.y.view(-1, columns)[:, 0])[0][:, :2]
    line = torch.linalg.lstsq(basis, (dark - 0.5 * columns)[:, None]).solution[:, 0]
    sides = torch.zeros(2, 3, dtype=image.dtype, device=image.device)
    sides[0, 0], sides[1, 0] = low, high
    zero = line.new_zeros(2)
    return EdgeFit(torch.cat([line, zero]), line.new_tensor(1.5), sides)


def linearised(fit: EdgeFit, scatter: Scatter) -> tuple[Tensor, Tensor, Tensor]:
    """Model value (N,), derivatives (N, 11) by line, log sigma and sides, and the distance (N,)."""
    distance, by_line = fit.distance(scatter)
    esf, lsf, by_sigma = edge_spread(distance, fit.sigma, fit.slope(scatter))
    planes, regressors = fit.planes(scatter)
    step = planes[:, 1] - planes[:, 0]
    jacobian = torch.cat(
        [
            (step * lsf)[:, None] * by_line,
            (step * by_sigma * fit.sigma)[:, None],
            (1 - esf)[:, None] * regressors,
            esf[:, None] * regressors,
        ],
        dim=1,
    )
    return planes[:, 0] + step * esf, jacobian, distance


def moved(fit: EdgeFit, step: Tensor) -> EdgeFit:
    """The fit after a step of its 11 parameters."""
    sigma = (fit.sigma * step[4].clamp(-1.0, 1.0).exp()).clamp(0.05, 60.0)  # px
    return EdgeFit(fit.line + step[:4], sigma, fit.sides + step[5:].view(2, 3))


def fit_edge(scatter: Scatter) -> EdgeFit:
    """Least-squares fit of edge, Gaussian blur and sides to all pixels (Levenberg-Marquardt)."""
    fit = _start_edge(scatter)
    damping = 1e-3
    model, jacobian, _ = linearised(fit, scatter)
    residual = scatter.value - model
    loss = residual.square().sum()
    size = scatter.value.var() * len(scatter.value)
    for _ in range(60):
        normal = jacobian.T @ jacobian
        scale = normal.diagonal().clamp(min=1e-12 * float(normal.diagonal().max()))
        step = torch.linalg.solve(normal + torch.diag(damping * scale), jacobian.T @ residual)
        trial = moved(fit, step)
        model, trial_jacobian, _ = linearised(trial, scatter)
        trial_residual = scatter.value - model
        trial_loss = trial_residual.square().sum()
        if bool(trial_loss <= loss):
            fit, jacobian, residual, loss = trial, trial_jacobian, trial_residual, trial_loss
            damping = max(0.1 * damping, 1e-12)
            if bool((step.square() * scale).sum() < 1e-24 * size):
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return fit


# --- Checks ---


def check_roi(roi: Tensor) -> Tensor:
    """The ROI in float64 after checks of its shape and values."""
    if roi.dtype == torch.bool or roi.dtype.is_complex:
        raise TypeError(f"roi must hold real numbers, got {roi.dtype}")
    if roi.ndim != 2:
        raise ValueError(f"roi must be one grey image (h, w), got shape {tuple(roi.shape)}")
    if min(roi.shape) < 16:
        raise ValueError(f"roi must be at least 16 x 16 px, got {roi.shape[0]} x {roi.shape[1]}")
    values = roi.detach().to(torch.float64)
    invalid = int((~torch.isfinite(values)).sum())
    if invalid:
        raise ValueError(f"roi must be finite, got {invalid} pixels that are NaN or infinite")
    if float(values.max() - values.min()) <= 1e-9 * float(values.abs().max()):
        raise ValueError(f"roi shows no edge: all pixels are {float(values[0, 0]):g}")
    return values


def check_edge(fit: EdgeFit, scatter: Scatter, limits: tuple[float, float]) -> float:
    """Raise if the ROI does not contain one measurable slanted edge, of values within ``limits``.

    The result is the smallest distance in px between the edge and a border of the turned ROI beside it.
    """
    model, _, distance = linearised(fit, scatter)
    residual = scatter.value - model
    explained = 1 - float(residual.var() / scatter.value.var())
    if not explained >= 0.5 or not float(fit.contrast) > 0:
        raise ValueError(
            f"roi shows no edge: a straight edge explains {100 * max(explained, 0.0):.0f} % of the variance, "
            "expected at least 50 %"
        )
    slope = abs(float(fit.slope(scatter)))
    angle = math.degrees(math.atan(slope))
    if not 2.0 <= angle <= 40.0:
        problem = "not slanted enough" if angle < 2.0 else "too close to 45 degrees"
        raise ValueError(f"the edge is {problem}: {angle:.2f} degrees from the nearest image axis, expected 2 ... 40")
    rows = len(scatter.value) // scatter.columns
    if slope * rows < 1:
        raise ValueError(
            f"the edge crosses {slope * rows:.2f} px over {rows} px of length, expected at least 1: "
            "use a longer roi or a larger angle"
        )
    rays = distance.view(rows, scatter.columns)
    room = float(torch.minimum(-rays[:, 0].max(), rays[:, -1].min()))
    wanted = max(4.0, 3.0 * float(fit.width))
    if room < wanted:
        raise ValueError(
            f"the edge comes within {max(room, 0.0):.1f} px of the border of the roi, expected at least {wanted:.1f} px"
        )
    _check_clipping(fit, scatter, distance, limits)
    patches, noise = uneven_patches(fit, scatter)
    worst, contrast = float(patches.max()), float(fit.contrast)
    if worst > 0.1 * contrast + 6 * noise:
        row, column = divmod(int(patches.argmax()), patches.shape[1])
        raise ValueError(
            f"roi shows more than one edge: {100 * worst / contrast:.0f} % of its contrast near "
            f"{row + 2} px along and {column + 2} px across the edge, expected even sides"
        )
    return room


def uneven_patches(fit: EdgeFit, scatter: Scatter) -> tuple[Tensor, float]:
    """Absolute mean residual of the sides in patches of 5 x 5 px, and its standard deviation from noise."""
    model, _, distance = linearised(fit, scatter)
    beside = distance.abs() > 4 * fit.width + 2
    outside = torch.where(beside, scatter.value - model, 0.0).view(-1, scatter.columns)
    patches = torch.nn.functional.avg_pool2d(outside[None, None], 5, stride=1)[0, 0].abs()
    steps = (scatter.value - model).view(-1, scatter.columns).diff(dim=1).abs()
    # 0.954: median absolute difference of two standard normal numbers
    return patches, float(steps.median()) / 0.954 / 5


def _check_clipping(fit: EdgeFit, scatter: Scatter, distance: Tensor, limits: tuple[float, float]) -> None:
    """Raise if a tenth of the pixels of a side have one extreme value although noise would exceed it."""
    far = distance.abs() > 4 * fit.width
    sides = [scatter.value[(distance < 0) & far], scatter.value[(distance > 0) & far]]
    if min(len(side) for side in sides) == 0:
        return
    extremes = [float(scatter.value.min()), float(scatter.value.max())]
    shares = [float((side == value).double().mean()) for side, value in zip(sides, extremes, strict=True)]
    least_noise = 1e-3 * float(fit.contrast)
    for index, name in enumerate(("dark", "bright")):
        value, share, other = extremes[index], shares[index], sides[1 - index]
        at_limit = value <= limits[0] if index == 0 else value >= limits[1]
        has_noise = float((sides[index] - value).square().mean().sqrt()) > least_noise
        only_this = shares[1 - index] < 0.1 * share and float(other.std()) > least_noise
        is_black = index == 0 and at_limit  # without light there is no noise
        if share >= 0.1 and ((at_limit and has_noise) or (only_this and not is_black)):
            raise ValueError(
                f"the {name} side of the edge is clipped: {100 * share:.0f} % of its pixels are exactly {value:g}"
            )
