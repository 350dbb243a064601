"""The vibration in a part of a video, with the reasons against it, as it is recorded."""

import math
from itertools import combinations

import numpy as np
import torch

from rsvib_torch.detection.sensitivity import timing_sensitivity, with_row_time_std
from rsvib_torch.detection.tones.fit import ToneFit
from rsvib_torch.detection.verdict import exposure_reasons
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration.corners import reduction
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason
from rsvib_torch.text import number_of
from rsvib_torch.tracking.camera_path import CameraPath
from rsvib_torch.tracking.window_fit import SIGNIFICANT, WindowPath
from rsvib_torch.tracking.window_tones import Tone, WindowTone
from rsvib_torch.video.video_frames import VideoFrames

_GAIN_ERROR = 0.02  # of an amplitude: the mean over the patch of a corner is known so well (52 to 205 Hz: 0.4 to 1.6 %)
# px^-2, of the third cumulant of the path within an exposure, by which a blurred corner is found beside the mean of the
# path. 36 tones of 33 to 177 Hz and 0.4 to 2.5 px behind 4 ms: 0.07 to 0.34, amplitudes were up to 15 % too large
_BLUR_BIAS = 0.15
_SAME_ALIAS = 0.01  # periods per frame; tones are separated from 0.02 on in a window of 96 frames
# rad, of the phase of a tone from a frame to the next one: with every seventh frame missing, 93.0 and 121.0 Hz were
# stated as 93.47 and 121.15 Hz and jumped by 0.37 and 0.22 rad
_MAX_JUMP = 0.1
_MAX_APART = 0.25  # of a tone, left in a third of the rows or columns: up to 0.14 of tones of cameras, at night
_MAX_COPIES = 0.05  # of the frames; with more, frames were taken at other times than stored: 143 Hz became 149 Hz


def part_detection(frames: VideoFrames, path: CameraPath, times: Array, part: slice) -> DetectedVibration:
    """The vibration in the middle of a part; its time origin is the start of the first frame of the part.

    ``times`` (N,) in s are the middles of all frames of the video.
    """
    of_part, begin = times[part], float(frames.starts[part.start])
    middle = float(of_part[len(of_part) // 2])
    window = path.nearest(middle)
    tones = [tone.at(middle - window.origin, begin - window.origin) for tone in window.tones]
    amplitude, frequency, phase, size, rate = tone_tables(tones, 2)
    apparent, amplitude = amplitude, _without_blur(frames, amplitude, frequency)
    size = np.hypot(size, _GAIN_ERROR * apparent)
    with np.errstate(divide="ignore", invalid="ignore"):
        phase_std = np.where(amplitude > 0, size / apparent, math.inf)
        period_std = np.where(frequency > 0, rate / frequency**2, math.inf)
    size = np.hypot(size, 0.5 * (apparent - amplitude))  # blur does not turn the phase
    unknown = np.full(2, math.inf)
    values = (size, rate, period_std, phase_std, unknown, unknown)
    velocity, acceleration = (window.path(of_part[:1], order)[0, :2] for order in (1, 2))
    vibration = Vibration(amplitude, frequency, phase, velocity, acceleration)
    findings = _findings(frames.job.timing, tones, window)
    copies = np.count_nonzero(np.diff(times) <= 0) / len(times)
    against = [
        Reason(code, None, value, allowed)
        for code, value, allowed in (
            ("corners_unexplained", window.residual_of_most, path.allowed),
            ("frames_repeated", copies, _MAX_COPIES),
        )
        if value > allowed
    ]
    against += exposure_reasons(frames.job.timing.in_row_order(), *window.blur)
    if window.other_readout is not None:
        name, by_stated, by_other = window.other_readout
        against.append(Reason("readout_contradicted", None, by_stated, by_other, {"other": name}))
    if against:
        findings = tuple((*(one for one in of if one.code != "no_tone"), *against) for of in findings)
    timing, std = frames.job.timing, VibrationStd(*(torch.from_numpy(np.array(value)) for value in values))
    coefficients = amplitude * np.exp(1j * (phase - 0.5 * math.pi))
    drift, no_covariance = velocity[None, :, None], np.empty((1, 0, 0))
    fit = ToneFit(coefficients[None], frequency[None], amplitude[None] > 0, drift, no_covariance, np.zeros(1))
    rows = frames.size[int(timing.scan_axis)]
    sensitivity = timing_sensitivity(fit, timing.in_row_order(), len(of_part), rows)[0]
    return DetectedVibration(
        vibration=vibration,
        std=with_row_time_std(std, vibration, sensitivity, timing),
        gain=vibration.gain(timing.frame_period),
        residual=torch.full((2,), window.residual, dtype=torch.float64),
        reliable=torch.tensor([not reasons for reasons in findings]),
        findings=findings,
        assumptions=_assumptions(frames.job.timing, window),
    )


def _assumptions(timing: SensorTiming, window: WindowPath) -> tuple[str, ...]:
    """What the corners of a window cannot contradict."""
    if not window.agreeing:
        return ()
    first, more = " or ".join(window.agreeing[:2]), len(window.agreeing) - 2
    others = f" (and {number_of(more, 'other readout')})" if more > 0 else ""
    row_time = f"row_time={timing.row_time:.4g} s"
    return (f"{row_time}: the corners agree as well with rows that are read {first}{others}",)


def _without_blur(frames: VideoFrames, amplitude: Array, frequency: Array) -> Array:
    """Amplitudes in px of tones in Hz without what the blur of the corners adds to them.

    Corners lie where their blur is strongest, near the turning points of the motion. A tone of amplitude a with the
    exposure E appears as ``a + k a^3``, ``k = 3/4 c (1 + s(2 f E) - 2 s(f E)^2)``, ``s(x) = sin(pi x) / (pi x)``:
    c times the third cumulant of the path. Frames are restored with what appears.
    """
    turns = frequency * frames.job.timing.exposure_time
    of_path = 1.0 + np.sinc(2.0 * turns) - 2.0 * np.sinc(turns) ** 2
    cubic = 0.75 * _BLUR_BIAS * of_path / reduction(*frames.size) ** 2
    true = amplitude
    for _ in range(8):  # Newton's method, from above
        true = true - (true + cubic * true**3 - amplitude) / (1.0 + 3.0 * cubic * true**2)
    return true


def _findings(timing: SensorTiming, tones: list[Tone], window: WindowPath) -> tuple[tuple[Reason, ...], ...]:
    """Reasons against each axis.

    Between frames, tones of f and f + n / T are the same; the times of the rows distinguish them. With a row time
    that is wrong by 5 to 50 %, a tone of 93 Hz was explained by two, of 93 and 63 or 123 Hz, and one of 87 Hz along
    the other axis was 57 Hz.
    """
    aliases = [
        Reason("tones_alias", AXIS_NAMES[first.axis], first.frequency, second.frequency)
        for first, second in combinations(tones, 2)
        if first.axis == second.axis
        and (cycles := abs(first.frequency - second.frequency) * timing.frame_period) > 0.5
        and abs(cycles - round(cycles)) < _SAME_ALIAS
    ]
    # Where frames are missing, the phase of a tone jumps, and others of 0.1 to 0.2 px seem to be beside it: 0.75 to
    # 0.8 of the tone are not followed, of one that is switched on and off 0.6, at most 0.21 in 14 clips. Tones of
    # the other axis are wrong as well then.
    largest = {tone.axis: tone for tone in sorted(window.tones, key=lambda tone: tone.size)}

    def changed(tone: WindowTone, change: float, allowed: float) -> Reason:
        limit, details = allowed * tone.size, {"frequency": tone.frequency}
        return Reason("tone_changes", AXIS_NAMES[tone.axis], change, limit, details)

    jumps = [changed(tone, tone.jump * tone.size, _MAX_JUMP) for tone in largest.values() if tone.jump > _MAX_JUMP]
    findings = []
    for axis, name in enumerate(AXIS_NAMES[:2]):
        of_axis = [tone for tone in tones if tone.axis == axis]
        apart = max((tone.left_in_third for tone in window.tones if tone.axis == axis), default=0.0)
        is_significant = any(abs(tone.coefficient) > SIGNIFICANT * tone.amplitude_std for tone in of_axis)
        against = aliases[:1] if is_significant else [Reason("no_tone", name)]
        if axis in largest:
            one = largest[axis]
            bends = [changed(one, one.bend(), 1 / SIGNIFICANT)] if one.bend() > one.size / SIGNIFICANT else []
            if jumps or bends:
                against = [*(jumps[:1] or bends), *aliases[:1]]
        if apart > _MAX_APART:
            against.append(Reason("rows_differ", name, apart, _MAX_APART))
        fastest = max((tone.frequency for tone in of_axis), default=0.0)
        if fastest * timing.exposure_time > 1:
            against.append(Reason("tone_averaged_out", name, fastest, 1 / timing.exposure_time))
        findings.append(tuple(against))
    return tuple(findings)


def tone_tables(tones: list[Tone], axes: int) -> Array:
    """Amplitude (px), frequency (Hz) and phase (rad) of ``Vibration``, of tones, the largest first: (5, axes, K).

    The last two are the standard deviations of amplitude and frequency, which are infinite where there is no tone.
    """
    of_axes = [[tone for tone in tones if tone.axis == axis] for axis in range(axes)]
    values = np.zeros((5, axes, max(1, *map(len, of_axes))))
    values[3:] = math.inf
    for axis, of_axis in enumerate(of_axes):
        for number, tone in enumerate(sorted(of_axis, key=lambda tone: -abs(tone.coefficient))):
            # Re c exp(i a) = |c| sin(a + arg c + pi/2)
            phase = np.angle(tone.coefficient) + 0.5 * math.pi
            size = abs(tone.coefficient), tone.frequency, phase, tone.amplitude_std, tone.frequency_std
            values[:, axis, number] = size
    return values
