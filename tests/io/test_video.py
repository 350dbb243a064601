"""Videos: depth, time stamps, orientation and sound, read and written."""

import json
from dataclasses import replace
from fractions import Fraction

import av
import numpy as np
import pytest
import torch
from program import rsvib
from refusals import refuses
from small_stack import CAMERA, STILL
from small_video import PERIOD, sound_of, write_clip, write_video
from truth import decibel

from rsvib_torch.io import (
    FrameError,
    StackInfo,
    metadata_not_kept,
    open_stack,
    read_stack,
    read_stack_info,
    write_stack,
)

TIMES = np.arange(6) / 30
DROPPED = np.array([0, 1, 2, 4, 5, 9, 10, 11]) * PERIOD


def noise(bits, *shape):
    dtype = np.uint8 if bits == 8 else np.uint16
    return np.random.default_rng(bits).integers(0, 2**bits, (6, 48, 64, *shape), dtype=dtype)


@pytest.fixture(name="place")
def write_config(tmp_path):
    (tmp_path / "camera.toml").write_text(CAMERA.replace("full_scale = 4095\n", ""))
    return tmp_path


@pytest.mark.parametrize(
    ("bits", "layout", "encoded"),
    [(8, "gray", None), (10, "gray10le", None), (16, "gray16le", None), (8, "rgb24", "bgr0"), (12, "gbrp12le", None)],
)
def test_videos_keep_their_depth(tmp_path, bits, layout, encoded):
    counts = noise(bits, *(() if "gray" in layout else (3,)))
    write_video(tmp_path / "a.mkv", counts, TIMES, layout=layout, encoded=encoded, unit=Fraction(1, 30))
    counts = counts if counts.ndim == 3 else np.moveaxis(counts, -1, 1)
    info = read_stack_info(tmp_path / "a.mkv")
    assert (info.shape, info.full_scale) == (counts.shape, 2**bits - 1)
    frames = read_stack(tmp_path / "a.mkv")
    np.testing.assert_array_equal((frames.double() * info.full_scale).round(), counts)
    write_stack(tmp_path / "b.mkv", frames, dtype=info.dtype, full_scale=info.full_scale, like=info)
    assert torch.equal(read_stack(tmp_path / "b.mkv"), frames)
    assert read_stack_info(tmp_path / "b.mkv") == info


def test_ten_bits_of_a_yuv_video_are_not_reduced_to_eight(tmp_path):
    ramp = np.linspace(2000, 60000, 640).astype(np.uint16)
    counts = np.broadcast_to(ramp[None, None, :, None], (3, 48, 640, 3))
    lossless = {"x265-params": "lossless=1:log-level=none"}
    options = {"codec": "libx265", "encoded": "yuv420p10le", "options": lossless}
    write_video(tmp_path / "a.mp4", counts, TIMES[:3], layout="rgb48le", **options)
    frames = read_stack(tmp_path / "a.mp4")
    assert len(torch.unique((frames[0, 0, 0] * 65535).round())) > 500
    np.testing.assert_allclose(frames[1, 1, 20], ramp / 65535, atol=1.2e-3)  # one step of 10 bits


@pytest.mark.parametrize("full_scale", [200, 4000])
def test_other_full_scales_are_scaled_to_the_depth_of_the_video(tmp_path, full_scale):
    frames = torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(1))
    dtype = "uint8" if full_scale < 256 else "uint16"
    write_stack(tmp_path / "a.mkv", frames, dtype=dtype, full_scale=full_scale)
    np.testing.assert_allclose(read_stack(tmp_path / "a.mkv"), frames, atol=1.01 / full_scale)


def test_floats_are_written_for_viewing(tmp_path):
    frames = torch.tensor([-0.5, 0.0, 0.3, 1.0, 1.5, float("nan")])[:, None, None].expand(6, 48, 64)
    write_stack(tmp_path / "a.mp4", frames)
    means = read_stack(tmp_path / "a.mp4").mean((1, 2, 3))
    np.testing.assert_allclose(means, [0.0, 0.0, 0.3, 1.0, 1.0, 0.0], atol=0.012)


def test_colours_are_those_of_the_input(tmp_path):
    colours = torch.tensor([[0.8, 0.2, 0.1], [0.1, 0.7, 0.3], [0.2, 0.3, 0.9]])
    for height in (64, 640):  # players assume other colours for tall videos without a tag
        frames = colours[..., None, None].expand(3, 3, height, 64)
        for name in ("a.mp4", "a.mkv"):
            write_stack(tmp_path / name, frames, dtype="uint8")
            restored = read_stack(tmp_path / name)
            np.testing.assert_allclose(restored, frames, atol=0.012)
            assert float((restored - frames).mean().abs()) < 0.002


def test_all_orientations_are_kept(tmp_path):
    frames = torch.rand(2, 48, 64, generator=torch.Generator().manual_seed(1))
    for orientation in range(1, 9):
        like = StackInfo((2, 48, 64), "uint8", 255.0, orientation=orientation)
        for ending in (".mp4", ".mov", ".mkv") if orientation in (1, 3, 6, 8) else (".mp4", ".mov"):
            write_stack(tmp_path / f"a{ending}", frames, dtype="uint8", like=like)
            assert read_stack_info(tmp_path / f"a{ending}").orientation == orientation
    with av.open(str(tmp_path / "a.mp4")) as video:
        assert next(video.decode(video=0)).rotation == 90  # orientation 8: anticlockwise
    with pytest.raises(ValueError, match=r"\.mkv cannot hold the orientation 2 of the input; write \.mp4"):
        write_stack(tmp_path / "b.mkv", frames, dtype="uint8", like=replace(like, orientation=2))


def test_a_rotated_video_is_read_as_stored_and_restored_in_the_same_orientation(place, capsys):
    """The rows of the file are the rows of the sensor; with the rotation applied, nothing could be restored."""
    times = np.arange(8) * PERIOD
    write_clip(place / "portrait.mp4", times, rotation=-90)
    assert read_stack_info(place / "portrait.mp4").shape == (8, 3, 96, 64)
    config = ("--config", place / "camera.toml")
    assert rsvib("run", place / "portrait.mp4", place / "out", *config, "--output", "restored.mp4") == 0
    assert "displayed rotated by 90 degrees clockwise; rows, x and y are those of the stored" in capsys.readouterr().out
    assert read_stack_info(place / "out" / "restored.mp4").orientation == 6
    frames = read_stack(place / "out" / "restored.mp4").mean(1).numpy()
    assert min(decibel(frame, STILL, 12) for frame in frames) > 34


def test_time_stamps_are_used_and_kept_with_the_sound(place):
    write_clip(place / "clip.mp4", DROPPED)
    config, restored = ("--config", place / "camera.toml"), place / "restored.mp4"
    assert rsvib("detect", place / "clip.mp4", *config, "--out", place / "found") == 0
    found = json.loads((place / "found" / "vibration.json").read_text())
    assert found["timing"]["frame_start_times"] == pytest.approx(DROPPED, abs=2e-5)
    vibration = ("--vibration", place / "found" / "vibration.json")
    assert rsvib("restore", place / "clip.mp4", restored, *config, *vibration) == 0
    frames = read_stack(restored).mean(1).numpy()
    assert min(decibel(frame, STILL, 12) for frame in frames) > 34
    assert read_stack_info(restored).frame_times == read_stack_info(place / "clip.mp4").frame_times
    assert len(sound_of(restored)) > 3
    assert sound_of(restored) == sound_of(place / "clip.mp4")


@pytest.mark.parametrize("late", [0.0, 5e-3])
def test_times_in_whole_milliseconds_are_those_of_the_frame_rate_where_it_explains_them(tmp_path, late):
    """Intervals of 14, 15, 14 and 15 ms have another mean than 14.4 ms."""
    times = 0.0144 * np.arange(5) + [0.0, 0.0, late, 0.0, 0.0]
    counts = np.random.default_rng(0).integers(0, 255, (5, 32, 48), dtype=np.uint8)
    write_video(tmp_path / "a.mkv", counts, times, rate=Fraction(625, 9))
    error = np.abs(read_stack_info(tmp_path / "a.mkv").frame_times - times).max()
    assert error < (1e-9 if late == 0.0 else 6e-4)


def test_matroska_may_begin_at_any_time(tmp_path):
    """Its duration counts from the time 0."""
    counts = np.random.default_rng(0).integers(0, 255, (8, 32, 48), dtype=np.uint8)
    write_video(tmp_path / "a.mkv", counts, 12.345 + np.arange(8) / 30)
    assert read_stack_info(tmp_path / "a.mkv").shape == (8, 32, 48)


def test_a_stated_frame_rate_replaces_jitter(place, capsys):
    times = np.arange(8) * PERIOD
    clip = place / "jitter.mp4"
    write_clip(clip, times, shown_at=times + 0.2 * PERIOD * np.cos(np.arange(8)))
    config = ("--config", place / "camera.toml", "--json")
    found = []
    for more in ((), ("--frame-rate", 1 / PERIOD)):
        assert rsvib("detect", clip, *config, *more, "--out", place / f"found{len(more)}") == 0
        shown = capsys.readouterr().out
        found.append(json.loads(shown)["detection"]["reliable"])
        assert ("equal intervals by --frame-rate replace the time stamps" in shown) == bool(more)
    assert found == [[False, False], [True, True]]


@pytest.mark.filterwarnings("default::rsvib_torch.motion.timing.TimingWarning")
def test_slow_motion_keeps_the_times_of_playback_and_warns(place, capsys):
    times = np.arange(8) * PERIOD
    write_clip(place / "slow.mp4", times, shown_at=np.arange(8) / 25)
    arguments = ("--config", place / "camera.toml", "--output", "restored.mp4")
    assert rsvib("run", place / "slow.mp4", place / "out", *arguments) == 0
    assert capsys.readouterr().err.count("25 frames per second according to its time stamps, but 96.154") == 1
    assert read_stack_info(place / "out" / "restored.mp4").frame_times == pytest.approx(np.arange(8) / 25)


def test_subtitles_are_listed_as_not_kept(tmp_path):
    (tmp_path / "a.srt").write_text("1\n00:00:00,000 --> 00:00:00,100\nHello\n")
    with av.open(str(tmp_path / "a.srt")) as texts, av.open(str(tmp_path / "a.mkv"), "w") as output:
        encoder = output.add_stream("ffv1", rate=30)
        encoder.height, encoder.width, encoder.pix_fmt = 48, 64, "gray"
        output.add_stream_from_template(texts.streams.subtitles[0])
        for pixels in noise(8):
            output.mux(encoder.encode(av.VideoFrame.from_ndarray(pixels, format="gray")))
        output.mux(encoder.encode())
    assert metadata_not_kept(read_stack_info(tmp_path / "a.mkv"), "b.mkv", (6, 48, 64)) == ("subtitles",)


def test_frames_can_be_read_in_any_order(tmp_path):
    """H.264 stores frames in another order than it presents them."""
    times = np.arange(12) / 30
    levels = np.broadcast_to(np.arange(12, dtype=np.uint8)[:, None, None, None] * 20, (12, 48, 64, 3))
    write_video(tmp_path / "a.mp4", levels, times, layout="rgb24", codec="libx264", encoded="yuv420p")
    reader = open_stack(tmp_path / "a.mp4")
    for index in (7, 3, 11, 0, 0, 5):
        assert reader.frame(index).mean() == pytest.approx(20 * index, abs=3)
    reader.close()


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("a.webm", "libvpx"),
        ("a.3gp", "libx264"),
        ("a.mts", "libx264"),
        ("a.m2ts", "mpeg2video"),
        ("a.mpg", "mpeg2video"),
        ("a.wmv", "wmv2"),
        ("a.m4v", "mpeg4"),
        ("a.avi", "mjpeg"),
    ],
)
def test_other_kinds_of_video_are_read(tmp_path, name, codec):
    levels = np.broadcast_to(np.arange(6, dtype=np.uint8)[:, None, None, None] * 40, (6, 48, 64, 3))
    encoded = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    options = {"layout": "rgb24", "encoded": encoded, "rate": 25, "unit": Fraction(1, 25)}
    write_video(tmp_path / name, levels, np.arange(6) / 25, codec=codec, **options)
    np.testing.assert_allclose(read_stack(tmp_path / name).mean((1, 2, 3)) * 255, levels[:, 0, 0, 0], atol=4)
    times = read_stack_info(tmp_path / name).frame_times
    assert np.diff(times) == pytest.approx(np.full(5, 1 / 25), abs=1.1e-3)


def test_a_frame_of_another_size_is_reported(tmp_path):
    """Two videos without a header, one after the other, as from a camera that was set to another resolution."""
    options = {"layout": "rgb24", "codec": "mpeg2video", "encoded": "yuv420p", "rate": 25, "unit": Fraction(1, 25)}
    for name, size in (("a.mpg", 48), ("b.mpg", 64)):
        write_video(tmp_path / name, np.broadcast_to(np.uint8(90), (6, size, 64, 3)), np.arange(6) / 25, **options)
    (tmp_path / "b.mpg").write_bytes((tmp_path / "b.mpg").read_bytes() + (tmp_path / "a.mpg").read_bytes())
    reader = open_stack(tmp_path / "b.mpg")
    assert reader.frame(0).shape == (3, 64, 64)
    with pytest.raises(FrameError, match=r"b\.mpg: frames of different size: frame \d+ is \(48, 64\)"):
        reader.frame(reader.info.shape[0] - 1)
    reader.close()


@pytest.mark.parametrize(
    ("name", "shape", "dtype", "message"),
    [
        ("a.mp4", (2, 47, 64), "uint8", r"H\.264 needs an even height and width, got \(47, 64\); write \.mkv"),
        ("a.mkv", (2, 4, 48, 64), "uint8", r"videos hold 1 or 3 channels, got 4; write \.tif"),
        ("a.mkv", (2, 48, 64), "float32", "FFV1 video files hold uint8, uint16; got dtype float32"),
        ("a.webm", (2, 48, 64), "uint8", "wmv files can only be read"),
    ],
)
def test_what_a_video_cannot_hold_is_refused(tmp_path, name, shape, dtype, message):
    refuses(lambda: write_stack(tmp_path / name, torch.rand(shape), dtype=dtype), message)
    assert list(tmp_path.iterdir()) == []


def test_what_a_container_cannot_hold_is_refused_before_the_computation(place, capsys):
    write_clip(place / "clip.avi", np.arange(8) * PERIOD, sound="pcm_u8", unit=Fraction(13, 1250))
    arguments = ("--config", place / "camera.toml", "--output", "a.mp4")
    assert rsvib("run", place / "clip.avi", place / "out", *arguments) == 2
    assert "a.mp4: .mp4 cannot hold the audio (pcm_u8) of" in capsys.readouterr().err
    assert not (place / "out").exists()


def test_interlaced_videos_are_refused(tmp_path):
    options = {"codec": "libx264", "encoded": "yuv420p", "options": {"x264-params": "tff=1"}}
    write_video(tmp_path / "a.mp4", noise(8, 3), TIMES, layout="rgb24", **options)
    refuses(lambda: read_stack_info(tmp_path / "a.mp4"), r"it is interlaced: .*; deinterlace it, as by ffmpeg")


def test_files_that_are_not_videos_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with av.open("sound.mp4", "w") as output:
        audio = output.add_stream("aac", rate=48000)
        audio.layout = "mono"
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.int16), format="s16", layout="mono")
        frame.sample_rate = 48000
        output.mux(audio.encode(frame))
        output.mux(audio.encode())
    for name, data in (("text.mov", b"no video"), ("empty.mp4", b""), ("head.mp4", b"\0\0\0\x20ftypisom" * 9)):
        (tmp_path / name).write_bytes(data)
        refuses(lambda name=name: read_stack(name), rf"^{name}: not a readable video stack: ")
    refuses(lambda: read_stack("sound.mp4"), "^sound.mp4: not a readable video stack: it contains no video stream")


@pytest.mark.parametrize(("name", "codec", "encoded"), [("a.avi", "mjpeg", "yuvj420p"), ("a.mkv", "ffv1", "bgr0")])
def test_truncated_videos_are_refused(tmp_path, capfd, name, codec, encoded):
    """The container states its duration; 4 of 6 frames were read without a word."""
    write_video(
        tmp_path / name, noise(8, 3), TIMES, layout="rgb24", codec=codec, encoded=encoded, unit=Fraction(1, 30), rate=30
    )
    assert read_stack_info(tmp_path / name).shape == (6, 3, 48, 64)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: 2 * len(data) // 3])
    refuses(lambda: read_stack_info(tmp_path / name), rf"{name}: .*truncated: \d frames")
    assert capfd.readouterr().err == ""


def test_frames_keep_their_places_behind_one_that_cannot_be_decoded(tmp_path):
    path, times = tmp_path / "a.mp4", np.arange(8) / 25
    levels = np.broadcast_to((20 + 25 * np.arange(8, dtype=np.uint8))[:, None, None, None], (8, 48, 64, 3))
    options = {"g": "1", "crf": "4"}
    write_video(path, levels, times, layout="rgb24", codec="libx264", encoded="yuv420p", options=options)
    with av.open(str(path)) as video:
        packet = [one for one in video.demux(video.streams.video[0]) if one.size][3]
        place, size = packet.pos, packet.size
    content = bytearray(path.read_bytes())
    content[place : place + size] = bytes(size)
    path.write_bytes(content)
    reader = open_stack(path)
    assert reader.info.shape[0] == 8
    assert reader.info.frame_times == pytest.approx(times)
    for index in (4, 5, 2, 7):
        assert abs(float(reader.frame(index).mean()) - 20 - 25 * index) < 2
    refuses(lambda: reader.frame(3), r"frame 3 (cannot be decoded|is damaged)", FrameError)
    reader.close()
