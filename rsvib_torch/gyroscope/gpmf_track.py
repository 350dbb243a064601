"""Angular rates from the GPMF track of videos of GoPro cameras.

Format: https://github.com/gopro/gpmf-parser (entries of a key of four characters, a type, a size and a number of
values, aligned to 4 bytes; entries of type 0 contain entries). A packet holds devices (DEVC), these streams (STRM), and
one stream of each kind the samples (GYRO) after their scale (SCAL).
"""

import math
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rsvib_torch.checks.values import needed_package
from rsvib_torch.numerics.tables import Array

_MAX_PACKETS = 10**5  # 28 hours; cameras write one per second
_SMALLEST_TURN = 2e-3  # rad; 1 px with a focal length of 500 px

_NUMBERS = {
    b"b": "i1", b"B": "u1", b"s": ">i2", b"S": ">u2", b"l": ">i4", b"L": ">u4", b"f": ">f4", b"d": ">f8", b"j": ">i8",
    b"J": ">u8",
}  # fmt: skip


def is_mp4(head: bytes) -> bool:
    """Whether a file begins as an MP4 or QuickTime file."""
    return head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")


def read_gpmf(path: Path) -> tuple[Array, Array, str, str]:
    """Times (N,) in s, rates (N, 3) in rad/s, a description and the axes of the first gyroscope in a GPMF track."""
    try:
        parts = list(_parts(_packets(path)))
    except (struct.error, IndexError) as error:
        raise ValueError(f"{path}: damaged MP4 file: {error}") from error
    if not parts:
        raise ValueError(
            f"{path}: a video without a GPMF track (gpmd) that has angular rates (GYRO); read them from another file"
        )
    orientation = parts[0].orientation
    source = f"GPMF track, {len(parts)} packets" + (f", axes {orientation}" if orientation else "")
    if max(part.turned for part in parts) > _SMALLEST_TURN:
        source += ", images that the camera has stabilised (IORI)"
    return _sample_times(parts), np.concatenate([part.rates for part in parts]), source, orientation or "XYZ"


@dataclass(frozen=True)
class CameraTrack:
    """What the GPMF track of a video states about its frames."""

    times: Array  # (N,) s, of the exposures in the video
    exposures: Array  # (N,) s (SHUT); empty if they are not stated
    turned: float  # rad, largest rotation of an image against the camera (IORI); 0 if it is not stated

    @property
    def stabilised(self) -> bool:
        """Whether the camera has stabilised its images."""
        return self.turned > _SMALLEST_TURN

    def exposures_at(self, times: Array) -> Array:
        """Exposures in s of frames at times in s of the video."""
        return np.interp(times, self.times, self.exposures)


def read_camera_track(path: Path) -> CameraTrack | None:
    """What the GPMF track of a video states about its frames; None for other files and without a track.

    A damaged one causes a ``UserWarning``, and is not used.
    """
    if not path.is_file():
        return None
    with path.open("rb") as file:
        if not is_mp4(file.read(64)):
            return None
    times, exposures, turned, packet = list[Array]([np.zeros(0)]), list[Array]([np.zeros(0)]), 0.0, None
    try:
        for packet in _packets(path):
            for stream in (stream for _, streams in packet.devices() for stream in streams):
                shutter = _found(stream, b"SHUT")
                if len(shutter) and (shutter > 0).all():
                    times.append(packet.start + packet.duration / len(shutter) * np.arange(len(shutter)))
                    exposures.append(shutter[:, 0])
                turned = max(turned, _largest_turn(stream))
    except (ValueError, struct.error, IndexError) as error:
        problem = str(error).removeprefix(f"{path}: ")
        warnings.warn(f"{path}: the GPMF track is damaged and is not used: {problem}", stacklevel=2)
        return None
    return None if packet is None else CameraTrack(np.concatenate(times), np.concatenate(exposures), turned)


_Stream = dict[bytes, tuple[bytes, int, bytes]]  # type, size of a value and content of the entries of each key


@dataclass(frozen=True)
class _Packet:
    """Content of one packet of the track, with its time and duration in s."""

    data: bytes
    start: float
    duration: float

    def devices(self) -> Iterator[tuple[bytes, list[_Stream]]]:
        """Number and streams of each device."""
        for key, *_, device in _entries(self.data):
            if key == b"DEVC":
                entries = [(name, content) for name, *_, content in _entries(device)]
                number = next((content for name, content in entries if name == b"DVID"), b"")
                parts = [_entries(content) for name, content in entries if name == b"STRM"]
                yield number, [{name: (kind, size, value) for name, kind, size, value in part} for part in parts]


def _packets(path: Path) -> Iterator[_Packet]:
    """Packets of the first GPMF track; none without one."""
    av = needed_package("av", "reading the gyroscope of a video", "video")
    try:
        with av.open(str(path), format="mp4") as container:
            for stream in container.streams.data:
                found = False
                for packet in container.demux(stream):
                    data = bytes(packet)
                    if not data:  # the last packet of a stream
                        break
                    if not found and data[:4] != b"DEVC":  # another kind of track
                        break
                    found, unit = True, stream.time_base
                    yield _Packet(data, float((packet.pts or 0) * unit), float((packet.duration or 0) * unit))
                if found:
                    return
                container.seek(0)
    except av.error.FFmpegError as error:
        raise ValueError(f"{path}: damaged MP4 file: {error.strerror}") from error


@dataclass(frozen=True)
class _Part:
    """Samples of one packet; times and numbers that are not stated are NaN."""

    rates: Array  # (N, 3) rad/s
    packet: _Packet
    stamp: float  # s, time of the first sample on the clock of the camera (STMP)
    earliest: float  # s, the earliest time that any stream of the packet states
    total: float  # samples up to the end of the packet
    orientation: str  # axes in the order of the file; empty if they are not stated
    turned: float  # rad, largest rotation of the images against the camera


def _entries(data: bytes) -> Iterator[tuple[bytes, bytes, int, bytes]]:
    """Key, type, size of a value, and content of the GPMF entries in ``data``."""
    place = 0
    while place + 8 <= len(data):
        key, kind, size, count = struct.unpack_from(">4scBH", data, place)
        if key == b"\0\0\0\0":
            return  # padding
        length = size * count
        if place + 8 + length > len(data):
            raise IndexError(f"a GPMF entry {key!r} of {length} bytes in {len(data) - place - 8} bytes")
        yield key, kind, size, data[place + 8 : place + 8 + length]
        place += 8 + (length + 3) // 4 * 4


def _values(kind: bytes, size: int, content: bytes) -> Array:
    """Values (N, C) of an entry."""
    dtype = np.dtype(_NUMBERS.get(kind, "V1"))
    if dtype.kind == "V" or size == 0 or size % dtype.itemsize:
        raise IndexError(f"GPMF values of type {kind!r} and {size} bytes")
    values = np.frombuffer(content, dtype).astype(np.float64).reshape(-1, size // dtype.itemsize)
    if not np.isfinite(values).all():
        raise IndexError("GPMF values that are not finite")
    return values


def _parts(packets: Iterator[_Packet]) -> Iterator[_Part]:
    """Samples of the gyroscope of the first device that has one."""
    chosen: bytes | None = None
    for count, packet in enumerate(packets):
        if count == _MAX_PACKETS:
            raise IndexError(f"more than {_MAX_PACKETS:,} GPMF packets")
        for number, streams in packet.devices():
            gyroscope = next((stream for stream in streams if len(_found(stream, b"GYRO"))), None)
            if gyroscope is not None and chosen in (None, number):
                chosen = number
                yield _part(gyroscope, streams, packet)
                break


def _part(gyroscope: _Stream, streams: list[_Stream], packet: _Packet) -> _Part:
    """Samples of the stream of a gyroscope, one of those of its device."""
    rates, scale = _found(gyroscope, b"GYRO"), _found(gyroscope, b"SCAL").ravel()
    if rates.shape[1] != 3:
        raise IndexError(f"GYRO with {rates.shape[1]} values per sample")
    if len(scale) not in (0, 1, 3) or not (scale != 0).all():
        raise IndexError("GYRO with a wrong SCAL")
    stamps = [1e-6 * _first(stream, b"STMP") for stream in streams if b"STMP" in stream]
    return _Part(
        rates / scale if len(scale) else rates,
        packet,
        1e-6 * _first(gyroscope, b"STMP"),
        min(stamps, default=math.nan),
        _first(gyroscope, b"TSMP"),
        gyroscope.get(b"ORIN", (b"", 0, b""))[2].decode("latin-1").strip("\0 "),
        max(map(_largest_turn, streams)),
    )


def _found(stream: _Stream, key: bytes) -> Array:
    """Values (N, C) of the entry of a stream that has a key; (0, 0) if there is none."""
    return _values(*stream[key]) if key in stream else np.zeros((0, 0))


def _first(stream: _Stream, key: bytes) -> float:
    """The first value of the entry of a stream that has a key; NaN if there is none."""
    values = _found(stream, key)
    return float(values[0, 0]) if values.size else math.nan


def _largest_turn(stream: _Stream) -> float:
    """Largest rotation in rad of the images against the camera (IORI, quaternions w, x, y, z); 0 without."""
    quaternions = _found(stream, b"IORI")
    if not len(quaternions) or quaternions.shape[1] != 4:
        return 0.0
    return float(2 * np.arctan2(np.linalg.norm(quaternions[:, 1:], axis=1), np.abs(quaternions[:, 0])).max())


def _sample_times(parts: list[_Part]) -> Array:
    """Times (N,) in s of the samples of all packets.

    As in ``GetGPMFSampleRate`` of gpmf-parser, the reference implementation: the clock of stamps (STMP) starts
    anywhere, and the earliest stamp of the first packet is the start of that packet. Without stamps, the samples up to
    the end of a packet were taken until then: a straight line. The first packet may begin late, and the last may end
    early. Ticks (TICK) are not used: they are times of the operating system in ms (gpmf-parser issue 63).
    """
    counts = np.array([len(part.rates) for part in parts])
    ends = np.cumsum(counts)
    stated = np.array([part.total for part in parts])
    if (np.diff(stated) >= counts[1:]).all():  # samples that are missing have numbers
        ends = (stated - stated[0]).astype(np.int64) + counts[0]
    firsts = (ends - counts).astype(np.float64)
    number = np.concatenate([first + np.arange(count) for first, count in zip(firsts, counts, strict=True)])
    starts = np.array([part.packet.start for part in parts])
    duration = starts[-1] + parts[-1].packet.duration - starts[0]
    stamps = np.array([part.stamp for part in parts])
    if len(parts) < 3:
        return np.asarray(starts[0] + duration / ends[-1] * number)
    if (np.diff(stamps) > 0).all():
        step = (stamps[-1] - stamps[0]) / firsts[-1]
        known = np.append(stamps, stamps[-1] + step * counts[-1]) - parts[0].earliest + starts[0]
        return np.asarray(np.interp(number, np.append(firsts, ends[-1]), known))
    slope, first = np.polyfit(ends[:-1], starts[1:], 1)
    return np.asarray(first + slope * number)
