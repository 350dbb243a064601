"""Whether the blur of corners in a window of frames contradicts the stated exposure."""

import numpy as np

from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.registration.corners import reduction
from rsvib_torch.tracking.window_fit import WindowFit

_NODES = 8  # of the path within an exposure, which has up to one period of a tone


def blur_ratio(fit: WindowFit, timing: SensorTiming, size: tuple[int, int]) -> tuple[float, float]:
    """Difference of the blur of corners between frames (H, W) over the expected one, and its standard deviation.

    As in ``detection.rows.displacements.blur_ratio``, an exposure blurs to second order by ``1 + M : grad grad / 2``
    with the second moments M of the path, and the ratio is that of the squares of true and stated exposure. What all
    corners of a pair have in common does not count, because it depends on the compression of the frames.
    """
    # 1. The path of each corner within both exposures, in px of the frames in which corners are followed.
    corners, times, scale = fit.corners, fit.times, reduction(*size)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    seconds, weights = 0.5 * timing.exposure_time * nodes, 0.5 * weights
    window, (index, values) = fit.path(), fit.envelope(times)
    velocity = np.stack([window.path(at, 1) for at in corners.times.T], 1) @ corners.factors.swapaxes(1, 2)
    path = velocity[:, :, None] * seconds[:, None]  # (N, 2, nodes, 2)
    for tone in fit.tones:
        amplitude = (values * tone.knots[index]).sum(-1)[..., None]
        path[..., tone.axis] += (amplitude * tone.waves(times[..., None] + seconds, ())).real
    path = (path - (weights @ path)[:, :, None]) / scale
    # 2. What blurs them: M; and the filter and the optics, which are those of the rows that the vibration stretches.
    # Both are compared in the mean of both frames, as the patches are.
    across = np.zeros(2)
    across[-1 - int(timing.scan_axis)] = timing.row_time * scale * (1 if timing.readout_direction == "forward" else -1)
    speed = (path[:, :, -1] - path[:, :, 0]) / (seconds[-1] - seconds[0])
    stretch = np.eye(2) - speed[..., None] * across
    to_mean = np.linalg.inv(stretch.mean(1))[:, None]
    root = np.sqrt(weights)[:, None] * path  # M = root^T root
    both = [to_mean @ root.swapaxes(-1, -2), to_mean @ stretch]
    of_both = np.stack([part @ part.swapaxes(-1, -2) for part in both], 1)
    changes = (of_both[:, :, 1] - of_both[:, :, 0]).reshape(-1, 2, 4)[..., [0, 1, 3]]
    # 3. Least squares for the ratio and the size of the filter, and for what the corners of each pair have in common.
    columns = np.concatenate([changes, np.broadcast_to(np.eye(3), (len(times), 3, 3))], 1)
    heavy = fit.weights[:, None, None] * columns @ corners.blur[:, :3]
    starts = [part.start for part, _, _ in fit.pairs]
    normal = np.add.reduceat(heavy[..., :3] @ columns.swapaxes(1, 2), starts)
    right = np.add.reduceat(heavy[..., 3:], starts)
    inner = normal[:, 2:, 2:] + 1e-9 * (np.trace(normal[:, 2:, 2:], axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(3)
    rest = np.concatenate([normal[:, :2, :2], right[:, :2]], 2)
    of_pairs = rest - normal[:, :2, 2:] @ np.linalg.solve(inner, np.concatenate([normal[:, 2:, :2], right[:, 2:]], 2))
    total = of_pairs.sum(0)
    inverse = np.linalg.pinv(total[:, :2])
    solution = inverse @ total[:, 2]
    # 4. The standard deviation by the scatter of the pairs.
    scores = (of_pairs[..., 2] - of_pairs[..., :2] @ solution) @ inverse[0]
    return float(solution[0]), float(np.sqrt(np.square(scores).sum()))
