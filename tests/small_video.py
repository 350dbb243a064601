"""Videos for tests: the small vibrating stack of ``small_stack.py`` with any times, orientation and sound."""

import itertools
from fractions import Fraction

import av
import numpy as np
from skimage.registration import phase_cross_correlation
from small_stack import MOTION, SCENE, TIMING
from truth import Motion, take_frames

PERIOD = TIMING.frame_period


def draw_frames(times, full_scale=255):
    """Counts (T, H, W) of frames whose exposure starts at these times in s."""
    frames = []
    for number, time in enumerate(times):
        phase = tuple(p + 2 * np.pi * f * time for p, f in zip(MOTION.phase, MOTION.frequency, strict=True))
        motion = Motion(MOTION.amplitude, MOTION.frequency, phase)
        frames.append(take_frames(SCENE, TIMING, motion, 1, noise=0.002, seed=number)[0])
    counts = np.clip(np.round(np.array(frames) * full_scale), 0, full_scale)
    return counts.astype(np.uint8 if full_scale == 255 else np.uint16)


def write_video(
    path,
    frames,
    times,
    *,
    layout="gray",
    codec="ffv1",
    encoded=None,
    options=None,
    unit=Fraction(1, 90000),
    rate=None,
    rotation=None,
    sound=None,
):
    """Write frames (T, H, W) or (T, H, W, 3) in a pixel format; ``rotation`` is anticlockwise in degrees."""
    with av.open(str(path), "w") as output:
        same = {"mbtree": "0"} if codec == "libx264" else {}  # with it, files of the same frames differ from run to run
        video = output.add_stream(codec, rate=rate or round(1 / PERIOD), options=same | (options or {}))
        video.height, video.width = frames.shape[1:3]
        video.pix_fmt = encoded or layout
        video.codec_context.thread_count = 1  # rate control of several threads depends on the load of the machine
        video.codec_context.time_base = video.time_base = unit
        if rotation is not None:
            video.set_display_rotation(rotation)
        audio = None
        if sound is not None:
            audio = output.add_stream(sound, rate=48000)
            audio.layout = "mono"
        for time, pixels in zip(times, frames, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format=layout)
            frame = frame.reformat(format=video.pix_fmt)
            frame.pts, frame.time_base = round(time / unit), unit
            output.mux(video.encode(frame))
        output.mux(video.encode())
        if audio is not None:
            wave = (8000 * np.sin(np.arange(int(48000 * (times[-1] + 0.02))) / 17)).astype(np.int16)
            for first in range(0, len(wave) - 1024, 1024):
                frame = av.AudioFrame.from_ndarray(wave[None, first : first + 1024], format="s16", layout="mono")
                frame.sample_rate, frame.pts, frame.time_base = 48000, first, Fraction(1, 48000)
                output.mux(audio.encode(frame))
            output.mux(audio.encode())


def write_clip(path, times, *, shown_at=None, **options):
    """Write an H.264 video like that of a telephone, with sound; frames are presented at ``shown_at``."""
    frames = np.repeat(draw_frames(times)[..., None], 3, axis=-1)
    options = {"codec": "libx264", "encoded": "yuv420p", "options": {"crf": "4"}, "sound": "aac", **options}
    write_video(path, frames, times if shown_at is None else shown_at, layout="rgb24", **options)


def write_sharp(path, frames, times, **options):
    """Write counts (T, H, W, 3) as H.264 with little loss; with threads, the pixels differ from run to run."""
    encoder = {"crf": "6", "threads": "1", "tune": "zerolatency"}
    settings = {"layout": "rgb24", "codec": "libx264", "encoded": "yuv420p", "options": encoder, "rate": 30}
    write_video(path, frames, times, **settings | options)
    return path


def shifts(frames):
    """(T - 1, 2) px, displacements (x, y) of the content of each grey frame against the one before."""
    window = np.hanning(frames.shape[-2])[:, None] * np.hanning(frames.shape[-1])
    pairs = itertools.pairwise((frame - frame.mean()) * window for frame in frames)
    return -np.array([phase_cross_correlation(a, b, upsample_factor=50, normalization=None)[0][::-1] for a, b in pairs])


def sound_of(path):
    """Presentation time in s and data of every packet of sound."""
    with av.open(str(path)) as video:
        packets = video.demux(video.streams.audio[0]) if video.streams.audio else []
        return [(round(float(p.pts * p.time_base), 3), bytes(p)) for p in packets if p.dts is not None]
