from .angular_rates import write_gcsv as write_gcsv
from .community_sensor_model import camera_isd as camera_isd
from .community_sensor_model import write_isd as write_isd
from .pixel_map import sampling_map as sampling_map
from .pixel_map import write_stmap as write_stmap
