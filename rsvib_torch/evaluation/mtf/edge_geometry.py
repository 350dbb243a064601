"""Where the edge of a ROI lies: a fit of edge, blur and shaded sides to all pixels."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.evaluation.mtf.edge_model import edge_spread

__all__ = ["EdgeFit", "Scatter", "fit_edge", "linearised", "moved", "start_edge", "straighten"]

ORDER = 3  # of the polynomial that the edge follows
_STEPS = 60
_CONVERGED = 1e-24  # of the variance, in the last step
_SIGMAS = (0.05, 60.0)  # px
_PIXEL_VARIANCE = 1 / 12


@dataclass(frozen=True)
class Scatter:
    """Pixels (N,) of a ROI turned so that the edge is near-vertical and brightens to the right.

    Attributes:
        value: Grey values.
        x: Columns from the middle of the ROI, px.
        y: Rows from the middle of the ROI, px.
        half: Half width and half height of the ROI in px.
    """

    value: Tensor
    x: Tensor
    y: Tensor
    half: tuple[float, float]

    def basis(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Polynomials (..., ORDER + 1) along the edge, and their slopes per px."""
        u = y / self.half[1]
        values = torch.stack([torch.ones_like(u), u, 1.5 * u**2 - 0.5, 2.5 * u**3 - 1.5 * u], dim=-1)
        slopes = torch.stack([torch.zeros_like(u), torch.ones_like(u), 3 * u, 7.5 * u**2 - 1.5], dim=-1)
        return values, slopes / self.half[1]


@dataclass(frozen=True)
class EdgeFit:
    """Parameters of edge, blur and sides.

    Attributes:
        line: (4,) coefficients of the edge's column as polynomial of the row, px.
        sigma: () blur of the optics if it were Gaussian, px.
        sides: (2, 3) dark and bright side: value in the middle, slopes to the right and down per half ROI.
    """

    line: Tensor
    sigma: Tensor
    sides: Tensor

    @property
    def contrast(self) -> Tensor:
        """Bright minus dark in the middle of the ROI."""
        return self.sides[1, 0] - self.sides[0, 0]

    @property
    def width(self) -> Tensor:
        """Standard deviation of the line spread function in px."""
        return (self.sigma.square() + _PIXEL_VARIANCE).sqrt()

    def slope(self, scatter: Scatter) -> Tensor:
        """Columns per row in the middle of the edge."""
        return (scatter.basis(scatter.y.new_zeros(()))[1] * self.line).sum()

    def distance(self, scatter: Scatter) -> tuple[Tensor, Tensor]:
        """Distance of every pixel along the normal, and its derivatives (N, 4) by the line."""
        values, slopes = scatter.basis(scatter.y)
        slope = slopes @ self.line
        aside = scatter.x - values @ self.line
        cosine = torch.rsqrt(1 + slope.square())
        derivative = -values * cosine[:, None] - slopes * (aside * slope * cosine**3)[:, None]
        return aside * cosine, derivative

    def planes(self, scatter: Scatter) -> tuple[Tensor, Tensor]:
        """Values (N, 2) of dark and bright side at every pixel, and the regressors (N, 3) they are made of."""
        ones = torch.ones_like(scatter.x)
        regressors = torch.stack([ones, scatter.x / scatter.half[0], scatter.y / scatter.half[1]], dim=-1)
        return regressors @ self.sides.T, regressors


def straighten(roi: Tensor) -> tuple[Scatter, int, bool, bool]:
    """Turn a ROI so that its edge is near-vertical and brightens to the right.

    Returns:
        The pixels, the columns of the turned ROI, whether the edge was near-vertical to begin with, and whether the
        turned ROI was mirrored.
    """
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
    return Scatter(roi.flatten(), x.flatten(), y.flatten(), half), width, near_vertical, mirrored


def start_edge(scatter: Scatter, columns: int) -> EdgeFit:
    """Edge from the area under every row, which no noise misleads far."""
    image = scatter.value.view(-1, columns)
    few = max(2, columns // 12)
    low, high = image[:, :few].mean(), image[:, -few:].mean()
    filled = ((high - image) / (high - low)).mean(1) * columns  # columns of the row that are dark
    basis = scatter.basis(scatter.y.view(-1, columns)[:, 0])[0][:, :2]
    line = torch.linalg.lstsq(basis, (filled - 0.5 * columns)[:, None]).solution[:, 0]
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
    sigma = (fit.sigma * step[4].clamp(-1.0, 1.0).exp()).clamp(*_SIGMAS)
    return EdgeFit(fit.line + step[:4], sigma, fit.sides + step[5:].view(2, 3))


def fit_edge(scatter: Scatter, fit: EdgeFit) -> EdgeFit:
    """Least-squares fit of edge, Gaussian blur and sides to all pixels (Levenberg-Marquardt), from a start."""
    damping = 1e-3
    model, jacobian, _ = linearised(fit, scatter)
    residual = scatter.value - model
    loss = residual.square().sum()
    size = scatter.value.var() * len(scatter.value)
    for _ in range(_STEPS):
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
            if bool((step.square() * scale).sum() < _CONVERGED * size):
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return fit
