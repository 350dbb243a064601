"""Estimators of the noise level of frames."""
