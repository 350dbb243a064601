"""Cameras and random numbers that all tests share."""

import pytest
import torch

from rsvib_torch import SensorTiming


@pytest.fixture(scope="session")
def paper_camera():
    """The camera of the paper: 20.52 us a row, 20 rows exposure, no blanking."""
    return SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


@pytest.fixture(autouse=True)
def same_random_numbers():
    """Numbers that a test draws without a generator of its own are the same in every run."""
    torch.manual_seed(0)
