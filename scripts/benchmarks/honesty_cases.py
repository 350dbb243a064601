"""Recordings of the counts of confident wrong answers: classes of motions, scenes and errors of the stated timing."""

import io
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import av
import numpy as np
from benchmarks.honesty_camera import Array, Layer, Motion, row_displacement, standing, take_frames
from benchmarks.honesty_scenes import cars, cloud, near_half, scene_layer
from harness import write_h264

import rsvib_torch as rsv

FRAME_PERIOD = 1 / 24  # s
BLANKING = 1.15  # row times of a frame period per row of a frame; a frame period stated 10 % too short is still valid
# rows to which the numbers of exposure rows refer; in smaller frames it is scaled, and the row time is longer
FULL_ROWS = 2048
SCENES = ("city", "chart", "texture", "text")
SCENE_SEEDS = 2  # drawings of each scene; they are kept in memory

Generator = np.random.Generator
Tones = Array  # (K, 3): amplitude in px, frequency in Hz, phase in rad


@dataclass(frozen=True, eq=False)
class Case:
    """A recording and the timing that is passed to detection."""

    motion: Motion  # the true motion
    tones: tuple[Tones, Tones] | None  # true tones of the axes (x, y), if the motion consists of them; otherwise None
    num_frames: int = 4  # number of frames
    exposure: float = 20.0  # exposure in rows of a frame of ``FULL_ROWS`` rows
    noise: float = 0.005  # standard deviation of the noise
    scene: str | None = None  # name of the scene; None to draw one of ``SCENES``
    # layers in front of the scene, a function of height, width and generator
    in_front: Callable[[int, int, Generator], Layer] | None = None
    taken: Sequence[int] | None = None  # number of each frame in a regular sequence; None for 0, 1, 2 ..
    reverse: bool = False  # whether the last row is read first
    # errors of the stated timing: factors of ``row_time``, ``exposure_rows`` and ``frame_rows``
    stated: dict[str, float] = field(default_factory=dict)
    time_stamps: bool = False  # whether the true start times of the frames are stated
    # quality of the H.264 video (libx264) that the frames are decoded from; None for frames without encoding
    crf: int | None = None

    @property
    def timing_is_wrong(self) -> bool:
        """Whether the stated timing differs from the true one."""
        return bool(self.stated) or self.taken is not None or self.reverse


@dataclass(frozen=True, eq=False)
class Recording:
    """The frames of a case with the truth."""

    case: Case  # the case
    frames: Array  # (T, H, W) with noise
    timing: rsv.SensorTiming  # the stated timing
    starts: Array  # (T, H) true exposure starts of the rows
    exposure: float  # true exposure time in s
    layers: tuple[Layer, ...]  # the scene and what is in front of it

    def displacement(self) -> Array:
        """True displacement of the rows, (2, T, H) in px."""
        return row_displacement(self.case.motion, self.starts, self.exposure, self.frames.shape[-1])

    def displacement_by(self, tones: Tones) -> Array:
        """Displacement of the rows by tones (K, 3) along an axis, (T, H) in px."""
        of_tones = moving(partial(wave, tones), partial(wave, np.zeros((0, 3))))
        return np.asarray(row_displacement(of_tones, self.starts, self.exposure, self.frames.shape[-1])[0])

    def still(self, frame: int, x: float = 0.0, y: float = 0.0) -> Array:
        """A frame of a camera at rest that is displaced by a constant, without noise."""
        starts = self.starts[frame : frame + 1]
        return np.asarray(take_frames(self.layers, standing(x, y), starts, self.exposure, self.frames.shape[-1])[0])


def record(case: Case, generator: Generator, size: int) -> Recording:
    """Frames of a case; the generator draws the scene, the layers in front of it and the noise."""
    row_time = FRAME_PERIOD / (BLANKING * size)
    exposure_rows = case.exposure * size / FULL_ROWS
    name = str(generator.choice(SCENES)) if case.scene is None else case.scene
    layers = [scene_layer(name, int(generator.integers(SCENE_SEEDS)), size, size)]
    if case.in_front is not None:
        layers.append(case.in_front(size, size, generator))
    taken = np.array(range(case.num_frames) if case.taken is None else case.taken)
    order = np.arange(size)[::-1] if case.reverse else np.arange(size)
    starts = taken[:, None] * FRAME_PERIOD + order * row_time
    frames = take_frames(layers, case.motion, starts, exposure_rows * row_time, size)
    frames += case.noise * generator.standard_normal(frames.shape)
    if case.crf is not None:
        frames = decoded_h264(frames, case.crf)
    timing = rsv.SensorTiming(
        row_time=row_time * case.stated.get("row_time", 1.0),
        exposure_rows=exposure_rows * case.stated.get("exposure_rows", 1.0),
        frame_rows=BLANKING * size * case.stated.get("frame_rows", 1.0),
        frame_start_times=(FRAME_PERIOD * taken).tolist() if case.time_stamps else None,
    )
    return Recording(case, frames, timing, starts, exposure_rows * row_time, tuple(layers))


def decoded_h264(frames: Array, crf: int) -> Array:
    """Frames (T, H, W) after encoding as the luma of an H.264 video of limited range and decoding."""
    height, width = frames.shape[1:]
    counts = np.clip(np.round(16 + 219 * frames), 0, 255).astype(np.uint8)
    grey = np.full((height // 2, width), 128, np.uint8)  # both planes of chroma
    video = io.BytesIO()
    write_h264(video, (np.concatenate([luma, grey]) for luma in counts), round(1 / FRAME_PERIOD), crf=str(crf))
    video.seek(0)
    with av.open(video) as encoded:
        decoded = [frame.to_ndarray()[:height] for frame in encoded.decode(video=0)]
    return (np.stack(decoded).astype(np.float64) - 16) / 219


# Motions


def tones_of(generator: Generator, amplitude: Sequence[float], frequency: Sequence[float]) -> Tones:
    """Tones with random phases."""
    return np.stack([amplitude, frequency, generator.uniform(-np.pi, np.pi, len(amplitude))], axis=1)


def log_uniform(generator: Generator, low: float, high: float, count: int = 1) -> Array:
    """Numbers with a uniform distribution of the logarithm."""
    return np.exp(generator.uniform(np.log(low), np.log(high), count))


def one_tone(generator: Generator) -> Tones:
    """A tone that is easy to measure: 0.5 to 3 px, 20 to 90 Hz, without those at which all frames move alike."""
    frequency = generator.uniform(20.0, 90.0)
    while abs(frequency * FRAME_PERIOD - round(frequency * FRAME_PERIOD)) < 0.12:
        frequency = generator.uniform(20.0, 90.0)
    return tones_of(generator, log_uniform(generator, 0.5, 3.0).tolist(), [frequency])


def wave(tones: Tones, times: Array) -> Array:
    """Sum of tones at times."""
    total = np.zeros(times.shape)
    for amplitude, frequency, phase in tones:
        total += amplitude * np.sin(2 * np.pi * frequency * times + phase)
    return total


def moving(
    x: Callable[[Array], Array], y: Callable[[Array], Array], roll: Tones | None = None, zoom: Tones | None = None
) -> Motion:
    """The motion with displacements x(t), y(t) and tones of roll (rad) and zoom."""
    still = np.zeros((0, 3))
    parts = (x, y, partial(wave, still if roll is None else roll), partial(wave, still if zoom is None else zoom))
    return lambda times: np.stack([part(times) for part in parts])


def of_tones(x: Tones, y: Tones, **others: Any) -> Case:
    """A case of a motion that consists of tones."""
    return Case(moving(partial(wave, x), partial(wave, y)), (x, y), **others)


def plain(generator: Generator, **others: Any) -> Case:
    """One tone along each axis."""
    return of_tones(one_tone(generator), one_tone(generator), **others)


def fast_weak(generator: Generator, **others: Any) -> Case:
    """A slow strong tone and a fast weak one along each axis, eight frames with an exposure of 1 ms."""
    axes = []
    for _ in range(2):
        tones = np.concatenate([one_tone(generator), one_tone(generator)])
        tones[1, 0], tones[1, 1] = generator.uniform(0.1, 0.3), generator.uniform(250.0, 450.0)
        axes.append(tones)
    return of_tones(*axes, num_frames=8, exposure=1e-3 / FRAME_PERIOD * BLANKING * FULL_ROWS, **others)


def random(generator: Generator) -> Case:
    """Any tones, numbers of frames, exposures and noises."""
    axes = []
    for _ in range(2):
        count = int(generator.integers(1, 4))
        amplitude, frequency = log_uniform(generator, 0.05, 8.0, count), log_uniform(generator, 5.0, 300.0, count)
        axes.append(tones_of(generator, amplitude.tolist(), frequency.tolist()))
    return of_tones(
        *axes,
        num_frames=int(generator.integers(2, 7)),
        exposure=float(log_uniform(generator, 1.0, 300.0)[0]),
        noise=float(log_uniform(generator, 0.001, 0.02)[0]),
    )


def harmonics(generator: Generator) -> Case:
    """Five harmonics along x and one tone along y, in two frames."""
    base, order = generator.uniform(15.0, 40.0), np.arange(1, 6)
    amplitude = generator.uniform(0.5, 2.0) / order
    return of_tones(tones_of(generator, amplitude.tolist(), (base * order).tolist()), one_tone(generator), num_frames=2)


def turning(generator: Generator, what: str) -> Case:
    """A plain vibration with a sinusoidal roll or zoom of 0.1 to 1 px at the border of 384 px."""
    amplitude = float(log_uniform(generator, 0.1, 1.0)[0]) / (0.5 * 384)
    turn = one_tone(generator)  # like all tones, not at a frequency at which all frames move alike
    turn[0, 0] = amplitude
    x, y = partial(wave, one_tone(generator)), partial(wave, one_tone(generator))
    return Case(moving(x, y, **{what: turn}), None)


def shaped(generator: Generator, shape: Callable[[Generator], Callable[[Array], Array]]) -> Case:
    """A motion of a shape along each axis."""
    return Case(moving(shape(generator), shape(generator)), None)


def random_walk(generator: Generator) -> Callable[[Array], Array]:
    """Many tones below 40 Hz whose amplitudes decrease with 1/f, rms 1 px."""
    frequency = generator.uniform(2.0, 40.0, 80)
    amplitude = generator.standard_normal(80) / frequency
    amplitude *= np.sqrt(2.0) / np.linalg.norm(amplitude)
    return partial(wave, tones_of(generator, amplitude.tolist(), frequency.tolist()))


def ringdown(generator: Generator, tau: float = 0.03) -> Callable[[Array], Array]:
    """A tone of 2 to 4 px that decays exponentially with the time constant ``tau`` in s."""
    tone = tones_of(generator, [generator.uniform(2.0, 4.0)], [generator.uniform(30.0, 90.0)])
    return lambda times: np.exp(-times / tau) * wave(tone, times)


def chirp(generator: Generator, rate: float = 1000.0) -> Callable[[Array], Array]:
    """A tone of 0.5 to 2 px whose frequency increases by ``rate`` Hz per s."""
    amplitude, first, phase = generator.uniform(0.5, 2.0), generator.uniform(20.0, 60.0), generator.uniform(-3.0, 3.0)
    return lambda times: np.asarray(amplitude * np.sin(2 * np.pi * (first * times + 0.5 * rate * times**2) + phase))


def step(generator: Generator, rise: float = 1e-3) -> Callable[[Array], Array]:
    """A step of 1 to 3 px in the middle of the record, within about ``rise`` s."""
    size, moment = generator.uniform(1.0, 3.0), generator.uniform(1.2, 2.8) * FRAME_PERIOD
    return lambda times: np.asarray(0.5 * size * np.tanh((times - moment) / rise))


def close_pair(generator: Generator) -> Case:
    """Two tones 3 Hz apart along both axes."""
    axes = []
    for _ in range(2):
        first = float(one_tone(generator)[0, 1])
        axes.append(tones_of(generator, generator.uniform(0.5, 2.0, 2).tolist(), [first, first + 3.0]))
    return of_tones(*axes)


def close_slow_pair(generator: Generator) -> Case:
    """11.6 and 15.8 Hz in three frames, which last 1.4 periods of the first tone."""
    axes = [tones_of(generator, generator.uniform(1.0, 3.0, 2).tolist(), [11.6, 15.8]) for _ in range(2)]
    return of_tones(*axes, num_frames=3)


def long_period(generator: Generator, periods: float) -> Case:
    """3 px with less than a period in four frames."""
    frequency = periods / ((3 + 1 / BLANKING) * FRAME_PERIOD)
    return of_tones(*(tones_of(generator, [3.0], [frequency]) for _ in range(2)))


def large_amplitude(generator: Generator) -> Case:
    """25 px along x and 18 px along y."""
    axes = [tones_of(generator, [size], [generator.uniform(6.0, 20.0)]) for size in (25.0, 18.0)]
    return of_tones(*axes)


def sliding(layer: Callable[..., Layer], px_per_frame: float, height: int, width: int, generator: Generator) -> Layer:
    """A layer that moves in a random direction."""
    angle = generator.uniform(-np.pi, np.pi)
    speed = px_per_frame / FRAME_PERIOD
    return layer(height, width, generator, (speed * np.cos(angle), speed * np.sin(angle)))


Build = Callable[[Generator], Case]


def misstated(**factors: float) -> Build:
    """A plain vibration with an error of the timing."""
    return partial(plain, stated=factors)


TIMING_CORRECT: dict[str, Build] = {
    "plain": plain,
    "random": random,
    "harmonics": harmonics,
    "roll": partial(turning, what="roll"),
    "zoom": partial(turning, what="zoom"),
    "random walk": partial(shaped, shape=random_walk),
    "ringdown": partial(shaped, shape=ringdown),
    "chirp": partial(shaped, shape=chirp),
    "step": partial(shaped, shape=step),
    "close pair, 3 Hz apart": close_pair,
    "close pair, 1.5 periods": close_slow_pair,
    "long period, 0.58": partial(long_period, periods=0.58),
    "long period, 0.97": partial(long_period, periods=0.97),
    "large amplitude": large_amplitude,
    "fast weak tone": fast_weak,
    "H.264": partial(plain, num_frames=8, exposure=55.0, crf=23),
    "stars": partial(plain, scene="stars"),
    "objects": partial(plain, in_front=partial(sliding, cars, 20.0)),
    "cloud": partial(plain, in_front=partial(sliding, cloud, 4.0)),
    "parallax": partial(plain, in_front=partial(sliding, near_half, 4.0)),
}
TIMING_WRONG: dict[str, Build] = {
    **{f"frame_rows {error:+.0%}": misstated(frame_rows=1 + error) for error in (0.02, 0.05, -0.10)},
    **{f"row_time {error:+.0%}": misstated(row_time=1 + error) for error in (0.01, 0.03, 0.10)},
    **{
        f"row_time {error:+.0%}, start times given": partial(plain, stated={"row_time": 1 + error}, time_stamps=True)
        for error in (0.01, 0.03, 0.10)
    },
    "exposure 300, true 200": partial(plain, exposure=200.0, stated={"exposure_rows": 1.5}),
    **{
        f"fast weak tone, exposure x {factor}": partial(fast_weak, stated={"exposure_rows": factor})
        for factor in (0.05, 0.3, 0.6)
    },
    # 40 us for 55 us at the right frame rate and exposure time, with H.264 of about 2.5 Mb/s for 640 x 360 px
    "row_time x 0.73, H.264": partial(
        plain,
        num_frames=8,
        exposure=55.0,
        crf=23,
        stated={"row_time": 0.73, "frame_rows": 1 / 0.73, "exposure_rows": 1 / 0.73},
    ),
    "exposure x 0.5": partial(plain, exposure=100.0, stated={"exposure_rows": 0.5}),
    "exposure x 2": partial(plain, exposure=100.0, stated={"exposure_rows": 2.0}),
    "dropped frame": partial(plain, taken=(0, 1, 3, 4)),
    "swapped frames": partial(plain, taken=(0, 2, 1, 3)),
    "reversed readout": partial(plain, reverse=True),
}
CLASSES = TIMING_CORRECT | TIMING_WRONG
# classes whose motion is that of the model, observed with the stated timing: intervals must contain the truth
MODELLED = ("plain", "random", "harmonics", "close pair", "long period", "large amplitude", "stars")
MORE = {"random": 5}  # times as many cases as of the other classes


def recording(name: str, number: int, size: int) -> Recording:
    """Case ``number`` of a class."""
    generator = np.random.default_rng([zlib.crc32(name.encode()), number])
    return record(CLASSES[name](generator), generator, size)
