"""Displacements of scene rows between frames: the input of all fits, independent of images.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rsvib_torch.numerics.tables import Array, median, split_axis, take_stacks, valid_mean, without_nan

# rows; rough fits choose among the peaks of a periodogram, and fits to all rows follow. Ten records of 24 to 48 frames
# have the same tones, to 0.03 standard deviations, as with all rows in rough fits, and take 0.84 of the time
_ROUGH_ROWS = 256


@dataclass(frozen=True, eq=False)
class Measurements:
    """Displacements of scene rows in the frames of a batch of stacks, in row order.

    Every scene row n is measured in a group of G frames (two of them give an offset). The position of the scene itself
    is unknown, so only differences within a group are measured: the mean over the group is subtracted from the
    displacements, and from every model that is compared with them. With roll and zoom, displacements have three or four
    components instead of two, those of ``displacement_at`` times a length in px (``detection.start``).
    """

    exposure_starts: Array  # (B, N, G) float64 s, exposure start of the row of each frame that contains scene row n
    # (B, N, G, 2) float64 px, axes (x, y), with zero mean over the frames that contain the row; 0 in other frames
    displacements: Array
    visible: Array  # (B, N, G) float64, 1 where a frame contains the row, else 0
    # (B, N, 2, 2) float64 px^-2, inverse covariance of the displacement in one frame up to a common factor; 0 where
    # nothing was measured
    information: Array
    exposure_time: float  # T_e in seconds
    # duration over which each displacement (x, y) is an average: rows of a band times the row time. Roll and zoom
    # have that of x
    average_times: tuple[float, float] = (0.0, 0.0)
    # fraction of the measurements that are independent (bands may overlap), one for all stacks or (B,)
    independent: float | Array = 1.0
    # groups of frames whose rows follow each other: rows N / groups apart show the same part of the scene
    groups: int = 1

    @cached_property
    def _mean_weights(self) -> Array:
        """(B, N, G) weights of the mean over the frames that contain a row."""
        return self.visible / np.maximum(self.visible.sum(2, keepdims=True), 1.0)

    @cached_property
    def span(self) -> Array:
        """(B,) seconds from the first to the last exposure start of the record."""
        return self.exposure_starts.max((1, 2)) - self.exposure_starts.min((1, 2))

    @cached_property
    def centre(self) -> Array:
        """(B,) mid-time of the record in seconds: phases are fitted there, where they depend least on frequency."""
        return 0.5 * (self.exposure_starts.min((1, 2)) + self.exposure_starts.max((1, 2)) + self.exposure_time)

    @cached_property
    def middles(self) -> Array:
        """(B, N, G, 1, 1) mid-exposures in seconds from the centre of the record."""
        return (self.exposure_starts + (0.5 * self.exposure_time - self.centre)[:, None, None])[..., None, None]

    @cached_property
    def smearing_times(self) -> Array:
        """(2, 1, A, 1) seconds over which displacements are averages: the exposure, the rows of a band."""
        axes = self.displacements.shape[-1]
        along, across = self.average_times
        return np.array([[self.exposure_time] * axes, [along, across, along, along][:axes]])[:, None, :, None]

    @cached_property
    def drifts(self) -> Array:
        """(B, N, G, 1 or A, 2) relative displacements by drifts t and t^2 / 2 from the centre, mean over exposures."""
        time = self.middles[..., 0]
        return self.relative(np.stack([time, 0.5 * np.square(time) + self.exposure_time**2 / 24.0], -1))

    @property
    def duration(self) -> Array:
        """(B,) seconds from the first to the last row of the record, in any frame but the last of a group."""
        first = self.exposure_starts.min(-1)
        return first.max(1) - first.min(1)

    @property
    def interval(self) -> Array:
        """(B,) mean seconds between the first two frames of a group."""
        return (self.exposure_starts[:, :, 1] - self.exposure_starts[:, :, 0]).mean(1)

    @property
    def weights(self) -> Array:
        """(B, N, 2) information of each axis alone."""
        return self.information.diagonal(axis1=-2, axis2=-1)

    @cached_property
    def root(self) -> Array:
        """(B, N, 2, 2) upper triangular R with ``W = R^T R``, W the information."""
        return cholesky_root(self.information)

    @cached_property
    def inverse_variances(self) -> Array:
        """(B, N, 2) inverse variance ``1 / (W^-1)_aa`` of the displacement of each axis, W the information."""
        axes = self.information.shape[-1]
        # the last pivot of a Cholesky factor belongs to an axis that is conditioned on none
        orders = [[*(other_axis for other_axis in range(axes) if other_axis != axis), axis] for axis in range(axes)]
        reordered = np.stack([self.information[..., order, :][..., order] for order in orders], 2)
        return np.square(cholesky_root(reordered)[..., -1, -1])

    @property
    def _expected(self) -> Array:
        """(B, N, A) inverse variances that residuals are compared with; x determines roll, but hardly y, of a row."""
        return self.weights if self.information.shape[-1] == 2 else self.inverse_variances

    @property
    def num_differences(self) -> Array:
        """(B, N) independent differences within each group: one less than the frames that contain the row."""
        return np.maximum(self.visible.sum(-1) - 1, 0.0)

    @property
    def num_measurements(self) -> Array:
        """(B, 2) number of independent measurements of each axis."""
        count = ((self.weights > 0) * self.num_differences[..., None]).sum(1)
        return count * np.asarray(self.independent)[..., None]

    def repeated(self, count: int) -> "Measurements":
        """Every stack ``count`` times in a row."""
        return take_stacks([self], np.arange(len(self.exposure_starts)).repeat(count))

    def of_rows(self, rows: slice | Array) -> "Measurements":
        """The measurements of some rows."""
        names = ("exposure_starts", "displacements", "visible", "information")
        return replace(self, **{name: getattr(self, name)[:, rows] for name in names})

    def thinned(self) -> "Measurements":
        """Every n-th row, at least ``_ROUGH_ROWS``, for rough fits; short records as they are."""
        step = self.visible.shape[1] // _ROUGH_ROWS
        return self.of_rows(slice(None, None, step)) if step > 1 else self

    def of_axis(self, axis: int) -> "Measurements":
        """The measurements of one axis by itself."""
        return replace(
            self,
            displacements=self.displacements[..., axis : axis + 1],
            information=self.inverse_variances[..., axis, None, None],
            average_times=(self.average_times[axis % 2 if axis < 2 else 0],) * 2,
        )

    def scaled(self, factor: Array) -> "Measurements":
        """The measurements with their information multiplied by factors (B, N, 2) of each axis."""
        root = np.sqrt(factor)
        # cached values are kept if they depend on times only
        result = copy(self)
        object.__setattr__(result, "information", self.information * root[..., :, None] * root[..., None, :])
        for name in ("root", "inverse_variances"):
            result.__dict__.pop(name, None)
        return result

    def relative(self, values: Array) -> Array:
        """Values (B, N, G, ...) less their mean over the frames that contain the row; 0 in the other frames."""
        mean = np.einsum("bng,bng...->bn...", self._mean_weights, values)  # over the frames g
        relative: Array = values - mean[:, :, None]
        relative *= self.visible.reshape(*self.visible.shape, *(1,) * (values.ndim - 3))
        return relative

    # Residuals of a fit, (B, N, G, 2) px

    def square(self, residual: Array) -> Array:
        """(B, 2) sum of the squared residuals of each axis over their variance."""
        return np.einsum("bnga,bna->ba", np.square(residual), self.inverse_variances)

    def sizes(self, residual: Array) -> Array:
        """(B, N, 2) rms residual of each row in standard deviations; NaN where nothing was measured."""
        return self.distances(residual) * np.sqrt(self._expected)

    def distances(self, residual: Array) -> Array:
        """(B, N, 2) rms residual of each row in px; NaN where nothing was measured."""
        return np.sqrt(self._squares(residual))

    def _squares(self, residual: Array) -> Array:
        """(B, N, 2) px^2, mean square of the residuals of each row; NaN where nothing was measured."""
        differences = self.num_differences[..., None]
        measured = (self.weights > 0) & (differences > 0)
        return np.where(measured, np.square(residual).sum(2) / np.maximum(differences, 1.0), np.nan)

    def unexplained(self, residual: Array) -> Array:
        """(B, 2) px, rms residual without the part that is explained by noise."""
        excess = self._squares(residual) - 1 / np.maximum(self._expected, 1e-300)
        return np.sqrt(np.maximum(trimmed_mean(excess), 0.0))

    def correlated(self, residual: Array) -> Array:
        """(B, 2) px, root of the weighted mean product of the residuals of neighbouring rows.

        Noise is independent from row to row and does not contribute; an unmodelled motion, and a wrong timing, displace
        neighbouring rows alike. Rows with clouds have a small weight. 0 if the mean is not significant (95 %).
        """
        weight = self.weights[:, 1:] * self.weights[:, :-1]
        product = (residual[:, 1:] * residual[:, :-1]).sum(2) / np.maximum(self.num_differences[:, 1:, None], 1.0)
        total, deviation = (weight * product).sum(1), np.sqrt(np.square(weight * product).sum(1))
        return np.sqrt(np.where(total > 1.645 * deviation, total / np.maximum(weight.sum(1), 1e-300), 0.0))

    def worst_group_residual(self, residual: Array) -> Array:
        """(B, 1) px, residual of the typical row of the group of frames that is explained worst, of any axis.

        0 unless it is more than ``_WORST`` times that of the typical group. Clouds may cover half of the rows. All
        axes have it: the displacement along one determines which rows are compared along the others.
        """
        distances = median(split_axis(self.distances(residual), 1, self.groups, -1), 2)
        worst = without_nan(distances, 0.0).max(1)
        return np.where(worst > _WORST * median(distances, 1), worst, 0.0).max(-1, keepdims=True)

    def independent_fraction(self, residual: Array) -> Array:
        """(B,) fraction of the rows that are independent, from the correlation rho(k) of residuals k rows apart.

        Errors of the model correlate the residuals of neighbouring rows, and the variance of a mean is larger by
        ``1 + 2 sum rho(k)``, k = 1 ... 4.
        """
        scaled = residual * np.sqrt(self._expected)[:, :, None]
        energy = np.maximum(np.square(scaled).sum((1, 2, 3)), 1e-300)
        products = [(scaled[:, lag:] * scaled[:, :-lag]).sum((1, 2, 3)) for lag in range(1, 5)]
        return 1.0 / np.maximum(1.0 + 2.0 * np.stack(products).sum(0) / energy, 1.0)

    # Robust weights

    def _sizes_for_weights(self, residual: Array) -> Array:
        """``sizes``; with roll and zoom, one size for all axes: unequal weights would mix correlated components."""
        axes = self.information.shape[-1]
        if axes == 2:
            return self.sizes(residual)
        square = np.einsum("bnga,bnac,bngc->bn", residual, self.information, residual)
        size = np.sqrt(np.maximum(square / np.maximum(axes * self.num_differences, 1.0), 0.0))[..., None]
        return np.where(np.isnan(self.distances(residual)), np.nan, size)

    def for_least_absolute(self, residual: Array) -> "Measurements":
        """Weights that make a least-squares fit minimise the sum of absolute residuals, which limits outliers."""
        size = self._sizes_for_weights(residual)
        floor = 0.1 * without_nan(median(size, 1, keepdims=True), 1.0) + 1e-12  # no weight is unbounded
        return self.scaled(1 / np.maximum(without_nan(size, 0.0), floor))

    def reweighted(self, residual: Array) -> "Measurements":
        """The measurements with Tukey's biweight of their residual on each axis: outliers have weight 0."""
        return self.scaled(np.square(1 - np.square(self._biweight_argument(residual))))

    def share_counted(self, residual: Array) -> Array:
        """(B,) correction (0 to 1) of the number of measurements after ``reweighted``, for the covariance of the fit.

        Weights that depend on the residuals make these look smaller than the errors are: the variance of an M-estimator
        is ``E psi^2 / (E psi')^2`` with ``psi = w z``, not ``E w z^2 / E w`` (Huber 1981, ch. 6). Of 118
        parameters, the rms error over the standard deviation is 1.12 with it and 1.18 without.
        """
        z = self._biweight_argument(residual)
        weight = np.square(1 - np.square(z))
        slope = (1 - np.square(z)) * (1 - 5 * np.square(z))
        apparent = (weight * np.square(z)).sum((1, 2)) / np.maximum(weight.sum((1, 2)) * (z < 1).sum((1, 2)), 1e-300)
        actual = np.square(weight * z).sum((1, 2)) / np.maximum(np.square(slope.sum((1, 2))), 1e-300)
        return np.minimum(apparent / np.maximum(actual, 1e-300), 1.0)

    def weighed(self, residual: Array) -> "Measurements":
        """The measurements of the last fit: ``reweighted``, with the fraction that counts for its covariance."""
        weighed = self.reweighted(residual)
        return replace(weighed, independent=weighed.independent_fraction(residual) * self.share_counted(residual))

    def _biweight_argument(self, residual: Array) -> Array:
        """(B, N, 2) rms residual over 6 robust standard deviations (98 % efficient), at most 1; 1 if not measured."""
        size = self._sizes_for_weights(residual)
        spread = 1.4826 * median(size, 1, keepdims=True)
        return np.minimum(without_nan(size / (6.0 * np.maximum(without_nan(spread, 1.0), 1e-9)), 1.0), 1.0)


# px, standard deviation of a row from which it is not registered if the rms offsets exceed the second value. Parts of a
# scene that are compared at a wrong place seem to move by little and have 0.14 px and more; of 19 right axes with
# offsets of 8 to 40 px, the largest was 0.008 px. Of 60 axes with amplitudes of 18 and 25 px in 256 rows, 3 were wrong
# by their size and reliable without this and the upper limit of ``permitted``
_LARGE_STD, _LARGE_OFFSET = 0.1, 8.0
# Residual of one group of frames over that of the typical group, from which on it counts. Of 160 stacks of 4 to 16
# frames, each with one or two frames lost, one repeated or two swapped (1,920 axes), 21 axes were reliable and wrong;
# 20 of them had ratios of 15 to 500 or no measured rows in a group. Of 144 right axes of the intact stacks, 4.1 at most
_WORST = 5.0


@dataclass(frozen=True, eq=False)
class OtherMotion:
    """Motion of the rows that no vibration explains, for each axis in px, without the part that noise explains."""

    size: Array  # (..., 2) rms offset of the rows by the tones, for comparison
    unexplained: Array  # (..., 2) rms residual displacement of the fit
    correlated: Array  # (..., 2) the part of it that neighbouring rows have in common
    # (..., 2) rms difference of the residual displacements of the left and right halves of the rows
    differential: Array
    # (...) fraction of the visible rows whose displacement was measured, in the group of frames that has the smallest
    measured: Array
    # (..., 3) measured difference of the blur of the frames relative to the expected one, its standard deviation, and
    # the size of the expected difference relative to the detail of the scene
    blur: Array

    @classmethod
    def of(cls, measurements: Measurements, by_tones: Array, residual: Array, differential: Array) -> "OtherMotion":
        """From displacements (B, N, G, 2) of rows by the tones and the residuals; the blur counts as expected."""
        visible = measurements.num_differences > 0
        # sqrt(2): from the rms displacement about the mean of the frames to the offset of two of them
        size = math.sqrt(2) * np.sqrt(valid_mean(np.square(measurements.distances(by_tones)), 1))
        min_weight = np.where((size[..., :2] > _LARGE_OFFSET).any(-1, keepdims=True), _LARGE_STD**-2, 0.0)[..., None]
        measured = visible & (measurements.weights[..., :2] > min_weight).all(-1)
        counts = (split_axis(rows, 1, measurements.groups, -1).sum(2) for rows in (measured, visible))
        num_measured, num_visible = counts
        share = np.where(num_visible > 0, num_measured / np.maximum(num_visible, 1), 1.0)
        return cls(
            size=size,
            unexplained=np.maximum(measurements.unexplained(residual), measurements.worst_group_residual(residual)),
            correlated=measurements.correlated(residual),
            differential=differential,
            measured=(share * num_visible.any(1, keepdims=True)).min(1),
            blur=np.broadcast_to(np.array([1.0, 0.0, 0.0]), (len(residual), 3)),
        )

    @property
    def permitted(self) -> Array:
        """(..., 2) px, largest ``unexplained`` of a reliable axis: errors of interpolation and of unequal blur.

        Of 22 right axes with offsets of 15 to 40 px, the largest residual was 0.007 px; frames that are compared at a
        wrong place have 0.12 px and more.
        """
        return np.clip(0.006 * self.size, 0.05, 0.1)

    @property
    def explained(self) -> Array:
        """(...) bool, whether the residuals of all axes are permitted; False where no row was measured."""
        return np.all(self.unexplained <= self.permitted, -1)


def cholesky_root(information: Array) -> Array:
    """Upper triangular R (..., A, A) with ``W = R^T R`` of information matrices W, rows of 0 where W is singular."""
    axes = information.shape[-1]
    root, remaining = np.zeros_like(information), information
    for axis in range(axes):
        square = remaining[..., :1, :1]
        scale = (square > 0) / np.sqrt(np.where(square > 0, square, 1.0))
        row = remaining[..., :1, :] * scale  # (..., 1, A - axis)
        root[..., axis, axis:] = row[..., 0, :]
        if axis + 1 < axes:
            coupling = row[..., 1:]
            remaining = remaining[..., 1:, 1:] - coupling.mT * coupling
    return root


def trimmed_mean(values: Array) -> Array:
    """Mean (B, A) of the smallest 70 % of values (B, N, A) without NaN; clouds may cover the other rows."""
    ordered = np.sort(values, 1)  # NaN come last
    count = np.ceil((~np.isnan(values)).sum(1, keepdims=True).astype(np.float32) * 0.7)
    counted = np.arange(values.shape[1])[None, :, None] < count
    return np.where(counted, ordered, 0.0).sum(1) / np.maximum(count[:, 0], 1)
