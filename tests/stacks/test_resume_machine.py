"""Random sequences of interruptions, damages and resumptions of a run: the result is complete, or none is claimed."""

import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule
from small_stack import FRAMES, process_small, write_small

from rsvib_torch.io import open_stack


class _StoppedError(KeyboardInterrupt):
    """Ctrl-C at a chosen frame."""


def pixels(path):
    reader = open_stack(path)
    try:
        return np.stack([reader.frame(index) for index in range(reader.info.shape[0])])
    finally:
        reader.close()


def window_results(report):
    """The manifest without the name of the output."""
    table = json.loads(report.manifest.read_text())
    del table["output"]
    return table


class Resume(RuleBasedStateMachine):
    """A run that is interrupted, damaged and resumed, compared with an undisturbed run."""

    def __init__(self):
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="resume-"))
        self.source = self.folder / "frames.tif"
        write_small(self.source)
        self.content = self.source.read_bytes()

    @initialize(ending=st.sampled_from([".npy", ".tif", "", ".zarr", ".h5"]))
    def choose_format(self, ending):
        self.sink = self.folder / f"out{ending}"
        reference = process_small(self.source, self.folder / f"reference{ending}")
        self.expected, self.windows = pixels(self.folder / f"reference{ending}"), window_results(reference)

    def parts(self):
        work = self.sink.with_name(f".{self.sink.name}.rsvib")
        return sorted(path for path in work.rglob("*") if path.is_file()) if work.is_dir() else []

    def process(self, resume, frames=None):
        def progress(done, total):
            if frames is not None and done >= frames:
                raise _StoppedError

        return process_small(self.source, self.sink, resume=resume, progress=progress)

    def finish(self, resume):
        report = self.process(resume)
        np.testing.assert_array_equal(pixels(self.sink), self.expected)
        assert window_results(report) == self.windows
        assert self.parts() == []

    @rule(frames=st.integers(1, FRAMES - 1))
    def interrupt(self, frames):
        if self.sink.exists():
            return
        try:
            self.process(bool(self.parts()), frames)
        except _StoppedError:
            assert not self.sink.exists()
        except (OSError, ValueError):  # a damage was found
            assert not self.sink.exists()
            self.discard()

    @precondition(lambda self: self.parts())
    @rule(data=st.data(), kind=st.sampled_from(["delete", "cut", "flip", "empty"]))
    def damage(self, data, kind):
        path = data.draw(st.sampled_from(self.parts()), label="part")
        content = path.read_bytes()
        place = data.draw(st.integers(0, max(0, len(content) - 1)), label="place")
        if kind == "delete":
            path.unlink()
        elif kind == "flip" and content:
            path.write_bytes(content[:place] + bytes([content[place] ^ 0x55]) + content[place + 1 :])
        else:
            path.write_bytes(content[:place] if kind == "cut" else b"")

    @precondition(lambda self: self.parts())
    @rule()
    def resume(self):
        try:
            self.finish(resume=True)
        except (OSError, ValueError) as error:  # refused: nothing is claimed, and a fresh run is possible
            assert "\n" not in str(error)  # noqa: PT017 - other exceptions pass
            assert not self.sink.exists()
            self.discard()
            self.finish(resume=False)

    @precondition(lambda self: self.sink.exists())
    @rule()
    def resume_a_complete_run(self):
        self.finish(resume=True)

    def discard(self):
        shutil.rmtree(self.sink.with_name(f".{self.sink.name}.rsvib"), ignore_errors=True)

    def teardown(self):
        assert self.source.read_bytes() == self.content
        shutil.rmtree(self.folder)


Resume.TestCase.settings = settings(
    max_examples=20,
    stateful_step_count=8,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
TestResume = pytest.mark.slow(Resume.TestCase)
