from .angular_rates import write_gcsv
from .community_sensor_model import camera_isd, write_isd
from .pixel_map import sampling_map, write_stmap

__all__ = [
    "camera_isd",
    "sampling_map",
    "write_gcsv",
    "write_isd",
    "write_stmap",
]
