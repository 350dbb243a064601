"""The two targets, a resolution chart similar to ISO 12233 and an aerial landscape, and frames of them.

A scene is drawn on a grid with half the pixel pitch and blurred so that this grid samples it without aliasing. Frames
take every second sample at the displaced positions, so that detail beyond the Nyquist frequency of the pixels appears
as aliasing, as in a real camera. The camera is ``benchmarks.independent_camera``, with rolling or global shutter.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from benchmarks import independent_camera
from benchmarks.independent_camera import Array, Shake, Timing, closed, fine_rows
from numpy.typing import NDArray
from reproduction.paper import AMPLITUDE, AXES, FRAME_ROWS, FREQUENCY, ROW_TIME, Target
from torch import Tensor

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields, resolution_chart

PITCH = 2  # samples of the scene per pixel
RIM = 32  # px of scene beyond the largest displacement, over which it fades so that it is periodic
_FINER = 4  # interpolated rows per row of the scene
_NODES = 5  # Gauss-Legendre nodes of an exposure: exact to 1e-6 for half a pixel of motion blur, to 1e-4 for 3 px
OPTICS = 0.5  # px; sigma of the Gaussian optics, in addition to square pixels
SEED = 2023
_FIELD = 230.0  # px of the camera, fields of the chart
_DRAWN: dict[Target, Callable[[int, int, float], Tensor]] = {
    "chart": lambda height, width, sigma: resolution_chart(
        height, width, sigma=sigma, seed=SEED, field=min(_FIELD * PITCH, 0.2 * min(height, width))
    ),
    "landscape": lambda height, width, sigma: city_and_fields(height, width, SEED, sigma=sigma),
}


def margins(shake: Shake, duration: float) -> tuple[int, int]:
    """Margin of the scene around the frame (down, across), px of the camera."""
    across, down = np.ceil(shake.reach(duration)).astype(int) + RIM
    return int(down), int(across)


@dataclass(frozen=True, eq=False)
class Scene:
    """A still scene around a frame.

    Attributes:
        samples: (PITCH (h + 2 down), PITCH (w + 2 across)), periodic.
        spectra: Its rows' spectra, interpolated across rows.
        still: (h, w), frame of a camera at rest, without noise.
        margin: (down, across) px.
    """

    samples: Array
    spectra: NDArray[np.complex128]
    still: Array
    margin: tuple[int, int]

    @classmethod
    def around(cls, drawn: Array, margin: tuple[int, int]) -> "Scene":
        """The scene of an image drawn at ``PITCH`` samples per pixel, with a margin in px."""
        samples = closed(drawn, (RIM - 8) * PITCH)
        down, across = (PITCH * m for m in margin)
        still = samples[down : len(samples) - down : PITCH, across : samples.shape[1] - across : PITCH]
        return cls(samples, fine_rows(samples, _FINER), still, margin)


def take_frames(scene: Scene, shake: Shake, timing: Timing, num_frames: int) -> Array:
    """Frames (T, h, w) without noise."""
    return independent_camera.take_frames(
        scene.samples,
        shake,
        timing,
        num_frames,
        scene.still.shape,
        points=PITCH,
        between=_FINER,
        nodes=_NODES,
        rows=scene.spectra,
    )


def with_noise(frames: Array, noise: float, bits: int, generator: np.random.Generator) -> Array:
    """Frames with Gaussian noise (fraction of full scale), as counts of this number of bits."""
    levels = 2**bits - 1
    noisy = frames + noise * generator.standard_normal(frames.shape)
    return np.round(np.clip(noisy, 0.0, 1.0) * levels) / levels


def shake_of(seed: int, image_motion: Sequence[float] = (0.0, 0.0)) -> Shake:
    """The paper's vibration with random phases of a seed."""
    amplitude, frequency = (np.array([[values[axis]] for axis in AXES]) for values in (AMPLITUDE, FREQUENCY))
    phase = np.random.default_rng(seed).uniform(-math.pi, math.pi, (2, 1))
    return Shake(amplitude, frequency, phase, np.array(image_motion))


@dataclass(frozen=True, eq=False)
class Edge:
    """A slanted edge that was found in the chart at rest.

    Attributes:
        axis: Axis of the measured MTF: x for a near-vertical edge.
        roi: Its position, with a margin for the displacement.
    """

    axis: str
    roi: rsv.SlantedEdge

    def crop(self, image: Array) -> Array:
        """The ROI of an image, transposed if necessary so that its edge is near-vertical."""
        roi: Array = self.roi.crop(image)  # type: ignore[arg-type, assignment]
        return roi if self.axis == "x" else roi.T


def draw(target: Target, size: tuple[int, int], image_motion: Sequence[float] = (0.0, 0.0)) -> Scene:
    """A target for frames of a size in px, with a margin for two frames of the paper's vibration."""
    margin = margins(shake_of(0, image_motion), 2 * FRAME_ROWS * ROW_TIME)
    height, width = (PITCH * (s + 2 * m) for s, m in zip(size, margin, strict=True))
    sigma = PITCH * math.sqrt(OPTICS**2 + 1 / 12)  # the variance of a pixel is 1/12 px^2
    return Scene.around(_DRAWN[target](height, width, sigma).double().numpy(), margin)


def edges_of(still: Array, count: int) -> list[Edge]:
    """The strongest slanted edges of the chart at rest for each axis, away from its border."""
    found = rsv.find_slanted_edges(torch.from_numpy(still))
    return [
        Edge(axis, roi)
        for axis in AXES
        for roi in [edge for edge in found if edge.near_vertical == (axis == "x") and _inside(edge, still)][:count]
    ]


def _inside(edge: rsv.SlantedEdge, still: Array, rim: int = 40) -> bool:
    height, width = still.shape
    return (
        min(edge.top, edge.left) >= rim
        and edge.top + edge.height <= height - rim
        and edge.left + edge.width <= width - rim
    )
