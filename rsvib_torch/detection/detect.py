"""``detect_vibration``: entry point of detection, from the user's arguments to a result in the user's layout.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from rsvib_torch.checks.arguments import FramesOrFiles
from rsvib_torch.detection.attempts import detect_tones
from rsvib_torch.detection.pipeline import DetectionOptions
from rsvib_torch.detection.result import DetectionResult
from rsvib_torch.detection.start import camera_in_row_order
from rsvib_torch.execution.parallel import full_precision, threads_for, without_gradients
from rsvib_torch.frames.entry_points import TimedModule, frames_options, module_options
from rsvib_torch.frames.prepare import grey_frames
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import VibrationOptions


@frames_options(VibrationOptions)
@full_precision
@without_gradients
def detect_vibration(frames: FramesOrFiles, timing: SensorTiming, options: VibrationOptions) -> DetectionResult:
    """Detect the vibration of the camera from consecutive frames (Sec. 2 of Liu et al. 2023).

    Row bands are registered between frames, and sinusoids and a uniform motion (Eq. 5) are fitted to the offset curve.
    Gain, exposure, band average and coupling with the scan are part of the model (Eqs. 4, 6-8); no initial guess is
    needed. The direct method then warps the frames to the scene by this motion, measures the residual displacement of
    every row, and fits again: all frames of a stack together, down to the noise. No gradient flows through the result.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) of at least two frames, floating point, or
            integers of known full scale: a tensor, an array, a list of these, or a path or list of paths of files,
            which are read as by ``read_stack``. NaN marks missing pixels.
        timing: The sensor. Frame start times at unequal intervals (dropped frames) remove blind frequencies. If frames
            is a path, the frame times in the file are used.
        options: Options.

    Returns:
        The vibration in image axes (x, y) with standard deviations, a verdict for each axis, and the offset curve.

    Warns:
        TimingWarning: If frame start times, or the file that frames is a path of, state another frame rate than the
            sensor has.

    Raises:
        ValueError: If there are fewer than two frames, a frame is constant or has too many missing pixels, or an option
            is out of range.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=2)
        >>> detection = rsv.detect_vibration(frames, timing)
        >>> detection.vibration.amplitude[:, 0].round(decimals=2).tolist()  # px along x and y
        [2.1, 1.6]
        >>> detection.vibration.frequency[:, 0].round(decimals=1).tolist()  # Hz
        [110.0, 90.0]
        >>> detection.reliable.tolist(), detection.reasons
        ([True, True], ((), ()))

        Near a blind frequency (here 83.3 Hz, the frame rate) the axis is refused, with the reason:

        >>> blind = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 83.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, blind, num_frames=2)
        >>> detection = rsv.detect_vibration(frames, timing)
        >>> detection.reliable.tolist()
        [True, False]
    """
    # 1. The user's frames become grey frames in row order.
    stacks = grey_frames(frames, timing, options)
    timing = stacks.timing
    height, width = stacks.images.shape[-2:]
    camera = camera_in_row_order(options, (height, width), timing)
    zoom = False if options.roll is False and options.zoom == "auto" else options.zoom  # zoom is measured with roll
    if options.roll is False and zoom:
        raise ValueError("zoom=True measures roll as well, and roll=False excludes it; pass roll=True, or zoom=False")
    axes = 4 if zoom is True else 3 if options.roll is True else 2, 4 if zoom else 3 if options.roll else 2
    tones = None if options.tones == "auto" else options.tones
    detection_options = DetectionOptions(options.method, tones, 2 if options.image_acceleration else 1, options)
    if options.columns is not None:
        if camera is not None or options.roll is True or options.zoom is True:
            raise ValueError(
                f"columns={options.columns} goes with roll=False, zoom=False and focal_length=None: roll, zoom and "
                "perspective are measured from all columns"
            )
        stacks, axes = stacks.narrowed(options.columns), (2, 2)

    # 2. One result from all frames.
    with threads_for(stacks.images):
        result = detect_tones(stacks, timing, detection_options, axes, camera)
    return result if stacks.batched else result[0]


class VibrationDetector(TimedModule):
    """``detect_vibration`` with fixed timing and options as a module, for one stack or a batch of stacks.

    The options are those of ``detect_vibration``. It has no weights. Autocast does not affect it, and
    ``torch.compile`` calls it uncompiled, at one graph break.

    Args:
        timing: The sensor.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, _ = example_frames()
        >>> detector = rsv.VibrationDetector(timing, method="bands", tones=1)
        >>> found = detector(frames.expand(2, 1, *frames.shape).transpose(1, 2))  # two stacks (B, T, C, H, W)
        >>> found.vibration.frequency[..., 0].round(decimals=0).tolist()  # Hz, (B, 2)
        [[111.0, 90.0], [111.0, 90.0]]
    """

    @module_options(VibrationOptions)
    def __init__(self, timing: SensorTiming, options: VibrationOptions) -> None:
        super().__init__(timing, options)

    def forward(self, frames: FramesOrFiles) -> DetectionResult:
        """Detect the vibration in a stack of frames."""
        return detect_vibration(frames, self.timing, **vars(self.options))
