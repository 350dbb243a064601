"""How the blur of the patches around corners differs between two frames."""

import cv2
import numpy as np
from numpy.typing import NDArray

from rsvib_torch.numerics.tables import Array

# px, of a Gaussian filter, before compression and noise have less detail; its effect is fitted, because a vibration
# across the rows stretches them. Of 38 harmful wrong exposures, 24 were found with 1.2 px and 21 with 0.6 px
_SMOOTH = 1.2
_HALF = 7  # px, half side of a patch; its pixels count by a Gaussian window of half of that


def blur_products(first: NDArray[np.uint8], second: NDArray[np.uint8], found: Array, ends: Array) -> Array:
    """(N, 4, 4) products of patches around corners (N, 2) of two frames (H, W), for a fit of their blur.

    They are those of half of the second derivatives along x, of the mixed ones, of half of those along y, and of the
    difference of both patches; of each, the parts are left out that brightness, contrast, a displacement, and one that
    changes linearly over the patch explain.
    """
    steps = np.arange(-_HALF - 1, _HALF + 2, dtype=np.float32)

    def patches(frame: NDArray[np.uint8], centres: Array) -> NDArray[np.float32]:
        smooth = cv2.GaussianBlur(frame.astype(np.float32), (0, 0), _SMOOTH)
        x, y = centres.T.astype(np.float32)[..., None, None]
        shape = len(centres), len(steps), len(steps)
        at_x, at_y = (np.broadcast_to(at, shape).reshape(-1, len(steps)) for at in (x + steps, y + steps[:, None]))
        values = cv2.remap(smooth, at_x, at_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
        return np.asarray(values, np.float32).reshape(shape)

    before, after = patches(first, found), patches(second, ends)
    mean, here = 0.5 * (before + after), np.s_[:, 1:-1, 1:-1]
    middle = mean[here]
    left, right, above, below = mean[:, 1:-1, :-2], mean[:, 1:-1, 2:], mean[:, :-2, 1:-1], mean[:, 2:, 1:-1]
    by_x, by_y, u, v = 0.5 * (right - left), 0.5 * (below - above), steps[1:-1], steps[1:-1, None]
    mixed = 0.25 * (mean[:, 2:, 2:] - mean[:, 2:, :-2] - mean[:, :-2, 2:] + mean[:, :-2, :-2])
    left_out = [np.ones_like(by_x), middle, by_x, by_y, u * by_x, u * by_y, v * by_x, v * by_y]
    by_xx, by_yy = right + left - 2 * middle, below + above - 2 * middle
    columns = np.stack([*left_out, 0.5 * by_xx, mixed, 0.5 * by_yy, (after - before)[here]], 1)
    columns *= np.exp(-np.square([u + 0 * v, v + 0 * u]).sum(0) / _HALF**2)  # the root of the window
    flat = columns.reshape(len(columns), columns.shape[1], -1)
    gram, count = np.asarray(flat @ flat.swapaxes(1, 2), np.float64), len(left_out)
    inner = gram[:, :count, :count]
    inner[:, range(count), range(count)] += 1e-6 * np.trace(inner, axis1=1, axis2=2)[:, None] / count
    explained = gram[:, count:, :count] @ np.linalg.solve(inner, gram[:, :count, count:])
    return np.asarray(gram[:, count:, count:] - explained)
