"""A fit of tones linearised at its parameters, for errors of variance 1: how further effects change the parameters.

With the whitened Jacobian X of the free parameters, an effect of response Z and size v changes them by ``-X^+ Z v`` to
first order. An uncertainty C of v adds ``X^+ Z C (X^+ Z)^T`` to their covariance.

x and y of a row are nearly independent, and each axis is a problem of its own. With roll and zoom, the components of a
row are strongly correlated, and X contains the parameters of all axes: the displacement along x of all rows determines
roll as well.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements, cholesky_root
from rsvib_torch.detection.tones.fit import ToneFit, axis_jacobian, residual_of

__all__ = ["LinearisedFit"]


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """The linearised problem of one axis, or of all together.

    Attributes:
        axis: The axis of interest.
        axes: The A axes of the problem.
        root: (B, N, A, A) from px to standard deviations.
        jacobian: X (B, D, A M), D = N G A.
        inverse: X^+ (B, A M, D).
        residual: (B, D) of the fit.
        to_all: (P, M), from the free parameters of an axis to all.
    """

    axis: int
    axes: list[int]
    root: Tensor
    jacobian: Tensor
    inverse: Tensor
    residual: Tensor
    to_all: Tensor

    @classmethod
    def of_each_axis(cls, measurements: Measurements, fit: ToneFit) -> "list[LinearisedFit]":
        """The problem that contains each axis."""
        every = list(range(fit.coefficients.shape[1]))
        if len(every) == 2:
            return [cls._of(measurements, fit, [axis]) for axis in every]
        together = cls._of(measurements, fit, every)
        return [replace(together, axis=axis) for axis in every]

    @classmethod
    def _of(cls, measurements: Measurements, fit: ToneFit, axes: list[int]) -> "LinearisedFit":
        """The problem of some axes."""
        residual = residual_of(measurements, fit)[..., axes]
        jacobians, constraints = zip(*(axis_jacobian(measurements, fit, one) for one in axes), strict=True)
        jacobian = torch.stack(jacobians, 3)  # (B, N, G, A, M)
        spent = (jacobian.square().amax((1, 2)) > 0).sum((1, 2))
        spare = (measurements.num_measurements[:, axes].sum(1) - spent).clamp(min=1.0)
        one = measurements.inverse_variances[..., axes, None] if len(axes) == 1 else measurements.information
        root = cholesky_root(one)
        whitened = (root[:, :, None] @ residual[..., None]).flatten(1)
        deviation = (whitened.square().sum(1) / spare).clamp(min=1e-300).sqrt()[:, None, None, None]
        root = root / deviation
        X = (root[:, :, None, :, :, None] * jacobian[..., None, :, :]).flatten(-2).flatten(1, 3)
        return cls(axes[0], axes, root, X, torch.linalg.pinv(X), whitened / deviation[:, :, 0, 0], constraints[0])

    @property
    def row(self) -> int:
        """Place of the axis of interest among those of the problem."""
        return self.axes.index(self.axis)

    @property
    def rounding(self) -> Tensor:
        """(B,) error of the squared norm of whitened responses of about 1 px, for displacements without noise."""
        return 1e-12 * self.root[..., self.row].square().sum((1, 2))

    def unexplained(self, response: Tensor) -> tuple[Tensor, Tensor]:
        """Part of a response that the parameters do not explain, and the change of the parameters by it.

        Args:
            response: (B, N, G, Q) displacements of the axis in px by unit effects.

        Returns:
            Whitened responses (B, D, Q) and ``X^+ Z`` (B, A M, Q).
        """
        Z = (self.root[..., self.row][:, :, None, :, None] * response[:, :, :, None]).flatten(1, 3)
        change = self.inverse @ Z
        return Z - self.jacobian @ change, change

    def add_covariance(self, total: Tensor, added: Tensor) -> None:
        """Add a covariance (B, A M, A M) of the free parameters to that of all of a fit (B, A' P, A' P), in place."""
        count = len(self.axes)
        blocks = added.unflatten(-1, (count, -1)).unflatten(1, (count, -1))
        blocks = torch.einsum("pm,bimjn,qn->bipjq", self.to_all, blocks, self.to_all)
        size = len(self.to_all)
        of_parameters = total.view(len(total), total.shape[-1] // size, size, -1, size)
        for row, first in enumerate(self.axes):
            for column, second in enumerate(self.axes):
                of_parameters[:, first, :, second] += blocks[:, row, :, column]

    def add_change(self, total: Tensor, change: Tensor) -> None:
        """Add a change (B, A M) of the free parameters to that of all of a fit (B, A', P), in place."""
        total[:, self.axes] += change.unflatten(-1, (len(self.axes), -1)) @ self.to_all.T
