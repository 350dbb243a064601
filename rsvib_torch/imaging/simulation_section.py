"""``[simulation]`` of a configuration file: the vibration of the camera, the frames, and the noise of the sensor."""

from pydantic import Field

from rsvib_torch.checks.validation import Count, options
from rsvib_torch.imaging.sensor_model import SensorNoise
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.vibration import Vibration

_Tones = list[float] | list[list[float]]
_ZERO: list[float] = Field(default_factory=lambda: [0.0, 0.0])


@options
class CameraSection:
    """Fields of ``Camera``, which checks their values."""

    focal_length: float
    principal_point: list[float] = Field(default_factory=lambda: [0.0] * 2, min_length=2, max_length=2)
    distortion: list[float] = Field(default_factory=lambda: [0.0] * 5, min_length=4, max_length=5)
    fisheye: bool = False

    def __post_init__(self) -> None:
        self.to_camera()  # which checks the values

    def to_camera(self) -> Camera:
        """The camera."""
        return Camera(**vars(self))


@options
class VibrationSection:
    """Fields of ``Vibration``, which checks their values; an axis is one number (one tone) or a list of tones."""

    amplitude: _Tones
    frequency: _Tones
    phase: _Tones = _ZERO
    image_motion: list[float] = _ZERO
    image_acceleration: list[float] = _ZERO
    image_shift: list[float] = _ZERO
    camera: CameraSection | None = None

    def __post_init__(self) -> None:
        try:
            self.to_vibration()
        except TypeError as error:  # lists of different lengths; pydantic reports ``ValueError`` only
            raise ValueError(str(error)) from error

    def to_vibration(self) -> Vibration:
        """The vibration."""
        camera = None if self.camera is None else self.camera.to_camera()
        return Vibration(**{**vars(self), "camera": camera})


@options
class SimulationSection:
    """All keys."""

    vibration: VibrationSection
    num_frames: Count = 2
    """Number of frames."""
    frame_size: tuple[Count, Count] | None = Field(default=None, strict=False)
    """(height, width) of the frames in px; None for the largest size that the scene allows."""
    noise: SensorNoise | None = None
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    """Seed of the noise."""
