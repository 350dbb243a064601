"""Angular rates that a gyroscope recorded, and the rotations between two times that follow from them."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.interpolate import CubicSpline, PPoly
from scipy.spatial.transform import Rotation
from torch import Tensor

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import check_number
from rsvib_torch.files.number_table import MAX_SAMPLES
from rsvib_torch.motion.spline import check_increasing
from rsvib_torch.numerics.tables import Array
from rsvib_torch.results.presentation import Result
from rsvib_torch.text import quoted, text_table


@dataclass(frozen=True, eq=False, repr=False)
class AngularRates(Result, units={"times": "s", "rates": "rad/s"}, shapes={"times": "N", "rates": "N 3"}):
    """Angular rates of a gyroscope about its three axes, in rad/s.

    Attributes:
        times: (N,) float64 s, on the clock of the gyroscope, increasing.
        rates: (N, 3) float64 rad/s, right-handed about the axes x, y, z of the gyroscope.
        source: File and format that they were read from; empty if they were not read.

    Raises:
        ValueError: If there are fewer than 4 samples, a value is not finite, or times do not increase.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> times = torch.arange(100, dtype=torch.float64) / 400
        >>> rates = torch.stack([torch.zeros_like(times), torch.full_like(times, 0.2), torch.zeros_like(times)], -1)
        >>> recorded = rsv.AngularRates(times, rates)
        >>> recorded.rotation(torch.tensor([0.1]), torch.tensor([0.15])).round(decimals=6).tolist()  # rad
        [[0.0, 0.01, 0.0]]
    """

    times: Tensor
    rates: Tensor
    source: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        times, rates = self.times.detach(), self.rates.detach()
        if not 4 <= len(times) <= MAX_SAMPLES:
            raise ValueError(f"times must have 4 to {MAX_SAMPLES:,} samples, got {len(times)}")
        if not bool(torch.isfinite(times).all() and torch.isfinite(rates).all()):
            raise ValueError("times and rates must be finite")
        check_increasing(times.cpu().numpy())
        object.__setattr__(self, "times", times.to(torch.float64))
        object.__setattr__(self, "rates", rates.to(torch.float64))

    @property
    def start(self) -> float:
        """Time of the first sample in seconds."""
        return float(self.times[0])

    @property
    def end(self) -> float:
        """Time of the last sample in seconds."""
        return float(self.times[-1])

    @property
    def sample_rate(self) -> float:
        """Samples per second (median)."""
        return 1.0 / float(self.times.diff().median())

    @cached_property
    def noise(self) -> Tensor:
        """(3,) rad/s, standard deviation of white noise of the rates, from differences of order 6 of samples.

        The differences of white noise have the variance 924, the binomial coefficient of 12 over 6.
        """
        order = min(6, len(self.times) - 1)
        scatter = self.rates.diff(n=order, dim=0).abs().median(0).values
        return 1.4826 * scatter / math.comb(2 * order, order) ** 0.5

    def summary(self) -> str:
        """Duration, sample rate, mean and standard deviation of the rates."""
        head = f"{len(self.times)} samples at {self.sample_rate:.5g} Hz, {self.start:.6g} … {self.end:.6g} s"
        mean, spread = self.rates.mean(0).tolist(), self.rates.std(0).tolist()
        table = text_table(
            ["axis", "mean (rad/s)", "standard deviation (rad/s)"],
            [[name, f"{mean[k]:.4g}", f"{spread[k]:.4g}"] for k, name in enumerate("xyz")],
        )
        return "\n".join([head, table, *([self.source] if self.source else [])])

    @cached_property
    def _integrals(self) -> tuple[PPoly, PPoly]:
        """Integrals of the rates, and of (integral x rates), as splines of the time."""
        times, rates = self.times.cpu().numpy(), self.rates.cpu().numpy()
        angle = CubicSpline(times, rates).antiderivative()
        return angle, CubicSpline(times, np.cross(angle(times), rates)).antiderivative()

    @checks_arguments
    def rotation(self, start: Tensor, end: Tensor) -> Tensor:
        """Rotation vectors (S, 3) in rad of the gyroscope from times ``start`` (S) to ``end`` (S) in s.

        The rates are about axes that rotate themselves. To second order (Magnus), the vector is ``a(end) - a(start) +
        1/2 integral (a(t) - a(start)) x rate(t) dt`` with the integral a of the rates, a cubic spline; the error is of
        third order in the rotation. Beyond the record the end pieces of the spline continue.
        """
        angle, area = self._integrals
        first, last = start.detach().cpu().numpy(), end.detach().cpu().numpy()
        before: Array = angle(first)
        turned = angle(last) - before
        vector = turned + 0.5 * (area(last) - area(first) - np.cross(before, turned))
        return torch.from_numpy(vector).to(start.device)

    def attitude(self, reference: float) -> Tensor:
        """(N, 3) rad, rotation vectors from the attitude at time ``reference`` to that at each sample.

        Rotations from sample to sample are composed without approximation.
        """
        reference = check_number("reference", reference)
        steps = Rotation.from_rotvec(self.rotation(self.times[:-1], self.times[1:]).cpu().numpy())
        turned = _running_product(np.concatenate([[[0.0, 0.0, 0.0, 1.0]], steps.as_quat()]))
        nearest = int((self.times - reference).abs().argmin())
        at = self.times.new_tensor([reference])
        within = Rotation.from_rotvec(self.rotation(self.times[nearest : nearest + 1], at).cpu().numpy()[0])
        origin = Rotation.from_quat(turned[nearest]) * within
        vectors = (origin.inv() * Rotation.from_quat(turned)).as_rotvec()
        return torch.from_numpy(vectors).to(self.times.device)


def _running_product(quaternions: Array) -> Array:
    """Products (N, 4) of the first 1 ... N rotations (scalar last), in log2 N steps of a parallel prefix scan."""
    reach = 1
    while reach < len(quaternions):
        later = Rotation.from_quat(quaternions[:-reach]) * Rotation.from_quat(quaternions[reach:])
        quaternions = np.concatenate([quaternions[:reach], later.as_quat()])
        reach *= 2
    return quaternions


def orientation_matrix(name: str) -> Tensor:
    """(3, 3) matrix from rates about the axes of the gyroscope to those about the axes of the camera, e.g. "YxZ"."""
    if sorted(name.lower()) != ["x", "y", "z"]:
        raise ValueError(
            f"orientation must have x, y and z once each, a small letter for a negative axis, got {quoted(name)}"
        )
    matrix = torch.zeros(3, 3, dtype=torch.float64, device="cpu")
    for row, letter in enumerate(name):
        matrix[row, "xyz".index(letter.lower())] = 1.0 if letter.isupper() else -1.0
    return matrix
