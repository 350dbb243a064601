"""A landscape from above: towns with small buildings, fields, woods, roads and a river; and frames made from it."""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.datasets.drawing import FLOAT, Blur, Size, edge, fractal_texture, rectangle, rotated, smoothed
from rsvib_torch.imaging import simulate_frames
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration

_Seed = Annotated[int, Field(ge=0)]
_FIELDS, _TOWN, _WORKS, _WOOD = range(4)
# points of the ground per px along each axis, against aliasing; rms difference from 8 points: 1.0 % of full scale with
# 1 point, 0.4 % with 2, 0.1 % with 4 in four times the time
_OVERSAMPLING = 2


@dataclass(frozen=True)
class _Districts:
    """Districts on a jittered grid: (rows, columns) tables with one ring outside the image."""

    place: Tensor  # (rows, columns, 2), x and y in px
    angle: Tensor
    kind: Tensor
    parcel: Tensor  # (rows, columns, 2), size in px
    pitch: float

    @property
    def table(self) -> Tensor:
        """Place, parcel, cosine and sine of each district, (N, 6)."""
        angle = self.angle.view(-1, 1)
        return torch.cat([self.place.view(-1, 2), self.parcel.view(-1, 2), angle.cos(), angle.sin()], dim=-1)


class _Line(NamedTuple):
    """A main road or a river that winds through the image: ``normal . position = level + bend``."""

    angle: float
    level: float
    swing: float
    length: float
    phase: float
    half_width: float


@checks_arguments
def city_and_fields(height: Size, width: Size, seed: _Seed, *, sigma: Blur = 0.6) -> Tensor:
    """Draw towns and fields from above, with Gaussian optics: float32 (height, width) with values in 0 ... 1.

    Fractal ground in districts of different direction: fields with furrows and hedges, streets with rows of small
    gabled buildings and their shadows, larger works, woods, country roads and a river. The optics blur by ``sigma`` px
    (Gaussian, pixel area included).

    Example:
        >>> scene = city_and_fields(128, 96, seed=3)
        >>> scene.shape, bool(scene.min() >= 0 and scene.max() <= 1)
        (torch.Size([128, 96]), True)
    """
    generator = torch.Generator(device="cpu").manual_seed(seed)
    districts = _lay_out_districts(height, width, generator)
    lines = _lay_out_lines(height, width, generator)
    table = torch.rand(4096, 4, generator=generator, **FLOAT)  # for parcels
    relief = fractal_texture(height, width, generator, exponent=1.3, longest=500.0, sigma=sigma)
    detail = fractal_texture(height, width, generator, exponent=2.0, longest=7.0, sigma=sigma)

    strips, strip = [], 96  # rows at a time, to limit the memory
    for begin in range(0, height, strip):
        layers = _lay_out_ground((begin, min(begin + strip, height)), width, districts, lines, table)
        strips.append(functional.avg_pool2d(layers[:, None], _OVERSAMPLING)[:, 0])
    # the mean over a pixel is a blur of variance 1/12 px^2
    ground, wildness = smoothed(torch.cat(strips, dim=1), math.sqrt(sigma**2 - 1 / 12))
    image = ground * (1.0 + 0.09 * relief + (0.025 + 0.2 * wildness) * detail)
    return _draw_buildings(image, _plan_buildings(districts, lines, height, width, generator), sigma).clamp(0.0, 1.0)


def _lay_out_districts(height: int, width: int, generator: torch.Generator) -> _Districts:
    pitch = min(400.0, 0.5 * min(height, width))  # px, mean size of a district
    rows, columns = (math.ceil(size / pitch) + 2 for size in (height, width))

    def uniform(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator, **FLOAT)

    grid = torch.meshgrid(torch.arange(columns, **FLOAT), torch.arange(rows, **FLOAT), indexing="xy")
    place = (torch.stack(grid, -1) - 1 + 0.15 + 0.7 * uniform(rows, columns, 2)) * pitch
    # about equal parts of fields and town, and a quarter of works and woods, mixed at any image size
    draw = torch.remainder(torch.arange(rows * columns, **FLOAT) * 0.618034 + uniform(1), 1.0)
    kind = torch.bucketize(draw.view(rows, columns), torch.tensor([0.37, 0.75, 0.87], **FLOAT))
    sizes = torch.tensor([[110.0, 70.0], [104.0, 64.0], [150.0, 110.0], [1e4, 1e4]], **FLOAT)
    parcel = sizes[kind] * (0.85 + 0.4 * uniform(rows, columns, 2))
    return _Districts(place, math.pi * uniform(rows, columns), kind, parcel, pitch)


def _lay_out_lines(height: int, width: int, generator: torch.Generator) -> list[_Line]:
    """Main roads, and a river as the last line."""
    count = 4
    steps = torch.arange(count, device="cpu") + 0.8 * torch.rand(count, generator=generator, **FLOAT)
    angle = math.pi * steps / count
    share = 0.2 + 0.6 * torch.rand(count, 2, generator=generator, **FLOAT)
    through = torch.tensor([width, height], device="cpu") * share
    level = through[:, 0] * angle.cos() + through[:, 1] * angle.sin()
    size = float(max(height, width))
    random = torch.rand(3, count, generator=generator, **FLOAT)
    half_width = torch.tensor([6.0, 5.0, 5.0, 15.0], **FLOAT)
    swing = size * (0.02 + 0.02 * random[0])
    lines = torch.stack([angle, level, swing, size * (0.5 + 0.4 * random[1]), 2 * math.pi * random[2], half_width], 1)
    return [_Line(*line) for line in lines.tolist()]


def _distance_to_line(x: Tensor, y: Tensor, line: _Line) -> Tensor:
    along, across = rotated(x, y, line.angle - 0.5 * math.pi)
    turn = 2 * math.pi / line.length
    angle = along * turn + line.phase
    slope = line.swing * turn * angle.cos()
    return (across - line.level - line.swing * angle.sin()).abs() * torch.rsqrt(1 + slope.square())


def _two_nearest_districts(x: Tensor, y: Tensor, districts: _Districts) -> tuple[Tensor, Tensor]:
    """Indices of the nearest and the second nearest district at each point."""
    rows, columns = districts.kind.shape
    place_x, place_y = districts.place.view(-1, 2).T.contiguous()
    row = ((y / districts.pitch).floor().long() + 1).clamp(1, rows - 2)
    column = ((x / districts.pitch).floor().long() + 1).clamp(1, columns - 2)
    indices = torch.stack([(row + down) * columns + (column + right) for down in (-1, 0, 1) for right in (-1, 0, 1)])
    squared = (x - place_x[indices]).square_() + (y - place_y[indices]).square_()
    first, second = indices.gather(0, squared.topk(2, dim=0, largest=False).indices)
    return first, second


def _border_distance(x: Tensor, y: Tensor, first: Tensor, second: Tensor, districts: _Districts) -> Tensor:
    """Distance in px from the border between two districts, positive on the side of the first."""
    place_x, place_y = districts.place.view(-1, 2).T.contiguous()
    to_x, to_y = place_x[second] - place_x[first], place_y[second] - place_y[first]
    middle_x, middle_y = 0.5 * (place_x[second] + place_x[first]), 0.5 * (place_y[second] + place_y[first])
    return ((middle_x - x) * to_x + (middle_y - y) * to_y) / torch.hypot(to_x, to_y)


def _borders(strip: tuple[int, int], width: int, districts: _Districts) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Sample points x, y of a strip of rows with their districts, and the distances to the districts' borders.

    The two nearest districts are those of the pixel; which of the two is nearer is computed for each point.
    """
    rows, columns = (torch.arange(*limits, **FLOAT) for limits in (strip, (0, width)))
    pair = _two_nearest_districts(columns[None], rows[:, None], districts)
    y, x = (
        (torch.arange(begin * _OVERSAMPLING, end * _OVERSAMPLING, **FLOAT) + 0.5) / _OVERSAMPLING - 0.5
        for begin, end in (strip, (0, width))
    )
    x, y = x[None], y[:, None]
    first, second = (index.repeat_interleave(_OVERSAMPLING, 0).repeat_interleave(_OVERSAMPLING, 1) for index in pair)
    border = _border_distance(x, y, first, second, districts)
    return x, y, torch.where(border < 0, second, first), border.abs()


def _lay_out_ground(
    rows: tuple[int, int], width: int, districts: _Districts, lines: list[_Line], table: Tensor
) -> Tensor:
    """Tone of the ground and density of its vegetation, (2, points down, points across)."""
    x, y, nearest, border = _borders(rows, width, districts)
    kind = districts.kind.view(-1)[nearest]
    place_x, place_y, size_u, size_v, cosine, sine = districts.table.T.contiguous()[:, nearest]
    right, down = x - place_x, y - place_y
    u, v = right * cosine + down * sine, down * cosine - right * sine
    lot_v = (v / size_v).floor()
    # rows of fields are shifted against each other, streets are straight
    u = u + ((kind == _FIELDS) * table[(lot_v.long() * 37 + nearest).remainder(len(table)), 0]) * size_u
    lot_u = (u / size_u).floor()
    lot = (lot_u * 73 + lot_v * 179 + nearest * 283).long() * 2654435761
    draw = table[lot.remainder(len(table))].movedim(-1, 0)
    across_u, across_v = u - lot_u * size_u, v - lot_v * size_v
    edge_of_lot = torch.minimum(torch.minimum(across_u, size_u - across_u), torch.minimum(across_v, size_v - across_v))

    furrow = torch.sin(2 * math.pi * torch.where(draw[2] < 0.5, u, v) / (4.0 + 7.0 * draw[3]))
    field = 0.26 + 0.4 * draw[0] + (0.01 + 0.05 * draw[1]) * furrow
    field = torch.where(edge_of_lot < 1.4, 0.18, field)
    block = torch.where(edge_of_lot < 4.5, 0.52, 0.3 + 0.1 * draw[0])
    yard = torch.where(edge_of_lot < 5.5, 0.5, 0.4 + 0.12 * draw[0])
    tone = torch.where(kind == _FIELDS, field, torch.where(kind == _TOWN, block, yard))
    tone = torch.where(kind == _WOOD, 0.25, tone)
    wildness = torch.tensor([0.08, 0.45, 0.05, 1.0], **FLOAT)[kind]
    wildness = torch.where((kind == _TOWN) & (edge_of_lot < 4.5), 0.0, wildness)

    *roads, river = lines
    distance = _distance_to_line(x, y, river)
    for extra, level, wild in ((4.0, 0.3, 0.6), (0.0, 0.15, 0.1)):
        wet = distance < river.half_width + extra
        tone, wildness = torch.where(wet, level, tone), torch.where(wet, wild, wildness)
    lane = border < 3.5
    tone, wildness = torch.where(lane, 0.63, tone), torch.where(lane, 0.0, wildness)
    for line in roads:
        distance = _distance_to_line(x, y, line)
        road = distance < line.half_width
        tone = torch.where(distance < line.half_width + 2.0, 0.36, tone)
        tone = torch.where(road, torch.where(distance < 0.5, tone.new_tensor(0.82), 0.56), tone)
        wildness = torch.where(road, 0.0, wildness)
    return torch.stack([tone, wildness])


# --- Buildings ---


def _plan_buildings(
    districts: _Districts, lines: list[_Line], height: int, width: int, generator: torch.Generator
) -> Tensor:
    """Rows of buildings along the streets of every town and works district, and a few farms in the fields.

    The (N, 8) values are centre x and y, half of the two sides, direction of the first side in rad, tone of the roof,
    length of the shadow, all lengths in px, and 1 for a gabled roof, 0 for a flat one.
    """
    kinds = enumerate(districts.kind.view(-1).tolist())
    plans = [_plan_district(index, kind, districts, lines, generator) for index, kind in kinds if kind != _WOOD]
    plan = torch.cat([torch.zeros(0, 8, **FLOAT), *plans])
    return plan[(plan[:, :2] > -40).all(-1) & (plan[:, 0] < width + 40) & (plan[:, 1] < height + 40)]


def _plan_district(
    index: int, kind: int, districts: _Districts, lines: list[_Line], generator: torch.Generator
) -> Tensor:
    parcel = districts.parcel.view(-1, 2)[index]
    place, angle = districts.place.view(-1, 2)[index], float(districts.angle.view(-1)[index])
    street, share = {_FIELDS: (12.0, 0.12), _TOWN: (7.5, 0.93), _WORKS: (10.0, 0.85)}[kind]
    wanted = {_FIELDS: parcel.tolist(), _TOWN: [23.0, 27.0], _WORKS: [62.0, 44.0]}[kind]
    per_lot = ((parcel - 2 * street) / torch.tensor(wanted, **FLOAT)).round().clamp(min=1.0)
    lot = (parcel - 2 * street) / per_lot
    reach = (1.5 * districts.pitch / parcel).ceil()
    steps = []
    for n, size, count, step in zip(reach, parcel, per_lot, lot, strict=True):
        parcels, lots = torch.arange(-int(n), int(n), device="cpu"), torch.arange(int(count), **FLOAT)
        steps.append((parcels[:, None] * size + street + (lots + 0.5) * step).flatten())
    u, v = (t.flatten() for t in torch.meshgrid(*steps, indexing="xy"))
    random = torch.rand(len(u), 8, generator=generator, **FLOAT)
    largest = torch.minimum(0.5 * lot - 2.0, torch.tensor([24.0, 18.0], **FLOAT))
    half = largest * (0.62 + 0.38 * random[:, :2])
    slack = 0.5 * lot - 1.5 - half
    u = u + slack[:, 0] * (2 * random[:, 2] - 1)
    v = v + slack[:, 1] * (2 * random[:, 3] - 1)
    x, y = rotated(u, v, -angle)
    centre = torch.stack([x, y], dim=-1) + place
    nearest, second = _two_nearest_districts(centre[:, 0], centre[:, 1], districts)
    border = _border_distance(centre[:, 0], centre[:, 1], nearest, second, districts)
    room = torch.linalg.vector_norm(half, dim=-1)
    keep = (nearest == index) & (border > room + 4.0) & (random[:, 4] < share)
    for line in lines:
        keep &= _distance_to_line(centre[:, 0], centre[:, 1], line) > line.half_width + room + 3.0
    tone = 0.3 + 0.5 * random[:, 5]
    tone = torch.where(random[:, 6] < 0.12, 0.82, tone)
    rise = (3.0 + 5.0 * random[:, 7]) * (1.0 if kind == _TOWN else 1.3)
    gabled = torch.full_like(tone, float(kind != _WORKS))
    return torch.cat([centre, half, torch.stack([torch.full_like(tone, angle), tone, rise, gabled], 1)], 1)[keep]


def _draw_buildings(image: Tensor, plan: Tensor, sigma: float) -> Tensor:
    """Draw shadows, then roofs, over the ground (H, W)."""
    chunk = 256  # buildings at a time
    height, width = image.shape
    room = torch.linalg.vector_norm(plan[:, 2:4], dim=-1) + plan[:, 6] + 5 * sigma
    room, order = room.sort()
    plan = plan[order]
    pad = int(room.max()) + 64 if len(room) else 0
    # logarithm of the light, tone and coverage of the roofs
    layers = torch.zeros(3, height + 2 * pad, width + 2 * pad, **FLOAT)
    for begin in range(0, len(room), chunk):
        part = plan[begin : begin + chunk]
        reach = math.ceil(float(room[begin : begin + chunk].max()))
        steps = torch.arange(-reach, reach + 1, device="cpu")
        corner = part[:, :2].round().long()
        fraction = corner - part[:, :2]
        x = (steps + fraction[:, :1])[:, None, :]
        windows = _draw_windows(x, (steps + fraction[:, 1:])[:, :, None], part, sigma)
        rows = corner[:, 1, None, None] + steps[:, None] + pad
        columns = corner[:, 0, None, None] + steps + pad
        layers.view(3, -1).index_add_(1, (rows * layers.shape[-1] + columns).flatten(), windows.flatten(1))
    light, roofs, coverage = layers[:, pad : pad + height, pad : pad + width]
    return image * light.exp() * (1.0 - coverage) + roofs


def _draw_windows(x: Tensor, y: Tensor, plan: Tensor, sigma: float) -> Tensor:
    """Light, tone and coverage (3, N, h, w) of each building in its own window."""
    half_u, half_v, angle, tone, rise, gabled = plan[:, 2:, None, None].unbind(1)
    sun = math.radians(215.0)  # direction in which shadows fall
    shadow = torch.zeros((), **FLOAT)
    for share in (0.25, 0.5, 0.75, 1.0):  # copies of the outline
        u, v = rotated(x - share * rise * math.cos(sun), y - share * rise * math.sin(sun), angle)
        shadow = torch.maximum(shadow, rectangle(u, v, half_u, half_v, sigma))
    u, v = rotated(x, y, angle)
    coverage = rectangle(u, v, half_u, half_v, sigma)
    # the side of the roof that faces away from the light is darker
    tones = tone * (1.0 - 0.45 * gabled * torch.sin(sun - angle) * (edge(v, sigma) - 0.5))
    return torch.stack([torch.log1p(-0.62 * shadow), coverage * tones, coverage])  # 38 % of the light in a shadow


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
