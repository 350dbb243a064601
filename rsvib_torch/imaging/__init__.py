"""Image formation: motion within an exposure, point spread functions, blur, optics, noise and simulation of frames."""

from rsvib_torch.imaging.blur import RowVaryingBlur, blur_rows, blur_rows_adjoint
from rsvib_torch.imaging.psf import RowPSF, row_psf, trajectory_psf
from rsvib_torch.imaging.sensor_model import Optics, SensorNoise
from rsvib_torch.imaging.simulate import simulate_frames
from rsvib_torch.imaging.trajectory import exposure_nodes, exposure_trajectory, gauss_node_count, rows_showing

__all__ = [
    "Optics",
    "RowPSF",
    "RowVaryingBlur",
    "SensorNoise",
    "blur_rows",
    "blur_rows_adjoint",
    "exposure_nodes",
    "exposure_trajectory",
    "gauss_node_count",
    "row_psf",
    "rows_showing",
    "simulate_frames",
    "trajectory_psf",
]
