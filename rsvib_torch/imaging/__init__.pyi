from .blur import RowPSF, RowVaryingBlur, blur_rows, blur_rows_adjoint, row_psf, trajectory_psf
from .sensor_model import Optics, SensorNoise
from .simulate import simulate_frames
from .trajectory import exposure_trajectory, gauss_node_count, rows_showing

__all__ = [
    "Optics",
    "RowPSF",
    "RowVaryingBlur",
    "SensorNoise",
    "blur_rows",
    "blur_rows_adjoint",
    "exposure_trajectory",
    "gauss_node_count",
    "row_psf",
    "rows_showing",
    "simulate_frames",
    "trajectory_psf",
]
