"""A resolution chart similar to that of ISO 12233, and the scenes of tests and benchmarks."""

import math
from collections.abc import Callable
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.datasets import city_and_fields, drawing
from rsvib_torch.datasets.drawing import FLOAT, Blur, Size, edge, rectangle, rotated

_INK, _PAPER = 0.07, 0.86  # of full scale; a printed chart: grain and texture of either stay within 0 ... 1
_Centre = tuple[float, float]


def disc(x: Tensor, y: Tensor, radius: float, sigma: float) -> Tensor:
    """Coverage of a disc; its curvature over the width of the blur is neglected."""
    return edge(radius - torch.hypot(x, y), sigma)


def bars(cycles: Tensor, frequency: Tensor | float, count: int, sigma: float) -> Tensor:
    """Coverage of ``count`` bars, half a cycle wide each, from 0 to ``count - 1/2`` cycles, with a blur in px.

    The frequency in cycles/px is constant for a bar group and varies along the bars for a wedge.
    """
    coverage = torch.zeros_like(cycles)
    for index in range(2 * count):
        step = edge((cycles - 0.5 * index) / frequency, sigma)
        coverage = coverage - step if index % 2 else coverage + step
    return coverage


def sectors(x: Tensor, y: Tensor, count: int, sigma: float) -> Tensor:
    """Coverage of a star of ``count`` sectors; valid where the radius exceeds ``count / pi`` px (Nyquist)."""
    frequency = count / (2 * math.pi * torch.hypot(x, y).clamp(min=1e-3))
    cycles = torch.remainder(torch.atan2(y, x) * (count / (2 * math.pi)), 1.0) + 2.0
    return bars(cycles, frequency, 6, sigma).clamp(0.0, 1.0)


def paint(
    image: Tensor,
    sigma: float,
    centre: _Centre,
    reach: float | tuple[float, float],
    tone: float,
    coverage: Callable[[Tensor, Tensor], Tensor],
) -> None:
    """Paint a tone over an image.

    The window has the half size ``reach`` (x, y) in px around the centre (column, row), and a margin for the blur.
    ``coverage`` is a function of the coordinates x (1, w) and y (h, 1) in px from the centre.
    """
    halves = reach if isinstance(reach, tuple) else (reach, reach)
    places = []
    for middle, half, size in zip(centre, halves, reversed(image.shape), strict=True):
        pad = half + 5 * sigma
        places.append(slice(max(math.floor(middle - pad), 0), min(math.ceil(middle + pad) + 1, size)))
    window = image[places[1], places[0]]
    columns, rows = (torch.arange(place.start, place.stop, device="cpu") for place in places)
    window += coverage(columns[None] - centre[0], rows[:, None] - centre[1]) * (tone - window)


@checks_arguments
def resolution_chart(
    height: Size, width: Size, seed: int = 0, *, sigma: Blur = 0.6, field: Annotated[float, Field(ge=32)] = 230.0
) -> Tensor:
    """Draw a resolution chart: slanted edges, hyperbolic wedges, bar groups, stars, rings and grey fields.

    A star in the middle, wedges along both axes that end at Nyquist, slanted squares on the diagonals, and bar groups,
    rings, stars and textured grey steps between them, on paper with a fine grain. Edges are error functions of the
    distance, without aliasing at any size. The result is float32 (height, width) with values in 0 ... 1.

    The optics blur by ``sigma`` px (Gaussian, pixel area included); ``seed`` is that of grain and texture; ``field`` is
    the approximate size of a field of the chart in px.

    Example:
        >>> chart = resolution_chart(256, 320)
        >>> chart.shape, bool(chart.min() > 0)
        (torch.Size([256, 320]), True)
    """
    generator = torch.Generator(device="cpu").manual_seed(seed)
    grain = drawing.fractal_texture(height, width, generator, exponent=0.5, longest=64.0, sigma=sigma)
    texture = drawing.fractal_texture(height, width, generator, exponent=1.2, longest=40.0, sigma=sigma)
    canvas = torch.full((height, width), _PAPER, **FLOAT)

    rim = max(10.0, 0.014 * min(height, width))
    rows, columns = (max(3, 2 * round((size - 4 * rim) / (2 * field) - 0.5) + 1) for size in (height, width))
    pitch = ((width - 4 * rim) / columns, (height - 4 * rim) / rows)
    size = min(pitch)
    relief = torch.full((2, height, width), 0.02, **FLOAT)  # amplitude of grain and texture
    relief[1] = 0.012
    for i in range(rows):
        for j in range(columns):
            down, right = i - rows // 2, j - columns // 2
            centre = (2 * rim + (j + 0.5) * pitch[0] - 0.5, 2 * rim + (i + 0.5) * pitch[1] - 0.5)
            _draw_field(canvas, relief, sigma, centre, size, (down, right))
    middle = (0.5 * (width - 1), 0.5 * (height - 1))
    for board, centre, step, count in (
        (canvas, middle, pitch[0], columns),
        (canvas.T, middle[::-1], pitch[1], rows),
    ):
        for side in (-1, 1):
            _draw_wedge(board, sigma, centre, side, begin=0.55 * step, length=(min(2, count // 2) - 0.1) * step)
    _draw_border(canvas, sigma, rim)
    # grain and texture are proportional to the tone
    return (canvas * (1.0 + relief[0] * grain + relief[1] * texture)).clamp(0.0, 1.0)


def _draw_field(
    canvas: Tensor, relief: Tensor, sigma: float, centre: _Centre, size: float, steps: tuple[int, int]
) -> None:
    """Draw the field at a position (down, right) from the middle one."""
    down, right = steps
    ring = max(abs(down), abs(right))
    if ring == 0:
        _draw_star(canvas, sigma, centre, 0.42 * size, 72)
        return
    if 0 in (down, right) and ring <= 2:
        return  # the wedges
    if abs(down) == abs(right):
        dark = (ring + (down > 0) + (right > 0)) % 2 == 0
        turn = math.copysign(math.radians(5.0), down * right)
        _draw_slanted_square(canvas, relief, sigma, centre, size, dark=dark, turn=turn)
        return
    kind = (3 * abs(down) + 2 * abs(right) + (down > 0) + 2 * (right > 0)) % len(_FIELDS)
    _FIELDS[kind](canvas, relief, sigma, centre, size, ring)


def _draw_star(canvas: Tensor, sigma: float, centre: _Centre, radius: float, count: int) -> None:
    count = max(8, min(count, int(radius)))
    paint(canvas, sigma, centre, radius, _INK, lambda x, y: sectors(x, y, count, sigma) * disc(x, y, radius, sigma))
    paint(canvas, sigma, centre, radius, _INK, lambda x, y: disc(x, y, count / math.pi + 1.0, sigma))
    width = 0.02 * radius + 0.8
    for outline in (1.0, 1.1):

        def ring(x: Tensor, y: Tensor, r: float = outline * radius) -> Tensor:
            return disc(x, y, r + width, sigma) - disc(x, y, r, sigma)

        paint(canvas, sigma, centre, outline * radius + width, _INK, ring)


def _draw_wedge(canvas: Tensor, sigma: float, middle: _Centre, side: int, *, begin: float, length: float) -> None:
    """Draw seven bars along x whose frequency rises towards the middle of the chart."""
    count = 7
    coarse, fine = max(0.025, 2.0 * count / length), 0.5

    def coverage(x: Tensor, y: Tensor) -> Tensor:
        frequency = (fine + (coarse - fine) * (side * x / length + 0.5)).clamp(coarse, fine)
        return bars(y * frequency + 0.5 * (count - 0.5), frequency, count, sigma) * _between(x, 0.5 * length, sigma)

    centre = (middle[0] + side * (begin + 0.5 * length), middle[1])
    paint(canvas, sigma, centre, (0.5 * length, 0.5 * count / coarse), _INK, coverage)


def _between(x: Tensor, half: float, sigma: float) -> Tensor:
    """Coverage of the strip ``|x| <= half``, much wider than the blur."""
    return edge(x + half, sigma) * edge(half - x, sigma)


def _draw_slanted_square(
    canvas: Tensor, relief: Tensor, sigma: float, centre: _Centre, size: float, *, dark: bool, turn: float
) -> None:
    half = 0.3 * size
    ground, tone = (0.62, 0.12) if dark else (0.2, 0.74)

    def frame(x: Tensor, y: Tensor) -> Tensor:
        return rectangle(x, y, 0.46 * size, 0.46 * size, sigma)

    paint(canvas, sigma, centre, 0.46 * size, ground, frame)
    for layer in relief:  # no grain, for measurements of the edges
        paint(layer, sigma, centre, 0.46 * size, 0.0, frame)
    paint(canvas, sigma, centre, 1.2 * half, tone, lambda x, y: rectangle(*rotated(x, y, turn), half, half, sigma))


def _draw_bar_groups(canvas: Tensor, relief: Tensor, sigma: float, centre: _Centre, size: float, ring: int) -> None:
    """Groups of five bars, vertical and horizontal, of four frequencies."""
    count, length = 5, 0.085 * size
    for place, share in enumerate((1.0, 0.7, 0.48, 0.32)):
        reach, down = 0.18 * size * share, centre[1] + (0.345 - 0.23 * place) * size
        for board, middle, half in (
            (canvas, (centre[0] - 0.23 * size, down), reach),
            (canvas.T, (down, centre[0] + 0.23 * size), length * share),
        ):

            def coverage(x: Tensor, y: Tensor, f: float = 0.5 * (count - 0.5) / half) -> Tensor:
                return bars(x * f + 0.5 * (count - 0.5), f, count, sigma) * _between(y, length, sigma)

            paint(board, sigma, middle, (reach, length), _INK, coverage)


def _draw_rings(canvas: Tensor, relief: Tensor, sigma: float, centre: _Centre, size: float, ring: int) -> None:
    """Rings that grow narrower outwards."""
    radius = 0.44 * size
    finest = 0.22 if ring % 2 else 0.12

    def coverage(x: Tensor, y: Tensor) -> Tensor:
        r = torch.hypot(x, y)
        frequency = (finest * r / radius).clamp(min=0.5 * finest / radius)
        cycles = 0.25 + 0.5 * finest * r.square() / radius  # a bar is centred on the rings
        return bars(torch.remainder(cycles, 1.0) + 2.0, frequency, 6, sigma) * edge(radius - r, sigma)

    paint(canvas, sigma, centre, radius, _INK, coverage)


def _draw_grey_steps(canvas: Tensor, relief: Tensor, sigma: float, centre: _Centre, size: float, ring: int) -> None:
    """Three by three textured patches of different tone."""
    half = 0.145 * size
    for i in range(3):
        for j in range(3):
            tone = 0.12 + 0.07 * ((4 * i + 2 * j + 5 * ring) % 9)
            middle = (centre[0] + (j - 1) * 0.31 * size, centre[1] + (i - 1) * 0.31 * size)

            def patch(x: Tensor, y: Tensor) -> Tensor:
                return rectangle(x, y, half, half, sigma)

            paint(canvas, sigma, middle, half, tone, patch)
            paint(relief[1], sigma, middle, half, 0.1, patch)


def _draw_needles(canvas: Tensor, relief: Tensor, sigma: float, centre: _Centre, size: float, ring: int) -> None:
    """A fan of slanted lines of different width, and a disc."""
    for index in range(8):
        angle = math.pi * (index + 0.25) / 8
        width = 0.7 + 0.006 * size * (index % 4)

        def needle(x: Tensor, y: Tensor, angle: float = angle, width: float = width) -> Tensor:
            return rectangle(*rotated(x, y, angle), 0.45 * size, width, sigma)

        paint(canvas, sigma, centre, 0.45 * size, _INK, needle)
    paint(canvas, sigma, centre, 0.13 * size, _INK, lambda x, y: disc(x, y, 0.13 * size, sigma))
    paint(canvas, sigma, centre, 0.1 * size, _PAPER, lambda x, y: disc(x, y, 0.1 * size, sigma))


_FIELDS: tuple[Callable[[Tensor, Tensor, float, _Centre, float, int], None], ...] = (
    _draw_bar_groups,
    _draw_grey_steps,
    _draw_rings,
    _draw_bar_groups,
    _draw_needles,
    lambda canvas, relief, sigma, centre, size, ring: _draw_star(
        canvas, sigma, centre, 0.36 * size, 36 if ring % 2 else 24
    ),
    _draw_grey_steps,
)


def _draw_border(canvas: Tensor, sigma: float, depth: float) -> None:
    """Draw black teeth that point inwards along all four borders, wider towards one end."""
    for board in (canvas, canvas.T):
        height, width = board.shape
        for row, inwards in ((0.0, 1), (height - 1.0, -1)):

            def coverage(x: Tensor, y: Tensor, inwards: int = inwards, width: int = width) -> Tensor:
                place = (x / width + 0.5).clamp(0.0, 1.0)
                cycles = (width / (2.4 * depth)) * (place - 0.15 * place * (1 - place))
                tooth = depth * (1.0 - 2.0 * (torch.remainder(cycles, 1.0) - 0.5).abs())
                return edge((tooth - inwards * y) / math.sqrt(2.0), sigma)

            paint(board, sigma, (0.5 * (width - 1), row), (0.5 * width, depth), _INK, coverage)


SCENES: dict[str, Callable[[int, int, int], Tensor]] = {"city": city_and_fields, "chart": resolution_chart}
