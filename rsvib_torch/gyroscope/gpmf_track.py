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
    packets, rates, axes, turned = list[_Packet](), list[Array](), "", 0.0
    try:
        for packet in _packets(path):
            if packet.gyroscope is not None:
                packets.append(packet)
                rates.append(_rates(packet.gyroscope))
                axes = axes or packet.gyroscope.get(b"ORIN", (b"", 0, b""))[2].decode("latin-1").strip("\0 ")
                turned = max(turned, *map(_largest_turn, packet.streams))
        if packets:
            times = _sample_times(packets, np.array([len(part) for part in rates]))
    except ValueError as error:
        raise ValueError(f"{path}: damaged MP4 file: {error}") from error
    if not packets:
        raise ValueError(
            f"{path}: a video without a GPMF track (gpmd) that has angular rates (GYRO); read them from another file"
        )
    source = f"GPMF track, {len(packets)} packets" + (f", axes {axes}" if axes else "")
    if turned > _SMALLEST_TURN:
        source += ", images that the camera has stabilised (IORI)"
    return times, np.concatenate(rates), source, axes or "XYZ"


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
            for stream in packet.streams:
                shutter = _values(stream, b"SHUT").ravel()
                if len(shutter) and (shutter > 0).all():
                    times.append(packet.start + packet.duration / len(shutter) * np.arange(len(shutter)))
                    exposures.append(shutter)
                turned = max(turned, _largest_turn(stream))
    except ValueError as error:
        warnings.warn(f"{path}: the GPMF track is damaged and is not used: {error}", stacklevel=2)
        return None
    return None if packet is None else CameraTrack(np.concatenate(times), np.concatenate(exposures), turned)


_Stream = dict[bytes, tuple[bytes, int, bytes]]  # type, size of a value, and content of the entries of each key


@dataclass(frozen=True)
class _Packet:
    """One packet of the track."""

    start: float  # s
    duration: float  # s
    streams: list[_Stream]  # of the device that has a gyroscope, or of the first one

    @property
    def gyroscope(self) -> _Stream | None:
        """The stream with angular rates."""
        return next((stream for stream in self.streams if _values(stream, b"GYRO").size), None)


def _packets(path: Path) -> Iterator[_Packet]:
    """Packets of the first GPMF track; none without one. Damage is a ``ValueError``."""
    av = needed_package("av", "reading the gyroscope of a video", "video")
    try:
        with av.open(str(path), format="mp4") as container:
            for track in container.streams.data:
                count = 0
                for packet in container.demux(track):
                    data, unit = bytes(packet), track.time_base
                    if not data or (count == 0 and data[:4] != b"DEVC"):  # the end, or another kind of track
                        break
                    count += 1
                    if count > _MAX_PACKETS:
                        raise ValueError(f"more than {_MAX_PACKETS:,} GPMF packets")
                    start, duration = (float((ticks or 0) * unit) for ticks in (packet.pts, packet.duration))
                    devices = [_Packet(start, duration, _streams(device)) for device in _contents(data, b"DEVC")]
                    yield next((device for device in devices if device.gyroscope is not None), devices[0])
                if count:
                    return
                container.seek(0)
    except av.error.FFmpegError as error:
        raise ValueError(error.strerror) from error


def _entries(data: bytes) -> Iterator[tuple[bytes, bytes, int, bytes]]:
    """Key, type, size of a value, and content of the GPMF entries in ``data``."""
    place = 0
    while place + 8 <= len(data):
        key, kind, size, count = struct.unpack_from(">4scBH", data, place)
        if key == b"\0\0\0\0":
            return  # padding
        length = size * count
        if place + 8 + length > len(data):
            raise ValueError(f"a GPMF entry {key!r} of {length} bytes in {len(data) - place - 8} bytes")
        yield key, kind, size, data[place + 8 : place + 8 + length]
        place += 8 + (length + 3) // 4 * 4


def _contents(data: bytes, key: bytes) -> list[bytes]:
    """Contents of the entries of a key."""
    return [content for name, *_, content in _entries(data) if name == key]


def _streams(device: bytes) -> list[_Stream]:
    """The streams of a device."""
    parts = (_entries(content) for content in _contents(device, b"STRM"))
    return [{key: (kind, size, value) for key, kind, size, value in part} for part in parts]


def _values(stream: _Stream, key: bytes) -> Array:
    """Values (N, C) of the entry of a stream that has a key; (0, 0) if there is none."""
    if key not in stream:
        return np.zeros((0, 0))
    kind, size, content = stream[key]
    dtype = np.dtype(_NUMBERS.get(kind, "V1"))
    if dtype.kind == "V" or size == 0 or size % dtype.itemsize:
        raise ValueError(f"GPMF values of type {kind!r} and {size} bytes")
    values = np.frombuffer(content, dtype).astype(np.float64).reshape(-1, size // dtype.itemsize)
    if not np.isfinite(values).all():
        raise ValueError("GPMF values that are not finite")
    return values


def _first(stream: _Stream, key: bytes) -> float:
    """The first value of the entry of a stream that has a key; NaN if there is none."""
    values = _values(stream, key)
    return float(values[0, 0]) if values.size else math.nan


def _rates(gyroscope: _Stream) -> Array:
    """Rates (N, 3) in rad/s of one packet."""
    rates, scale = _values(gyroscope, b"GYRO"), _values(gyroscope, b"SCAL").ravel()
    if rates.shape[1] != 3:
        raise ValueError(f"GYRO with {rates.shape[1]} values per sample")
    if len(scale) not in (0, 1, 3) or not (scale != 0).all():
        raise ValueError("GYRO with a wrong SCAL")
    return rates / scale if len(scale) else rates


def _largest_turn(stream: _Stream) -> float:
    """Largest rotation in rad of the images against the camera (IORI, quaternions w, x, y, z); 0 without."""
    quaternions = _values(stream, b"IORI")
    if not len(quaternions) or quaternions.shape[1] != 4:
        return 0.0
    return float(2 * np.arctan2(np.linalg.norm(quaternions[:, 1:], axis=1), np.abs(quaternions[:, 0])).max())


def _sample_times(packets: list[_Packet], counts: Array) -> Array:
    """Times (N,) in s of the samples of all packets, which have ``counts`` samples.

    As in ``GetGPMFSampleRate`` of gpmf-parser, the reference implementation: the clock of stamps (STMP) starts
    anywhere, and the earliest stamp of the first packet is the start of that packet. Without stamps, the samples up to
    the end of a packet were taken until then: a straight line. The first packet may begin late, and the last may end
    early. Ticks (TICK) are not used: they are times of the operating system in ms (gpmf-parser issue 63).
    """
    gyroscopes = [packet.gyroscope or {} for packet in packets]
    # Number of each sample: those that are missing have numbers, if the totals (TSMP) are stated.
    ends = np.cumsum(counts)
    stated = np.array([_first(stream, b"TSMP") for stream in gyroscopes])
    if (np.diff(stated) >= counts[1:]).all():
        ends = (stated - stated[0]).astype(np.int64) + counts[0]
    firsts = (ends - counts).astype(np.float64)
    number = np.concatenate([first + np.arange(count) for first, count in zip(firsts, counts, strict=True)])
    # Time of each number: by stamps, by the ends of the packets, or of a few packets by their duration.
    starts = np.array([packet.start for packet in packets])
    if len(packets) < 3:
        duration = starts[-1] + packets[-1].duration - starts[0]
        return np.asarray(starts[0] + duration / ends[-1] * number)
    stamps = 1e-6 * np.array([_first(stream, b"STMP") for stream in gyroscopes])
    if (np.diff(stamps) > 0).all():
        earliest = 1e-6 * min(_first(stream, b"STMP") for stream in packets[0].streams if b"STMP" in stream)
        step = (stamps[-1] - stamps[0]) / firsts[-1]
        known = np.append(stamps, stamps[-1] + step * counts[-1]) - earliest + starts[0]
        return np.asarray(np.interp(number, np.append(firsts, ends[-1]), known))
    slope, first = np.polyfit(ends[:-1], starts[1:], 1)
    return np.asarray(first + slope * number)
