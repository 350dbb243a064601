"""Sources and outputs of live sessions."""

import os
import resource
import signal
import time
from dataclasses import dataclass

import numpy as np
import pytest
from attacks.live_sessions import streaming_camera
from refusals import refuses
from truth import draw_scene

import rsvib_torch as rsv
from rsvib_torch import video
from rsvib_torch.video.session import FrameCounter, FrameReader

TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=1 / 30 / 1e-4)


@dataclass
class Numbers:
    """Frames of one pixel, as fast as possible."""

    count: int = 50
    waits: bool = False
    lost: int = 0
    closed: bool = False
    error: Exception | None = None

    def frames(self):
        try:
            for index in range(self.count):
                yield video.TimedFrame(np.full((1, 1), float(index)), index / 30, time.perf_counter())
            if self.error is not None:
                raise self.error
        finally:
            self.closed = True


def values(reader):
    return [int(frame.pixels[0, 0]) for frame in reader]


@pytest.mark.parametrize(("waits", "lost"), [(False, 42), (True, 0)])
def test_the_oldest_waiting_frames_are_dropped_and_counted_unless_the_source_waits(waits, lost):
    reader = FrameReader(source := Numbers(waits=waits), waiting=8)
    reader.start()
    time.sleep(0.2)
    assert values(reader) == list(range(lost, 50))
    assert reader.dropped == lost
    reader.close()
    assert source.closed


@pytest.mark.parametrize("waits", [False, True])
def test_a_reader_that_is_stopped_releases_the_source_with_the_next_frame(waits):
    reader = FrameReader(source := Numbers(10**9, waits=waits))
    reader.start()
    reader.close()
    assert source.closed


def test_an_error_of_the_source_arrives_behind_its_frames():
    reader = FrameReader(Numbers(3, error=OSError("unplugged")))
    reader.start()
    refuses(lambda: values(reader), "unplugged", OSError)


@pytest.mark.parametrize("stamps", ["none", "made up", "of the camera"])
@pytest.mark.parametrize("drift", [-3e-4, 0.0, 3e-4])
def test_missing_frames_of_a_camera_are_counted_and_late_ones_are_not(stamps, drift):
    """Delays of arrival are random, with a mean of a fifth of a frame period (5 minutes)."""
    generator = np.random.default_rng(1)
    numbers = np.flatnonzero(np.arange(9000) % 1000 != 500)  # nine frames are lost
    taken = numbers / 30 * (1 + drift)
    arrived = np.maximum.accumulate(taken + generator.exponential(0.2 / 30, len(taken)))
    given = {"none": 0 * taken, "made up": np.arange(len(taken)) / 25, "of the camera": 17.3 + taken}[stamps]
    counter = FrameCounter(1 / 30)
    found = np.array([counter.number(*times) for times in zip(arrived, given, strict=True)])
    wrong = np.count_nonzero(np.diff(found - numbers))
    assert (np.diff(found) > 0).all()
    if stamps == "of the camera":
        # the delay of the first frames hides how fast the clock of the stamps runs
        assert wrong <= 1
    else:
        assert wrong <= 25  # rounding of the intervals to whole periods: 350 to 390
        assert abs(found[-1] - numbers[-1]) <= 10


def test_a_camera_at_an_address():
    coloured = np.zeros((12, 48, 64, 3), np.uint8)  # blue, green, red
    coloured[..., 2] = 20 * np.arange(12)[:, None, None]
    with streaming_camera(frames=12, begins=True, pictures=list(coloured)) as camera:
        source = video.CameraSource(camera.url, TIMING)
        frames = list(source.frames())
    assert len(frames) >= 10  # the last one may be incomplete
    reds = np.array([frame.pixels[0].mean() for frame in frames])
    assert frames[0].pixels.shape == (3, 48, 64)
    assert np.abs(reds - 20 * np.arange(len(frames))).max() < 4
    assert max(frame.pixels[2].max() for frame in frames) < 40  # blue
    numbers = np.array([frame.time for frame in frames]) * 30
    assert numbers[-1] == pytest.approx(len(frames) - 1 + source.lost)
    assert np.diff(numbers).min() > 0.99
    with pytest.raises(OSError, match="cannot be opened; check its number or URL"):
        next(video.CameraSource("http://127.0.0.1:1/none", TIMING).frames())


@pytest.mark.parametrize("ending", [".mp4", ".mkv"])
def test_video_files(tmp_path, ending):
    frames = (np.random.default_rng(0).random((5, 32, 48, 3)) * 50 + np.arange(5)[:, None, None, None] * 40).astype(
        "u1"
    )
    output = video.VideoOutput(tmp_path / f"video{ending}", 30.0)
    for index, frame in zip((0, 1, 2, 5, 6), frames, strict=True):  # two are missing
        output.write(frame, index)
    assert len(rsv.read_stack(tmp_path / f"video{ending}")) >= 3  # it can be read while it is written
    output.close()
    info = rsv.read_stack_info(tmp_path / f"video{ending}")
    assert info.shape == (5, 3, 32, 48)
    assert np.diff(info.frame_times) == pytest.approx(np.array([1, 1, 3, 1]) / 30, abs=2e-3)
    read = rsv.read_stack(tmp_path / f"video{ending}").numpy() * 255
    tolerance = 0.5 if ending == ".mkv" else 12  # H.264 is lossy
    assert np.abs(read.mean((1, 2, 3)) - frames.mean((1, 2, 3))).max() < tolerance


def test_a_video_replaces_a_file_if_that_is_asked_for(tmp_path):
    path, frame = tmp_path / "video.mkv", np.zeros((32, 32), np.uint8)
    output = video.VideoOutput(path, 30.0)
    assert not path.exists()  # it is created with the first frame
    output.close()
    path.write_bytes(b"created during the session")
    refuses(lambda: output.write(frame, 0), r"video\.mkv was created by another program", FileExistsError)
    assert path.read_bytes() == b"created during the session"
    path.rename(tmp_path / "other")
    path.symlink_to(tmp_path / "other")
    output = video.VideoOutput(path, 30.0, overwrite=True)
    output.write(frame, 0)
    output.close()
    assert rsv.read_stack_info(path).shape == (1, 32, 32)
    assert (tmp_path / "other").read_bytes() == b"created during the session"
    refuses(lambda: video.VideoOutput(tmp_path / "video.gif", 30.0), r"a live video is written to \.mp4")


def test_a_full_disk_is_named_and_leaves_the_frames_before(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    frames = list(np.random.default_rng(0).integers(0, 256, (64, 64, 64), np.uint8))  # 5 kB each
    for ending in (".mkv", ".mp4"):
        output = video.VideoOutput(path := tmp_path / f"video{ending}", 30.0)
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
        try:
            with pytest.raises(OSError, match=f"video{ending}: File too large; the video has the frames before"):
                list(map(output.write, frames, range(64)))
            output.close()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert rsv.read_stack_info(path).shape[0] > 4


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_end_a_session(tmp_path, number):
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    output, before = video.VideoOutput(tmp_path / "video.mkv", 30.0), signal.signal(number, usual)  # nohup ignores some

    class Ending:
        """An output that gets two signals; the second one does not end the process."""

        def write(self, frame, index):
            if index == 5:
                signal.raise_signal(number)
                signal.raise_signal(number)

        def close(self):
            pass

    report = video.run_live(Numbers(), rsv.VibrationTracker(TIMING), [output, Ending()])
    assert report.frames == len(rsv.read_stack(tmp_path / "video.mkv"))
    assert 6 <= report.frames <= 8  # at most two frames are tracked ahead of the written one
    assert signal.signal(number, before) == usual


def test_the_end_of_a_reader_ends_a_session():
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb", buffering=0) as stream:
        report = video.run_live(Numbers(), rsv.VibrationTracker(TIMING), [video.PipeOutput(stream)])
    assert report.frames == 0


def test_frames_before_an_error_of_the_source_are_not_lost(tmp_path):
    source = Numbers(3, error=OSError("unplugged"))
    output = video.VideoOutput(tmp_path / "video.mkv", 30.0)
    refuses(lambda: video.run_live(source, rsv.VibrationTracker(TIMING), [output]), "unplugged", OSError)
    assert rsv.read_stack_info(tmp_path / "video.mkv").shape == (3, 1, 1)
    assert source.closed


class Shaking:
    """Frames of a vibrating camera at its rate."""

    lost = 0

    def __init__(self, pixels, waits=False):
        self.pixels, self.waits = pixels, waits

    def frames(self):
        begin = time.perf_counter()
        for index, pixels in enumerate(self.pixels):
            time.sleep(max(0.0, begin + index * TIMING.frame_period - time.perf_counter()))
            yield video.TimedFrame(pixels, index * TIMING.frame_period, time.perf_counter())


class SlowTracker(rsv.VibrationTracker):
    """A tracker that needs 1.2 frame periods to measure a frame."""

    def update(self, *arguments, measure=True):
        begin = time.perf_counter()
        tracked = super().update(*arguments, measure=measure)
        time.sleep(max(0.0, begin + 1.2 * TIMING.frame_period - time.perf_counter()) if measure else 0.0)
        return tracked


@pytest.mark.parametrize("waits", [False, True])
def test_the_motion_of_late_frames_is_predicted_unless_the_source_waits(waits):
    vibration = rsv.Vibration([2.1, 1.6], [0.37 / TIMING.frame_period] * 2, [0.5, 1.0])
    frames = rsv.simulate_frames(draw_scene(200, 200, seed=3), TIMING, vibration, 40, frame_size=(160, 160)).numpy()
    report = video.run_live(Shaking(frames, waits), SlowTracker(TIMING, columns=None), [])
    assert (report.frames, report.dropped) == (40, 0)
    assert (report.predicted > 5) != waits


def test_frames_of_a_camera_at_rest_are_tracked_but_not_corrected():
    noise = np.random.default_rng(0).normal(0.0, 0.005, (6, 160, 160))
    frames = (draw_scene(160, 160, seed=3) + noise).astype(np.float32)
    report = video.run_live(Shaking(frames), rsv.VibrationTracker(TIMING), [])
    assert report.tracked >= 2
    assert report.corrected == 0


class Uneven(Numbers):
    """Two frames come within one frame period, as from a webcam or a video of variable frame rate."""

    def frames(self):
        for time_of_frame in (0.0, 0.9, 1.3, 2.2, 4.1):
            pixels = np.full((1, 1), time_of_frame)
            yield video.TimedFrame(pixels, time_of_frame * TIMING.frame_period, time.perf_counter())


def test_frames_at_uneven_intervals_are_written(tmp_path):
    output = video.VideoOutput(tmp_path / "video.mkv", 30.0)
    video.run_live(Uneven(), rsv.VibrationTracker(TIMING), [output])
    times = rsv.read_stack_info(tmp_path / "video.mkv").frame_times
    assert np.array(times) * 30 == pytest.approx([0, 1, 2, 3, 4], abs=0.04)  # of 0, 0.9, 1.3, 2.2, 4.1


def test_sizes_that_the_codec_cannot_hold_are_named(tmp_path):
    source, output = Numbers(), video.VideoOutput(tmp_path / "video.mp4", 30.0)
    message = r"video\.mp4: H\.264 needs an even height and width, got \(1, 1\); write \.mkv"
    refuses(lambda: video.run_live(source, rsv.VibrationTracker(TIMING), [output]), message)
    assert not any(tmp_path.iterdir())
    assert source.closed  # an error of an output ends the session
