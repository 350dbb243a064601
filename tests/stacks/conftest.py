"""What the tests of stacks share."""

import pytest
from small_stack import FRAMES, WINDOWS, process_small, write_small


@pytest.fixture(scope="session", name="whole")
def process_whole(tmp_path_factory):
    """A folder with a stack and the outputs of uninterrupted runs."""
    folder = tmp_path_factory.mktemp("whole")
    write_small(folder / "frames.tif")
    for name in ("out.tif", "out.npy"):
        report = process_small(folder / "frames.tif", folder / name)
        assert (report.frames, report.windows, report.restored) == (FRAMES, WINDOWS, WINDOWS)
    return folder
