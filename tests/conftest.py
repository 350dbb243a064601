"""Fixtures of all tests: the camera of the paper, and seeded random numbers."""

import pytest
import torch

from rsvib_torch import SensorTiming


@pytest.fixture(scope="session")
def paper_camera():
    """The camera of the paper: 20.52 us per row, exposure of 20 rows, no blanking."""
    return SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


@pytest.fixture(autouse=True)
def same_random_numbers():
    """Seed the global generators, so that tests without a generator of their own are reproducible."""
    torch.manual_seed(0)
