"""Values of Liu et al. 2023 (Sensors 23, 5953): the camera, Table 1, and the results of Tables 2, 3 and 4.

In Table 3 the two columns of relative errors are exchanged: 19.890 ms instead of 20 ms is 0.55 %, which is printed in
the column of the amplitude. Here each error is with its values.
"""

from dataclasses import dataclass
from typing import Literal

AXES = ("x", "y")
AXIS_NAMES = {"x": "horizontal", "y": "vertical"}
ROW_TIME, EXPOSURE_ROWS, FRAME_ROWS = 20.52e-6, 20, 2048
FREQUENCY = {"x": 50.0, "y": 30.0}  # Hz
AMPLITUDE = {"x": 3.1, "y": 5.2}  # px
PERIOD = {"x": 20.0, "y": 33.33}  # ms, as printed in Table 1

Target = Literal["chart", "landscape"]
TARGETS: dict[Target, str] = {"chart": "ISO 12233", "landscape": "in-orbit simulation"}


@dataclass(frozen=True)
class Detected:
    """A line of Table 2 or 3: period in ms, amplitude in px, phase in π, errors of the first two in %."""

    period: float
    amplitude: float
    phase: float
    period_error: float
    amplitude_error: float


DETECTED: dict[Target, dict[str, Detected]] = {
    "chart": {
        "x": Detected(20.048, 3.147, 0.653, 0.242, 1.526),
        "y": Detected(33.280, 5.195, 1.234, 0.161, 0.096),
    },
    "landscape": {
        "x": Detected(19.890, 3.084, 0.638, 0.551, 0.519),
        "y": Detected(33.122, 5.211, 1.227, 0.635, 0.218),
    },
}


@dataclass(frozen=True)
class Restored:
    """A line of Table 4: frames p and p + 1, degraded and restored, and the improvement in %."""

    degraded: tuple[float, float]
    restored: tuple[float, float]
    improvement: tuple[float, float]


RESTORED: dict[Target, dict[str, Restored]] = {
    "chart": {
        "psnr": Restored((33.915, 34.068), (40.525, 40.817), (19.49, 19.81)),
        "ssim": Restored((0.9286, 0.9338), (0.9971, 0.9978), (7.37, 6.85)),
        "mtf_x": Restored((0.0459, 0.1472), (0.0805, 0.1779), (75.38, 20.86)),
        "mtf_y": Restored((0.1035, 0.1009), (0.1477, 0.1443), (42.71, 43.01)),
    },
    "landscape": {
        "psnr": Restored((29.563, 29.602), (38.324, 38.682), (29.64, 30.68)),
        "ssim": Restored((0.8782, 0.8868), (0.9963, 0.9965), (13.45, 12.37)),
    },
}
