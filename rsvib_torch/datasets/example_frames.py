"""Simulated frames for examples and first steps."""

from torch import Tensor

from rsvib_torch.datasets.landscape import city_and_fields
from rsvib_torch.imaging import simulate_frames
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration


def example_frames(num_frames: int = 2) -> tuple[Tensor, SensorTiming, Vibration]:
    """Frames (T, H, W) of a landscape, the sensor and the vibration, for examples and first steps.

    The vibration has 2.1 px at 110 Hz along x and 1.6 px at 90 Hz along y.

    Example:
        >>> frames, timing, vibration = example_frames()
        >>> vibration.frequency[:, 0].tolist()  # Hz
        [110.0, 90.0]
    """
    timing = SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
    vibration = Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
    scene = city_and_fields(320, 240, seed=3)
    return simulate_frames(scene, timing, vibration, num_frames=num_frames), timing, vibration
