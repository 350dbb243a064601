"""Many small buildings with gabled roofs and shadows, drawn in batches."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from rsvib_torch.evaluation.scenes.drawing import edge, rectangle, rotated

__all__ = ["BuildingPlan", "draw_buildings"]

_SUN = math.radians(215.0)  # direction in which shadows fall
_SHADE = 0.62  # share of the light that a shadow takes away
_SHADOW_STEPS = 4  # copies of the outline that a shadow is made of
_CHUNK = 256  # buildings drawn at a time


@dataclass(frozen=True)
class BuildingPlan:
    """N buildings that do not overlap.

    Attributes:
        centre: (N, 2) px, x and y.
        half: (N, 2) px, half of the sides.
        angle: (N,) rad, direction of the first side.
        tone: (N,) of the roofs.
        rise: (N,) px, length of the shadows.
        gabled: (N,) 1 where the two sides of the roof differ in tone, 0 where the roof is flat.
    """

    centre: Tensor
    half: Tensor
    angle: Tensor
    tone: Tensor
    rise: Tensor
    gabled: Tensor

    @staticmethod
    def joined(plans: Sequence["BuildingPlan"]) -> "BuildingPlan":
        """All buildings of several plans."""
        empty = [torch.zeros(0, 2), torch.zeros(0, 2), *(torch.zeros(0) for _ in range(4))]
        return BuildingPlan(
            *(
                torch.cat([none, *(getattr(plan, field.name) for plan in plans)])
                for field, none in zip(fields(BuildingPlan), empty, strict=True)
            )
        )

    def where(self, chosen: Tensor) -> "BuildingPlan":
        """The buildings at an index or mask."""
        return BuildingPlan(*(getattr(self, field.name)[chosen] for field in fields(self)))


def draw_buildings(image: Tensor, plan: BuildingPlan, sigma: float) -> Tensor:
    """Draw shadows, then roofs, over the ground.

    Args:
        image: (H, W) ground.
        plan: The buildings.
        sigma: Blur of the optics in px.

    Returns:
        Image of the same shape.
    """
    height, width = image.shape
    room = torch.linalg.vector_norm(plan.half, dim=-1) + plan.rise + 5 * sigma
    order = room.argsort()
    plan, room = plan.where(order), room[order]
    pad = int(room.max()) + 64 if len(room) else 0
    # what is left of the light, as a logarithm; the roofs' tone; the roofs' coverage
    layers = torch.zeros(3, height + 2 * pad, width + 2 * pad)
    for begin in range(0, len(room), _CHUNK):
        part = plan.where(slice(begin, begin + _CHUNK))  # type: ignore[arg-type]
        reach = math.ceil(float(room[begin : begin + _CHUNK].max()))
        steps = torch.arange(-reach, reach + 1)
        corner = part.centre.round().long()
        fraction = corner - part.centre
        x = (steps + fraction[:, :1])[:, None, :]
        y = (steps + fraction[:, 1:])[:, :, None]
        windows = _draw_chunk(x, y, part, sigma)
        rows = corner[:, 1, None, None] + steps[:, None] + pad
        columns = corner[:, 0, None, None] + steps + pad
        index = (rows * layers.shape[-1] + columns).flatten()
        layers.view(3, -1).index_add_(1, index, windows.flatten(1))
    light, roofs, coverage = layers[:, pad : pad + height, pad : pad + width]
    drawn: Tensor = image * light.exp() * (1.0 - coverage) + roofs
    return drawn


def _draw_chunk(x: Tensor, y: Tensor, plan: BuildingPlan, sigma: float) -> Tensor:
    """Light, tone and coverage (3, N, h, w) of each building in its own window."""
    angle, tone, rise, gabled = (t[:, None, None] for t in (plan.angle, plan.tone, plan.rise, plan.gabled))
    half_u, half_v = plan.half[:, 0, None, None], plan.half[:, 1, None, None]
    shadow = torch.zeros(())
    for step in range(1, _SHADOW_STEPS + 1):
        share = step / _SHADOW_STEPS
        u, v = rotated(x - share * rise * math.cos(_SUN), y - share * rise * math.sin(_SUN), angle)
        shadow = torch.maximum(shadow, rectangle(u, v, half_u, half_v, sigma))
    u, v = rotated(x, y, angle)
    coverage = rectangle(u, v, half_u, half_v, sigma)
    # the side of the roof that faces away from the light is darker
    facing = torch.sin(_SUN - angle)
    tones = tone * (1.0 - 0.45 * gabled * facing * (edge(v, sigma) - 0.5))
    return torch.stack([torch.log1p(-_SHADE * shadow), coverage * tones, coverage])
