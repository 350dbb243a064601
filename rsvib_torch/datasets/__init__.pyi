from .chart import resolution_chart
from .example_frames import example_frames
from .landscape import city_and_fields

__all__ = [
    "city_and_fields",
    "example_frames",
    "resolution_chart",
]
