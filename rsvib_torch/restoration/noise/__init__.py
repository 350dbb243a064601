"""Noise level of frames: a policy, and one module per estimator."""
