"""Still scenes drawn by the program itself: a resolution chart, and a landscape seen from above."""

from rsvib_torch.evaluation.targets.chart import resolution_chart
from rsvib_torch.evaluation.targets.landscape import city_and_fields

__all__ = ["city_and_fields", "resolution_chart"]
