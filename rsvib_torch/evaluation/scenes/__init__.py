"""Drawn still scenes: a resolution chart, and a landscape from above."""

from rsvib_torch.evaluation.scenes.chart import resolution_chart
from rsvib_torch.evaluation.scenes.landscape import city_and_fields

__all__ = ["city_and_fields", "resolution_chart"]
