"""Calibration of row time, readout direction and exposure from frames of flickering light."""

from rsvib_torch.calibration.calibrate import RowTimeCalibration, calibrate_row_time, calibrate_row_time_by_exposure

__all__ = ["RowTimeCalibration", "calibrate_row_time", "calibrate_row_time_by_exposure"]
