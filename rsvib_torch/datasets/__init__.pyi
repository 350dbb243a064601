from .landscape import city_and_fields as city_and_fields
from .landscape import example_frames as example_frames
