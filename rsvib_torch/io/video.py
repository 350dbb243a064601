"""Stacks in video files, read and written with PyAV, also in parts that are joined without encoding them again.

Frames are returned as stored, because these are the rows that the sensor has read. A rotation for display is not
applied; the videos that are written state it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, partial
from io import BytesIO
from itertools import chain, count, islice, pairwise, repeat
from pathlib import Path
from typing import IO, TYPE_CHECKING, Literal

import numpy as np

from rsvib_torch.checks.values import needed_package
from rsvib_torch.files.reading import check_fits
from rsvib_torch.io.frame_reader import FrameError, FrameReader, readable_stack
from rsvib_torch.io.stack_info import H264, VIDEO, StackInfo, camera_name
from rsvib_torch.numerics.tables import Array

if TYPE_CHECKING:
    import av
    from av.container import InputContainer, OutputContainer

CONTAINERS = {".mkv": "matroska", ".mp4": "mp4", ".mov": "mov", ".m4v": "mp4"}  # of the videos that are written
# constant rate factor, 0 (no loss) to 51, of which less than 18 are hardly visible; no macroblock tree, with which x264
# (core 165) encodes the same frames differently from run to run: 5 to 12 files in 16 runs, 1 without, at equal PSNR
_H264_OPTIONS = {"crf": "12", "mbtree": "0"}
_FFV1_OPTIONS = {"level": "3", "g": "1"}  # each frame can be decoded alone: damage does not affect other frames
_BT709, _LIMITED_RANGE, _FULL_RANGE = 1, 1, 2  # codes of ITU-T H.273 and FFmpeg
_DEFAULT_RATE = 25.0  # frames per second, if neither file nor sensor state them

# display matrix (a, b, c, d) of each value of the orientation tag: displayed x = a x + c y, displayed y = b x + d y
_MATRICES = {
    1: (1, 0, 0, 1), 2: (-1, 0, 0, 1), 3: (-1, 0, 0, -1), 4: (1, 0, 0, -1), 5: (0, 1, 1, 0), 6: (0, 1, -1, 0),
    7: (0, -1, -1, 0), 8: (0, -1, 1, 0),
}  # fmt: skip

_FRAMES = 8  # decoded frames of a decoder; each has at most 6 bytes per pixel
_av = partial(needed_package, "av", "reading and writing video", "video")


def open_container(video: Path | IO[bytes]) -> InputContainer:
    """Open a video for decoding; formats that refer to other files (playlists) are refused."""
    formats = "matroska,webm,avi,mov,mp4,mpegts,mpeg,mpegvideo,asf"
    av = _av()
    before = {"metadata_errors": "replace"} if int(av.__version__.partition(".")[0]) < 19 else {}  # later: always
    file, options = str(video) if isinstance(video, Path) else video, {"format_whitelist": formats}
    container: InputContainer = av.open(file, options=options, **before)
    return container


def _orientation(frame: av.VideoFrame) -> int:
    """Value of the orientation tag that corresponds to the display matrix of a frame."""
    data = frame.side_data.get("DISPLAYMATRIX")
    matrix = np.zeros(5) if data is None else np.asarray(data).view(np.int32)[:5][[0, 1, 3, 4]]
    signs = tuple(np.rint(matrix / max(1, *np.abs(matrix))).tolist())
    return next((tag for tag, stored in _MATRICES.items() if stored == signs), 1)


def _conversion() -> int:
    """Options for the conversion of colours; without them the mean of a frame changes by more than one count of 255."""
    kinds = _av().video.reformatter.Interpolation
    flags: int = kinds.BILINEAR | kinds.FULL_CHR_H_INT | kinds.ACCURATE_RND
    return flags


def _decoded_as(layout: av.VideoFormat) -> tuple[str, float]:
    """Pixel format to which frames are converted, and its full scale; grey and RGB keep their depth."""
    bits = max(component.bits for component in layout.components)
    if layout.name.startswith(("gray", "gbrp")) and "f" not in layout.name:
        return layout.name, float(2**bits - 1)
    return ("rgb24", 255.0) if bits <= 8 else ("rgb48le", 65535.0)


def _pixels(frame: av.VideoFrame) -> Array:
    """Pixels (H, W) or (3, H, W) of a decoded frame."""
    unspecified, untagged_height = 2, 576  # players assume the colours of HDTV for taller videos without a tag
    matrix = "ITU709" if frame.colorspace == unspecified and frame.height > untagged_height else None
    pixels = frame.to_ndarray(format=_decoded_as(frame.format)[0], src_colorspace=matrix, interpolation=_conversion())
    return np.ascontiguousarray(pixels if pixels.ndim == 2 else np.moveaxis(pixels, -1, 0))


def _main_stream(container: InputContainer) -> av.VideoStream:
    """The stream of a video that players show."""
    best = container.streams.best("video")
    for stream in container.streams.video:
        if stream is best:
            return stream
    raise ValueError("it contains no video stream")


def _frames(container: InputContainer) -> Generator[av.VideoFrame, None, None]:
    """Decode the frames of the main video stream in the order of presentation; damaged packets are skipped."""
    av, stream = _av(), _main_stream(container)
    stream.thread_type = "AUTO"
    packets = container.demux(stream)
    while True:
        with suppress(av.error.InvalidDataError):
            packet = next(packets, None)
            if packet is None:
                return
            yield from packet.decode()


@dataclass(frozen=True)
class Picture:
    """How the pixels of a video are stored."""

    layout: str  # name of the pixel format in FFmpeg
    colorspace: int  # matrix of luma and chroma, code of FFmpeg
    color_range: int  # range of the counts, code of FFmpeg: 2 is full, others are limited
    size: tuple[int, int]  # height and width in px

    def fits(self, ending: str) -> bool:
        """Whether a video with this ending can hold the planes Y, U and V: 4:2:0 with even sides, 8 bits in H.264."""
        layouts = ("yuv420p", "yuvj420p") + ("yuv420p10le",) * (ending in H264)
        return self.layout in layouts and not any(side % 2 for side in self.size)

    @property
    def levels(self) -> tuple[float, float]:
        """Counts of black and white in Y."""
        return (0.0, 255.0) if self.color_range == _FULL_RANGE or self.layout == "yuvj420p" else (16.0, 235.0)


def _seconds(ticks: int | None, unit: Fraction | None) -> Fraction | None:
    """Presentation time in s of a frame or packet; None if it is not known."""
    return None if ticks is None or unit is None else ticks * unit


def _listed_times(container: InputContainer, stream: av.VideoStream) -> list[Fraction | None] | None:
    """Presentation times in s of all frames that an MP4 file lists; None if frames must be decoded to find them."""
    if "mp4" not in container.format.name:
        return None
    listed = [packet for packet in container.demux(stream) if packet.size]
    if any(packet.is_corrupt or packet.is_discard for packet in listed):
        return None
    times = sorted({time for packet in listed if (time := _seconds(packet.pts, stream.time_base)) is not None})
    return [*times] if len(times) == len(listed) == stream.frames else None


def _camera(tags: dict[str, str]) -> str | None:
    """Make and model of the camera in the tags of a video: QuickTime or Android."""
    makes = ("com.apple.quicktime.make", "com.android.manufacturer", "make")
    for make, model in zip(makes, ("com.apple.quicktime.model", "com.android.model", "model"), strict=True):
        if tags.get(model):
            return camera_name(tags.get(make), tags[model])
    return None


@lru_cache(maxsize=8)
def _scan(path: Path, size: int, changed: int) -> tuple[StackInfo, tuple[Fraction, ...], Picture]:
    """What a video states, and the presentation times in s of its frames.

    MP4 files list all frames. Other containers state their number only roughly and are decoded once. ``size`` and
    ``changed`` (ns) identify the state of the file.
    """
    with open_container(path) as container:
        stream = _main_stream(container)
        unit = stream.time_base or Fraction(0)
        size = stream.width * stream.height
        check_fits(f"{path}: frames of {stream.height} x {stream.width} px", _FRAMES * 6 * size, "free more memory")
        times = _listed_times(container, stream)
        with open_container(path) as again, closing(_frames(again)) as frames:
            first = next(frames, None)
            if first is None:
                raise ValueError("no frame can be decoded")
            if times is None:
                times = [_seconds(frame.pts, unit) for frame in chain([first], frames)]
        known = [time for time in times if time is not None]
        rising = len(known) == len(times) > 1 and all(a < b for a, b in pairwise(known))
        pixels, rate = _pixels(first), stream.average_rate
        duration = float(stream.frames / rate if rate else 0)  # stated by .avi, .mp4 and .mov
        if not stream.frames and "matroska" in container.format.name and len(container.streams) == 1:
            # of the longest of several streams, from the time 0 on
            duration = 1e-6 * ((container.duration or 0) - (container.start_time or 0))
        decoded = float(known[-1] - known[0] + (1 / rate if rate else 0)) if rising else duration
        # .avi also counts empty frames
        if len(times) < 0.9 * duration * float(rate or 0) - 1 and decoded < 0.9 * duration:
            raise ValueError(f"truncated: {len(times)} frames, {decoded:.3g} of {duration:.3g} s, can be decoded")
        stated = known
        if rising and rate:  # Matroska rounds times to 1 ms: 5 frames at 69.44 per second, its frame rate, have 68.97
            even = [known[0] + round((time - known[0]) * rate) / rate for time in known]
            if all(abs(a - b) <= unit for a, b in zip(even, known, strict=True)):
                stated = even
        if first.interlaced_frame:
            raise ValueError(
                "it is interlaced: neighbouring rows were taken at the times of two fields; deinterlace it, as by "
                "ffmpeg -i VIDEO -vf bwdif OUTPUT (-vf setfield=prog if it was not taken in fields)"
            )
        info = StackInfo(
            (len(times), *pixels.shape),
            pixels.dtype.name,
            _decoded_as(first.format)[1],
            tuple(float(time) for time in stated) if rising else None,
            frame_rate=None if rising or not rate else float(rate),
            orientation=_orientation(first),
            time_error=float(unit),
            metadata={"subtitles": None} if container.streams.subtitles else {},
            camera=_camera(container.metadata | stream.metadata),
        )
        picture = Picture(first.format.name, int(first.colorspace), int(first.color_range), (first.height, first.width))
        return info, tuple(known) if rising else (), picture


def scanned(path: Path) -> tuple[StackInfo, tuple[Fraction, ...], Picture]:
    """What a video states, the presentation times in s of its frames (empty if unknown), and how it stores pixels."""
    av, state = _av(), path.stat()
    with readable_stack(path, "video"):
        try:
            return _scan(path.absolute(), state.st_size, state.st_mtime_ns)
        except av.error.FFmpegError as error:
            raise ValueError(error.strerror) from error


class VideoReader(FrameReader):
    """Frames of a video, decoded in sequence; reading an earlier frame starts again at the beginning."""

    def __init__(self, path: Path) -> None:
        info, self._times, self.picture = scanned(path)
        super().__init__(path, info, lambda index: _pixels(self._decoded(index)))
        self._next, self._presented = 0, self._in_order()

    def _in_order(self) -> Generator[av.VideoFrame | None, None, None]:
        """The frames in their order, each at its presentation time if they are known; None if it cannot be decoded."""
        with open_container(self.path) as container, closing(_frames(container)) as decoded:
            frame = next(decoded, None)
            for expected in self._times or repeat(None, self.info.shape[0]):
                time = None if frame is None or expected is None else _seconds(frame.pts, frame.time_base)
                while time is not None and expected is not None and time < expected:
                    frame = next(decoded, None)
                    time = None if frame is None else _seconds(frame.pts, frame.time_base)
                if time is not None and expected is not None and time > expected:
                    yield None
                else:
                    yield frame
                    frame = next(decoded, None)

    def planes(self, index: int) -> Array:
        """Planes of a frame in 8 bits, (3 H / 2, W), Y above U and V; chroma keeps its resolution.

        Colours keep their counts; those of 10 bits are a quarter.
        """
        planes: Array = self._decoded(index).to_ndarray()
        return planes if planes.dtype == np.uint8 else np.minimum((planes + 2) >> 2, 255).astype(np.uint8)

    def _decoded(self, index: int) -> av.VideoFrame:
        if index < self._next:
            self._presented.close()
            self._presented, self._next = self._in_order(), 0
        frame = next(islice(self._presented, index - self._next, None), None)
        self._next = index + 1
        if frame is None:
            raise FrameError(f"{self.path}: frame {index} cannot be decoded")
        if frame.is_corrupt:
            raise FrameError(f"{self.path}: frame {index} is damaged")
        if (frame.height, frame.width) != self.info.shape[-2:]:
            raise FrameError(f"{self.path}: frames of different size: frame {index} is {frame.height, frame.width}")
        return frame

    def close(self) -> None:
        """Close the file."""
        self._presented.close()


def _source(info: StackInfo) -> Path | None:
    """The video from which the frames to write were computed, one for each of its frames."""
    return info.path if info.path is not None and info.path.suffix.lower() in VIDEO else None


def presentation_times(info: StackInfo) -> tuple[Fraction, list[int]]:
    """Time unit in s of the video to write, and the presentation time of each frame in this unit.

    Times are those of the source if it is a video, else the frame times of the stack, else equal intervals.
    """
    source = _source(info)
    times: Sequence[Fraction] = scanned(source)[1] if source is not None else ()
    if not times and info.frame_times is not None:
        fine = 90000  # Hz; usual unit of .mp4
        times = [Fraction(round(fine * (time - info.frame_times[0])), fine) for time in info.frame_times]
    if not times:
        rate = Fraction(info.frame_rate or _DEFAULT_RATE).limit_denominator(1001)
        times = [index / rate for index in range(info.shape[0])]
    unit = Fraction(1, math.lcm(*(time.denominator for time in times)))
    return unit, [round(time / unit) for time in times]


class VideoEncoder:
    """Encodes frames into a container that is open for writing; the ending of ``path`` selects the codec.

    Frames are pixels (H, W) or (C, H, W), or planes as in a ``picture``. The metadata are those of ``source``, an open
    video or None; ``options`` are those of the codec in addition. ``ticks`` are the presentation times of the frames in
    units of ``unit`` s, and ``step`` is their usual interval.
    """

    def __init__(
        self,
        container: OutputContainer,
        path: Path,
        info: StackInfo,
        source: InputContainer | None,
        picture: Picture | None = None,
        options: Mapping[str, str] = {},
    ) -> None:
        self._container, self._info, self._picture, lossy = container, info, picture, path.suffix.lower() in H264
        # The pixel formats of the array of a frame and of the encoder, and their full scale.
        grey = info.axes == "THW" or info.shape[1] == 1
        bits = next(bits for bits in (8, 10, 12, 14, 16) if lossy or 2**bits - 1 >= (info.full_scale or 0.0))
        self._layout, self._full_scale = "gray" if grey else "rgb24", 2.0**bits - 1.0
        self._encoded = "yuv420p" if lossy else "gray" if grey else "bgr0"
        if bits > 8:
            self._layout = self._encoded = f"gray{bits}le" if grey else f"gbrp{bits}le"
        self.unit, self.ticks = presentation_times(info)
        self.step = int(np.median(np.diff(self.ticks))) if len(self.ticks) > 1 else 1
        rate = 1 / (self.unit * self.step) if len(self.ticks) > 1 else Fraction(_DEFAULT_RATE)
        codec: Literal["libx264", "ffv1"] = "libx264" if lossy else "ffv1"
        options = {**(_H264_OPTIONS if lossy else _FFV1_OPTIONS), **options}
        self._stream = video = container.add_stream(codec, rate=rate, options=options)
        video.height, video.width = info.shape[-2:]
        video.pix_fmt, encoder = self._encoded, video.codec_context
        encoder.time_base = video.time_base = self.unit
        if info.orientation != 1:
            a, b, c, d = _MATRICES[info.orientation]
            one = 1 << 16  # fixed-point numbers
            video.set_display_matrix([a * one, b * one, 0, c * one, d * one, 0, 0, 0, 1 << 30])
        if lossy:
            encoder.colorspace, encoder.color_range = _BT709, _LIMITED_RANGE
        if source is not None:
            container.metadata.update(source.metadata)
            taken = _main_stream(source).codec_context
            encoder.color_primaries, encoder.color_trc = taken.color_primaries, taken.color_trc
            if taken.sample_aspect_ratio:
                encoder.sample_aspect_ratio = taken.sample_aspect_ratio
        if picture is not None:
            video.pix_fmt, encoder.colorspace = "yuv420p", picture.colorspace
            encoder.color_range = _FULL_RANGE if picture.levels[1] == 255.0 else picture.color_range

    def write(self, frame: Array, tick: int) -> None:
        """Encode a frame with a presentation time."""
        encoded = self._converted(frame)
        encoded.pts, encoded.time_base = tick, self.unit
        self._container.mux(self._stream.encode(encoded))

    def _converted(self, frame: Array) -> av.VideoFrame:
        make: Callable[..., av.VideoFrame] = _av().VideoFrame.from_ndarray
        if self._picture is not None:
            return make(np.ascontiguousarray(frame), format="yuv420p")
        counts = np.moveaxis(frame, 0, -1) if frame.shape[:-2] == (3,) else frame.reshape(frame.shape[-2:])
        if self._full_scale != self._info.full_scale:
            relative = counts / (self._info.full_scale or 1.0)  # the full scale of floats is 1
            counts = np.rint(self._full_scale * np.clip(np.nan_to_num(relative), 0.0, 1.0))
        counts = np.ascontiguousarray(counts, dtype=np.uint8 if self._full_scale <= 255 else np.uint16)
        converted = make(counts, format=self._layout)
        if self._encoded != self._layout:
            converted = converted.reformat(format=self._encoded, dst_colorspace="ITU709", interpolation=_conversion())
        return converted

    def finish(self) -> None:
        """Write the frames that the codec has not yet returned."""
        self._container.mux(self._stream.encode())


class Sound:
    """Sound of another open video (None: none), copied between the frames of an open video to write."""

    def __init__(self, output: OutputContainer, source: InputContainer | None) -> None:
        streams = source.streams.audio if source is not None else ()
        self._output, self._added = output, {stream: output.add_stream_from_template(stream) for stream in streams}
        packets = source.demux(streams) if source is not None and streams else ()
        # the last packet of a stream is empty
        self._packets = (
            (time, packet)
            for packet in packets
            if packet.dts is not None and (time := _seconds(packet.pts, packet.time_base)) is not None
        )
        self._next = next(self._packets, None)

    def write(self, until: Fraction | None = None) -> None:
        """Write the packets up to a time in s, because players read sound and frames together; None for all."""
        while self._next is not None and (until is None or self._next[0] <= until):
            packet = self._next[1]
            packet.stream = self._added[packet.stream]
            self._output.mux(packet)
            self._next = next(self._packets, None)


def open_source(info: StackInfo, opened: ExitStack) -> InputContainer | None:
    """The open video from which the frames to write were computed, closed with ``opened``; None if there is none."""
    path = _source(info)
    return None if path is None else opened.enter_context(open_container(path))


def check_video(path: Path, info: StackInfo) -> None:
    """Refuse a stack that the codec or the container cannot hold."""
    av, ending = _av(), path.suffix.lower()
    if info.axes == "TCHW" and info.shape[1] not in (1, 3):
        raise ValueError(f"{path}: videos hold 1 or 3 channels, got {info.shape[1]}; write .tif")
    if ending in H264 and (info.shape[-2] % 2 or info.shape[-1] % 2):
        raise ValueError(f"{path}: H.264 needs an even height and width, got {info.shape[-2:]}; write .mkv")
    if ending == ".mkv" and info.orientation not in (1, 3, 6, 8):
        raise ValueError(f"{path}: .mkv cannot hold the orientation {info.orientation} of the input; write .mp4")
    with ExitStack() as opened:
        source = open_source(info, opened)
        output = opened.enter_context(av.open(BytesIO(), "w", format=CONTAINERS[ending]))
        for stream in source.streams.audio if source is not None else ():
            name = stream.codec_context.name
            if name not in output.supported_codecs:
                raise ValueError(f"{path}: {ending} cannot hold the audio ({name}) of {info.path}; write .mkv")


def open_output(path: Path, opened: ExitStack) -> OutputContainer:
    """The container of a video to write, closed with ``opened``; equal content gives equal bytes."""
    ending, options = path.suffix.lower(), {"fflags": "+bitexact"}
    output: OutputContainer = _av().open(str(path), "w", format=CONTAINERS[ending], options=options)
    return opened.enter_context(output)


def write_video(path: Path, info: StackInfo, frames: Iterator[Array]) -> None:
    """Write a video frame by frame."""
    with ExitStack() as opened:
        source, output = open_source(info, opened), open_output(path, opened)
        encoder = VideoEncoder(output, path, info, source)
        sound = Sound(output, source)
        for tick, pixels in zip(encoder.ticks, frames, strict=True):
            sound.write(tick * encoder.unit)
            encoder.write(pixels, tick)
        encoder.finish()
        sound.write()


# of x264: without B-frames packets have the order of frames; for a frame of 1920 x 1080 px, ultrafast with crf 14 takes
# 13 ms of a processor, 248 kB, 47.9 dB; superfast with crf 14: 28 ms, 214 kB, 47.4 dB; the default with crf 12: 100 ms
_PART_OPTIONS = {"preset": "ultrafast", "crf": "14", "bf": "0"}


@contextmanager
def part_of_video(
    file: IO[bytes], video: Path, info: StackInfo, picture: Picture | None
) -> Iterator[Callable[[Array], None]]:
    """Encode consecutive frames of a video into a new file; only ``join_parts`` gives them their times.

    The ending of ``video`` selects container and codec. The block gets a function that encodes a frame; the file is
    complete when it ends without an exception.
    """
    ending, numbers = video.suffix.lower(), count()
    with ExitStack() as opened:
        opened.enter_context(file)
        source = open_source(info, opened)
        output = opened.enter_context(_av().open(file, "w", format=CONTAINERS[ending]))
        encoder = VideoEncoder(output, video, info, source, picture, _PART_OPTIONS if ending in H264 else {})
        yield lambda frame: encoder.write(frame, next(numbers) * encoder.step)
        encoder.finish()


def join_parts(path: Path, info: StackInfo, parts: Iterable[IO[bytes]]) -> None:
    """Write the video whose frames are in ``parts``, with the times, the metadata and the sound of its source."""
    unit, ticks = presentation_times(info)
    with ExitStack() as opened:
        source, output = open_source(info, opened), open_output(path, opened)
        if source is not None:
            output.metadata.update(source.metadata)
        durations = np.diff(ticks, append=2 * ticks[-1] - ticks[-2] if len(ticks) > 1 else ticks[0] + 1).tolist()
        video: av.VideoStream | None = None
        index = 0
        for part in parts:
            with part, open_container(part) as container:
                if video is None:  # of the first part; streams of sound follow that of the frames
                    video = output.add_stream_from_template(container.streams.video[0])
                    video.time_base = unit
                    sound = Sound(output, source)
                for packet in container.demux(container.streams.video[0]):
                    if packet.size > 0:  # not the last packet of a stream
                        sound.write(ticks[index] * unit)
                        packet.stream, packet.time_base, packet.duration = video, unit, durations[index]
                        packet.pts = packet.dts = ticks[index]
                        output.mux(packet)
                        index += 1
        if index != len(ticks):
            raise ValueError(f"{path}: the parts have {index} frames, expected {len(ticks)}; delete them to start over")
        sound.write()
