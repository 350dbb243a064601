from .angular_rates import write_gcsv as write_gcsv
from .pixel_map import sampling_map as sampling_map
from .pixel_map import write_stmap as write_stmap
