from .by_motion import calibrate_row_time_by_motion
from .calibrate import RowTimeCalibration, calibrate_row_time

__all__ = [
    "RowTimeCalibration",
    "calibrate_row_time",
    "calibrate_row_time_by_motion",
]
