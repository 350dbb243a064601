"""Corners followed from frame to frame, by OpenCV: for motions that vary over the frame, such as roll and parallax."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rsvib_torch.motion.camera import displacement_factors
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array, table, tensor

Grey = NDArray[np.uint8]
Points = NDArray[np.float64]  # (N, 2) px, (x, y) from the middle of the first pixel

_CELLS = 6  # of the shorter side: every cell has the same number of corners, so that one object does not hold them all
_QUALITY = 0.01  # of the best corner of a cell, below which there is none
# Of noise, the best corner of a cell has 6 to 10 times the median quality of all pixels, and at night 1 % of the best
# of the frame. Of dense detail, the best have 10 times the median as well, but few corners are below 2 % of the best.
_NOISE, _FAINT = 12.5, 0.02
PATCH = 11  # px, side of the patch that is compared; 21 px blur the motion of the rows, with 1.7 times the residuals
_COARSE = 21  # px, side of the patch in the pyramid, where the motion is found
_LARGEST_MOTION = 0.25  # of the longer side, which the coarsest level of the pyramid reaches
# px, side of the square whose mean is subtracted from every pixel: light that flickers by 35 % moved the corners of its
# rows, with residuals of 0.18 instead of 0.09 px and tones of 0.13 px; other clips are the same within 0.002 px.
# Division by the mean enlarges the noise of dark parts: residuals of 0.11 px
_AROUND = 31
_MAX_RETURN = 0.3  # px, between a corner and the point where the way back from the other frame ends
_MOST_PIXELS = 700_000  # of a frame in which corners are followed; the sides of larger ones are halved
_MIN_CORNERS = 8  # of a pair of frames; four components are determined, and wrong matches are rejected
# Of the corners of a pair, or of those that were followed, that agree on one motion: at night, 130 of 150 corners are
# noise that is not followed, and 20 lights agree. Of 700 pairs of unrelated frames, a third of them dark, 21 have as
# many corners that agree, up to 25 (20 pairs with one limit of 3 px).
_MIN_SHARE, _MIN_FOLLOWED = 0.25, 0.4
# px, from an affine motion between two frames, by the vibration of the rows; and, by parallax, from what the corners of
# a twelfth of the rows have in common beside it. With 3 px from the affine motion alone, rows that vibrate by more were
# left out: in five clips with tones of 2.4 and 1.7 px, restored rows moved by 0.05 to 0.08 px instead of 0.02 to 0.04
_WOBBLE, _AGREE, _PARTS = 12.0, 3.0, 12
# px, from one similarity, of half of the corners that decide; corners are of the layer up to twice as far from it. With
# 1 px as the least, a subject on 40 % of the frame moves the path by 0.2 px rms, with 0.7 px by 0.05 px
_LAYER_LIMITS = np.array([0.7, 1.4, 2.8, 5.6])
# px, of the reduced frames, by which corners at rest move; and the part of the cells at each of two opposite sides of a
# frame where most corners are at rest if the camera is. Of a still camera before a subject on 50 to 70 % of the frame,
# the background moved by 5 to 8 px in the restored frames. A subject that follows the camera may rest on half of it
_AT_REST, _OF_SIDE = 0.3, 0.8
_SIDES = np.s_[:, 0], np.s_[:, -1], np.s_[0], np.s_[-1]
# Of a frame that repeats itself at a distance, the correlation with itself: 1.00 of a fence, at most 0.41 of 13 scenes,
# of bricks as well; and at half of the distance. Beyond this distance from no shift (px), in the middle of this side
_REPEATS, _BETWEEN, _NEAR, _MIDDLE = 0.8, 0.5, 3, 512
# px, of a Gaussian filter, before compression and noise have less detail; its effect is fitted, because a vibration
# across the rows stretches them. Of 38 harmful wrong exposures, 24 were found with 1.2 px and 21 with 0.6 px
_SMOOTH_BLUR = 1.2
_HALF_PATCH = 7  # px, half side of a patch; its pixels count by a Gaussian window of half of that
_NO_CORNERS = np.zeros((0, 2)), np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Corners:
    """N corners that were followed between two frames, or between the frames of several pairs."""

    pairs: NDArray[np.int64]  # (N,) number of the pair
    rows: Array  # (N,) place of the row in the readout of the first frame, 0 to 1
    times: Array  # (N, 2) s, middle of the exposure of their rows in both frames
    places: Array  # (N, 2) px from the centre of the frame, (x, y), mean of both frames
    offsets: Array  # (N, 2) px
    layer: NDArray[np.bool_]  # (N,) whether they move with the part of the scene that most corners have moved with
    blur: Array  # (N, 4, 4), ``blur_products`` of their patches; zeros if blur is not compared

    @property
    def factors(self) -> Array:
        """(N, 2, 4), displacement by unit components of the path."""
        x, y = tensor(self.places).unbind(-1)
        return table(displacement_factors(x, y, 4))

    @staticmethod
    def joined(parts: Sequence["Corners"]) -> "Corners":
        """The corners of all pairs."""
        pairs = np.concatenate([np.full(len(part.rows), number) for number, part in enumerate(parts)])
        names = ("rows", "times", "places", "offsets", "layer", "blur")
        return Corners(pairs, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class CornerFollower:
    """Follows the corners that move with most others from each frame of a video to the next, as long as they are seen.

    Frames are reduced if they are large. ``most`` is the number of corners of a pair of frames; with 480, clips take
    twice the time and become no steadier. To compare the blur of the corners takes a fifth of the time.
    """

    def __init__(self, timing: SensorTiming, *, most: int = 256, compare_blur: bool = False) -> None:
        self._timing, self._most, self._compare_blur = timing, most, compare_blur
        self._start = 0.0  # s, of the frame before
        self._before: Grey | None = None  # the frame before, of reduced size
        self._known, self._votes = _NO_CORNERS  # corners in it, and the votes of each of them, see ``_in_layer``

    def next(self, grey: Grey, start: float) -> Corners | None:
        """Corners between the frame before and this one (H, W), whose exposure starts at ``start`` in s.

        None for the first frame, and if too few move together.
        """
        # 1. Follow corners.
        (height, width), timing, scale = grey.shape, self._timing, reduction(*grey.shape)
        before, corners_before, votes_before = self._before, self._known, self._votes
        small = cv2.resize(grey, (width // scale, height // scale), interpolation=cv2.INTER_AREA)
        second = np.asarray(cv2.addWeighted(small, 1.0, cv2.blur(small, (_AROUND, _AROUND)), -1.0, 128.0), np.uint8)
        starts = np.array([self._start, start])
        self._before, self._start = second, start
        self._known, self._votes = _NO_CORNERS
        if before is None:
            return None
        corners = find_corners(before, self._most, corners_before)
        votes = np.pad(votes_before, (0, len(corners) - len(votes_before)))
        ends, followed = follow_corners(before, second, corners)
        corners, ends, votes = corners[followed], ends[followed], votes[followed]
        # 2. Keep those that are at rest if the camera is, else those that follow one affine motion and the vibration of
        # their rows.
        agrees = np.hypot(*(ends - corners).T) < _AT_REST
        if not _stands_still(corners, agrees, second.shape):
            axis = 1 if timing.scan_axis == -2 else 0
            agrees = _agreement(corners, ends, axis, second.shape[1 - axis], scale)
            least = min(_MIN_SHARE * len(followed), _MIN_FOLLOWED * len(corners))
            if agrees.sum() < max(_MIN_CORNERS, least):
                return None
        corners, ends, votes = corners[agrees], ends[agrees], votes[agrees]
        layer = _in_layer(corners, ends, votes, scale)
        self._known, self._votes = ends, np.where(layer, votes + 1, np.minimum(votes, 0) - 1)
        blur = blur_products(before, second, corners, ends) if self._compare_blur else np.zeros((len(corners), 4, 4))
        # 3. Their places in the frames, and the times of their rows.
        corners, ends = ((points + 0.5) * scale - 0.5 for points in (corners, ends))
        rows = rows_of_points(np.stack([corners, ends], 1), timing, grey.shape)
        times = starts + rows * timing.row_time + 0.5 * timing.exposure_time
        places = 0.5 * (corners + ends) - 0.5 * (np.array([width, height]) - 1)
        part = rows[:, 0] / grey.shape[int(timing.scan_axis)]
        return Corners(np.zeros(len(corners), np.int64), part, times, places, ends - corners, layer, blur)


def rows_of_points(points: Array, timing: SensorTiming, size: tuple[int, ...]) -> Array:
    """(...) row times from the first row of a frame (H, W) to the rows of points (..., 2)."""
    axis = 1 if timing.scan_axis == -2 else 0
    rows: Array = points[..., axis]
    return rows if timing.readout_direction == "forward" else size[1 - axis] - 1 - rows


def _agreement(corners: Points, ends: Points, axis: int, length: int, scale: int) -> NDArray[np.bool_]:
    """(N,) bool, whether corners move with most others of their rows, along ``axis`` of ``length``."""
    agrees = np.zeros(len(corners), bool)
    if len(corners) < _MIN_CORNERS:
        return agrees
    wobble, limit = (max(1.0, limit / scale) for limit in (_WOBBLE, _AGREE))
    affine, inliers = cv2.estimateAffine2D(corners, ends, method=cv2.USAC_MAGSAC, ransacReprojThreshold=wobble)
    if affine is None:
        return agrees
    inside, residual = inliers[:, 0] > 0, ends - corners @ affine[:, :2].T - affine[:, 2]
    parts = (corners[:, axis] * _PARTS / length).astype(np.int64)
    for number in np.unique(parts[inside]):
        in_part = inside & (parts == number)
        common = np.median(residual[in_part], 0) if in_part.sum() >= _MIN_CORNERS else 0.0
        agrees[in_part] = np.hypot(*(residual[in_part] - common).T) < limit
    return agrees


def _in_layer(corners: Points, ends: Points, votes: NDArray[np.int64], scale: int) -> NDArray[np.bool_]:
    """(N,) bool, whether corners move with the layer that is followed; all of them if there is no layer.

    A layer is a part of the scene that moves as one similarity. A vibration displaces its rows differently: the limit
    is the smallest of several that half of the deciding corners are within. Frames are reduced by ``scale``. The
    ``votes`` of a corner count the pairs in which it moved with the layer; negative votes, those since it left it.
    """
    # 1. The corners that decide: those that moved with the layer last, else those that did not move apart from it. A
    # subject moves with the layer for a moment, and apart from it later.
    least = max(_MIN_CORNERS, _MIN_SHARE * len(votes))
    decide = next((mask for mask in (votes > 0, votes >= 0) if mask.sum() >= least), np.ones(len(corners), bool))
    # 2. The motion of the layer, and the corners that move like it.
    for limit in _LAYER_LIMITS / scale:
        similarity, inside = cv2.estimateAffinePartial2D(corners[decide], ends[decide], ransacReprojThreshold=limit)
        if similarity is not None and inside.mean() > 0.5:
            return np.asarray(np.hypot(*(ends - corners @ similarity[:, :2].T - similarity[:, 2]).T) < 2 * limit)
    return np.ones(len(corners), bool)


def _stands_still(corners: Points, still: NDArray[np.bool_], shape: tuple[int, ...]) -> bool:
    """Whether the camera stands still: most corners near two opposite sides of a frame (H, W) are at rest."""
    rows, columns = _grid(*shape)
    cells = _cells_of(corners, shape)
    count, at_rest = (np.bincount(cells, weights, rows * columns).reshape(rows, columns) for weights in (None, still))
    mostly = at_rest > 0.5 * count
    left, right, top, bottom = (mostly[part].sum() >= _OF_SIDE * (count[part] > 0).sum() > 0 for part in _SIDES)
    return bool((left and right) or (top and bottom))


def eight_bits(frame: Array, levels: Array | None = None) -> Grey:
    """A frame in 8 bits, in which OpenCV follows corners, between two levels that become 0 and 255.

    By default, nearly all pixels of the frame are between them, and NaN become 0.
    """
    if levels is None:  # the full scale may be far beyond the content
        levels = np.nanpercentile(frame[::4, ::4], (0.1, 99.9))
        frame = np.nan_to_num(frame, nan=levels[0])
    return np.asarray(np.interp(frame, levels, (0, 255)).round(), np.uint8)


def reduction(height: int, width: int) -> int:
    """Factor by which the sides of frames are reduced before corners are followed."""
    return int(2 ** max(0, math.ceil(0.5 * math.log2(height * width / _MOST_PIXELS))))


def repetition(grey: Grey) -> Array | None:
    """(2,) px (x, y), the shortest shift after which a frame (H, W) shows the same again, such as a fence; else None.

    Corners cannot show by how many such shifts the frame has moved.
    """
    # 1. The correlation of detail with itself, at shifts of up to half of the middle of the frame.
    scale = reduction(*grey.shape)
    small = cv2.resize(grey, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA).astype(np.float32)
    top, left = (max(0, length - _MIDDLE) // 2 for length in small.shape)
    small = small[top : top + _MIDDLE, left : left + _MIDDLE]
    detail = small - cv2.blur(small, (_AROUND, _AROUND))
    size = [2 * length for length in detail.shape]
    power = np.fft.irfft2(np.abs(np.fft.rfft2(detail, size)) ** 2, size)
    overlap = np.outer(*(length - np.abs(np.fft.fftfreq(2 * length, 0.5 / length)) for length in detail.shape))
    if power[0, 0] < overlap[0, 0]:  # less than one count
        return None
    correlation = np.fft.fftshift(power / np.maximum(overlap, 1.0))
    height, width = (length // 2 for length in detail.shape)
    correlation = correlation[height : 3 * height + 1, width : 3 * width + 1] * (overlap[0, 0] / power[0, 0])
    correlation = correlation.astype(np.float32)
    # 2. The nearest of its other maxima that is about as high as without a shift.
    y, x = np.nonzero((correlation > _REPEATS) & (correlation >= cv2.dilate(correlation, np.ones((3, 3)))))
    between = correlation[(y + height) // 2, (x + width) // 2]  # along a straight edge, it remains as high
    shifts = np.stack([x - width, y - height], -1)[between < _BETWEEN]
    shifts = shifts[np.hypot(*shifts.T) > _NEAR]
    return scale * shifts[np.hypot(*shifts.T).argmin()].astype(np.float64) if len(shifts) else None


def _grid(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of the cells of a frame."""
    side = min(height, width) / _CELLS
    return max(1, round(height / side)), max(1, round(width / side))


def _cells_of(points: Points, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """(N,) number of the cell of points in a frame (H, W), row after row."""
    (height, width), (rows, columns) = shape, _grid(*shape)
    x, y = np.floor(points / [width / columns, height / rows]).astype(np.int64).T
    return np.asarray(columns * y + x)


def find_corners(grey: Grey, max_corners: int, known: Points = _NO_CORNERS[0], mask: Grey | None = None) -> Points:
    """The known corners (N, 2) of a frame (H, W), and new ones in cells with less than half of the permitted number.

    All cells may have the same number of corners, in total about ``max_corners``; none where the mask (H, W) is 0.
    """
    height, width = grey.shape
    rows, columns = _grid(height, width)
    per_cell = -(-max_corners // (rows * columns))
    distance = max(3.0, 0.5 * min(height, width) / _CELLS / math.sqrt(per_cell))
    quality = cv2.cornerMinEigenVal(grey, 3)  # as in goodFeaturesToTrack
    floor = min(_NOISE * float(np.median(quality[::3, ::3])), _FAINT * float(quality.max()))
    filled = np.bincount(_cells_of(known, grey.shape), minlength=rows * columns).reshape(rows, columns)
    corners = [known]
    for row, column in zip(*np.nonzero(filled <= per_cell // 2), strict=True):
        top, left = row * height // rows, column * width // columns
        part = slice(top, (row + 1) * height // rows), slice(left, (column + 1) * width // columns)
        inner = None if mask is None else np.ascontiguousarray(mask[part])
        points = cv2.goodFeaturesToTrack(grey[part], per_cell, _QUALITY, distance, mask=inner)
        if points is not None:
            x, y = points[:, 0].T.astype(np.int64) + np.array([[left], [top]])
            places = np.stack([x, y], -1)[quality[y, x] > floor].astype(np.float64)
            is_far = np.abs(places[:, None] - known).max(-1).min(-1, initial=np.inf) >= distance
            corners.append(places[is_far][: per_cell - filled[row, column]])
    return np.concatenate(corners)


def follow_corners(before: Grey, after: Grey, corners: Points) -> tuple[Points, NDArray[np.bool_]]:
    """Places (N, 2) of corners of the first frame in the second, and whether (N) the way back ends at the corner."""
    if not len(corners):
        return corners, np.zeros(0, bool)
    levels = max(1, math.ceil(math.log2(_LARGEST_MOTION * max(before.shape) / _COARSE)) + 1)
    start = corners.astype(np.float32)[:, None]
    coarse, fine = (_COARSE, _COARSE), (PATCH, PATCH)
    end, coarse_ok, _ = cv2.calcOpticalFlowPyrLK(before, after, start, start.copy(), winSize=coarse, maxLevel=levels)
    guess = cv2.OPTFLOW_USE_INITIAL_FLOW
    end, fine_ok, _ = cv2.calcOpticalFlowPyrLK(before, after, start, end, winSize=fine, maxLevel=0, flags=guess)
    back, back_ok, _ = cv2.calcOpticalFlowPyrLK(after, before, end, start.copy(), winSize=fine, maxLevel=0, flags=guess)
    returns = np.abs(back - start).max((1, 2)) < _MAX_RETURN
    inside = ((end[:, 0] >= 0) & (end[:, 0] <= np.array(before.shape[::-1]) - 1)).all(1)
    followed = returns & inside & (coarse_ok[:, 0] == 1) & (fine_ok[:, 0] == 1) & (back_ok[:, 0] == 1)
    return end[:, 0].astype(np.float64), followed


def blur_products(first: Grey, second: Grey, corners: Array, ends: Array) -> Array:
    """(N, 4, 4) products of patches around corners (N, 2) of two frames (H, W), for a fit of their blur.

    The factors are half of the second derivative along x, the mixed one, half of that along y, and the difference of
    both patches, each without the part that is explained by brightness, contrast, a displacement, or a displacement
    that changes linearly over the patch.
    """
    steps = np.arange(-_HALF_PATCH - 1, _HALF_PATCH + 2, dtype=np.float32)

    def patches(first: Grey, centres: Array) -> NDArray[np.float32]:
        smooth = cv2.GaussianBlur(first.astype(np.float32), (0, 0), _SMOOTH_BLUR)
        x, y = centres.T.astype(np.float32)[..., None, None]
        shape = len(centres), len(steps), len(steps)
        at_x = np.broadcast_to(x + steps, shape).reshape(-1, len(steps))
        at_y = np.broadcast_to(y + steps[:, None], shape).reshape(-1, len(steps))
        values = cv2.remap(smooth, at_x, at_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
        return np.asarray(values, np.float32).reshape(shape)

    before, after = patches(first, corners), patches(second, ends)
    mean, inside = 0.5 * (before + after), np.s_[:, 1:-1, 1:-1]
    middle = mean[inside]
    left, right, above, below = mean[:, 1:-1, :-2], mean[:, 1:-1, 2:], mean[:, :-2, 1:-1], mean[:, 2:, 1:-1]
    by_x, by_y, u, v = 0.5 * (right - left), 0.5 * (below - above), steps[1:-1], steps[1:-1, None]
    mixed = 0.25 * (mean[:, 2:, 2:] - mean[:, 2:, :-2] - mean[:, :-2, 2:] + mean[:, :-2, :-2])
    nuisance = [np.ones_like(by_x), middle, by_x, by_y, u * by_x, u * by_y, v * by_x, v * by_y]
    by_xx, by_yy = right + left - 2 * middle, below + above - 2 * middle
    columns = np.stack([*nuisance, 0.5 * by_xx, mixed, 0.5 * by_yy, (after - before)[inside]], 1)
    columns *= np.exp(-np.square([u + 0 * v, v + 0 * u]).sum(0) / _HALF_PATCH**2)  # the root of the window
    flat = columns.reshape(len(columns), columns.shape[1], -1)
    products, count = np.asarray(flat @ flat.swapaxes(1, 2), np.float64), len(nuisance)
    inner = products[:, :count, :count]
    inner[:, range(count), range(count)] += 1e-6 * np.trace(inner, axis1=1, axis2=2)[:, None] / count
    explained = products[:, count:, :count] @ np.linalg.solve(inner, products[:, :count, count:])
    return np.asarray(products[:, count:, count:] - explained)
