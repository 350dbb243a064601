from .chart import resolution_chart as resolution_chart
from .example_frames import example_frames as example_frames
from .landscape import city_and_fields as city_and_fields
