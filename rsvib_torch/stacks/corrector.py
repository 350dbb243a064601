"""Detection and restoration as one module of a network."""

from typing import NamedTuple

from torch import Tensor, nn

from rsvib_torch.checks.arrays import FramesOrFiles
from rsvib_torch.detection import DetectionResult, VibrationDetector
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import OptionTable
from rsvib_torch.restoration import VibrationRestorer


class CorrectedFrames(NamedTuple):
    """Restored frames in the shape of the input, and the detections; axes that are not reliable are not corrected."""

    frames: Tensor
    detection: DetectionResult


class VibrationCorrector(nn.Module):
    """``detect_vibration`` and ``restore`` as one module: stacks in, restored stacks and the detection out.

    Gradients flow to the frames through the restoration; the detected vibration is constant for them. The module has no
    weights. What ``torch.export`` and ONNX accept is the restoration with a given vibration, ``FixedDewarp``: the
    number of steps of a detection depends on the frames.

    Args:
        timing: The sensor.
        detection: Options of ``detect_vibration``.
        restoration: Options of ``restore``.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, _ = example_frames()
        >>> corrector = rsv.VibrationCorrector(timing, restoration={"method": "dewarp"})
        >>> corrector
        VibrationCorrector(
          (detector): VibrationDetector(row_time=4e-05, exposure_rows=20, frame_rows=300)
          (restorer): VibrationRestorer(row_time=4e-05, exposure_rows=20, frame_rows=300, method='dewarp')
        )
        >>> batch = frames[None, :, None]  # (B, T, C, H, W)
        >>> restored, detection = corrector(batch)
        >>> restored.shape == batch.shape, detection.reliable.tolist()
        (True, [[True, True]])
    """

    def __init__(self, timing: SensorTiming, *, detection: OptionTable = None, restoration: OptionTable = None) -> None:
        super().__init__()
        self.detector = VibrationDetector(timing, **(detection or {}))
        self.restorer = VibrationRestorer(timing, **(restoration or {}))

    def forward(self, frames: FramesOrFiles) -> CorrectedFrames:
        """Correct a stack (T, H, W) or (T, C, H, W), or a batch of stacks (B, T, C, H, W)."""
        detection = self.detector(frames)
        return CorrectedFrames(self.restorer(frames, detection), detection)
