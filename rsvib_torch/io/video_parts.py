"""A video that is written in parts, which are joined without encoding them again, and frames as planes Y, U and V.

Frames of 4:2:0 videos are neither converted to RGB nor back: colours keep their counts, and chroma its resolution.
"""

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.checks import needed_package
from rsvib_torch.io.stack_info import H264, FrameReader, StackInfo
from rsvib_torch.io.video import (
    CONTAINERS,
    Sound,
    VideoReader,
    add_video,
    open_container,
    open_output,
    open_source,
    picture_of,
    presentation_times,
    scanned,
)

Frame = NDArray[Any]
_FULL_RANGE = 2  # code of FFmpeg
# of x264: without B-frames packets have the order of frames; for a frame of 1920 x 1080 px, ultrafast with crf 14 takes
# 13 ms of a processor, 248 kB, 47.9 dB; superfast with crf 14: 28 ms, 214 kB, 47.4 dB; the default with crf 12: 100 ms
_PART_OPTIONS = {"preset": "ultrafast", "crf": "14", "bf": "0"}


def planes_of(reader: FrameReader) -> "PlaneReader | None":
    """The planes of an open stack, if it is a video of 8 bits in 4:2:0 with even sides; else None."""
    if not isinstance(reader, VideoReader):
        return None
    planes, (height, width) = PlaneReader(reader), reader.info.shape[-2:]
    return planes if planes.picture.layout in ("yuv420p", "yuvj420p") and height % 2 == width % 2 == 0 else None


class PlaneReader:
    """Frames of an open 4:2:0 video as their planes: (3 H / 2, W) uint8, Y above U and V.

    ``picture`` states how pixels are stored, ``black`` and ``white`` are those counts in Y.
    """

    def __init__(self, reader: VideoReader) -> None:
        assert reader.info.path is not None
        self._reader, self.picture = reader, scanned(reader.info.path)[2]
        full = self.picture.color_range == _FULL_RANGE or self.picture.layout == "yuvj420p"
        self.black, self.white = (0.0, 255.0) if full else (16.0, 235.0)

    def frame(self, index: int) -> Frame:
        """Planes of a frame as stored."""
        planes: Frame = self._reader.decoded(index).to_ndarray()
        return planes

    def prepare_encoder(self, stream: Any) -> None:
        """State the pixel format and the colours of the planes in a stream to write."""
        stream.pix_fmt = "yuv420p"
        stream.codec_context.colorspace = self.picture.colorspace
        stream.codec_context.color_range = _FULL_RANGE if self.white == 255.0 else self.picture.color_range


class PartWriter:
    """A new file with consecutive frames of a video; only ``join_parts`` gives them their times.

    The ending of ``video`` selects container and codec. Frames are the planes of a source, or pixels (H, W) or (C, H,
    W).
    """

    def __init__(self, file: BinaryIO, video: Path, info: StackInfo, planes: PlaneReader | None) -> None:
        av, ending = needed_package("av", "writing video", "video"), video.suffix.lower()
        self._video, self._info, self._planes = video, info, planes is not None
        self._from_planes = av.VideoFrame.from_ndarray
        self._opened = ExitStack()
        self._opened.enter_context(file)
        source = open_source(info, self._opened)
        self._output = self._opened.enter_context(av.open(file, "w", format=CONTAINERS[ending]))
        self._stream = add_video(self._output, video, info, source, **(_PART_OPTIONS if ending in H264 else {}))
        if planes is not None:
            planes.prepare_encoder(self._stream)
        self._unit, ticks = presentation_times(info)
        self._step, self._count = int(np.median(np.diff(ticks))) if len(ticks) > 1 else 1, 0

    def write(self, frame: Frame) -> None:
        """Encode a frame."""
        if self._planes:
            picture = self._from_planes(np.ascontiguousarray(frame), format="yuv420p")
        else:
            picture = picture_of(frame, self._video, self._info)
        picture.pts, picture.time_base = self._count * self._step, self._unit
        self._output.mux(self._stream.encode(picture))
        self._count += 1

    def close(self) -> None:
        """Finish the file."""
        try:
            self._output.mux(self._stream.encode())
        finally:
            self._opened.close()

    def abandon(self) -> None:
        """Close the file without finishing it."""
        self._opened.close()


def join_parts(path: Path, info: StackInfo, parts: Iterable[BinaryIO]) -> None:
    """Write the video whose frames are in ``parts``, with the times, the metadata and the sound of its source."""
    unit, ticks = presentation_times(info)
    with ExitStack() as opened:
        source, output = open_source(info, opened), open_output(path, opened)
        if source is not None:
            output.metadata.update(source.metadata)
        video: Any = None
        index = 0
        for part in parts:
            with part, open_container(part) as container:
                if video is None:  # of the first part; streams of sound follow that of the frames
                    video = output.add_stream_from_template(container.streams.video[0])
                    video.time_base = unit
                    sound = Sound(output, source)
                for packet in container.demux(container.streams.video[0]):
                    if packet.size == 0:  # the last packet of a stream
                        continue
                    sound.write(ticks[index] * unit)
                    last = index + 1 == len(ticks)
                    packet.stream, packet.time_base = video, unit
                    packet.pts = packet.dts = ticks[index]
                    packet.duration = ticks[index] - ticks[index - 1] if last else ticks[index + 1] - ticks[index]
                    output.mux(packet)
                    index += 1
        if index != len(ticks):
            raise ValueError(f"{path}: the parts have {index} frames, expected {len(ticks)}; delete them to start over")
        sound.write()
