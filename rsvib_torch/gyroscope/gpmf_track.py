"""Angular rates from the GPMF track of videos of GoPro cameras.

Format: https://github.com/gopro/gpmf-parser (entries of a key of four characters, a type, a size and a number of
values, aligned to 4 bytes; entries of type 0 contain entries). A packet holds devices (DEVC), these streams (STRM), and
one stream of each kind the samples (GYRO) after their scale (SCAL).
"""

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
    b"b": "i1", b"B": "u1", b"c": "u1", b"s": ">i2", b"S": ">u2", b"l": ">i4", b"L": ">u4", b"f": ">f4", b"d": ">f8",
    b"j": ">i8", b"J": ">u8",
}  # fmt: skip
_KEYS = (b"GYRO", b"SCAL", b"ORIN", b"TSMP", b"SHUT", b"IORI")  # of the entries that are read
_NONE = np.zeros((0, 0))  # values of an entry that a stream does not have

_Stream = dict[bytes, Array]  # values (N, C) of the entry of each key


@dataclass(frozen=True)
class _Packet:
    """One packet of the track."""

    start: float  # s
    duration: float  # s
    streams: list[_Stream]  # of the device that has a gyroscope, or of the first one
    gyroscope: _Stream  # that with angular rates; empty if there is none


@dataclass(frozen=True)
class CameraTrack:
    """What the GPMF track of a video states about its frames."""

    times: Array  # (N,) s, of the exposures in the video
    exposures: Array  # (N,) s (SHUT); empty if they are not stated
    turned: float  # rad, largest rotation of an image against the camera (IORI); 0 if it is not stated

    @classmethod
    def of(cls, packets: list[_Packet]) -> "CameraTrack":
        """The statements of all packets."""
        times, exposures, turned = list[Array]([_NONE.ravel()]), list[Array]([_NONE.ravel()]), 0.0
        for packet in packets:
            for stream in packet.streams:
                shutter, quaternions = stream.get(b"SHUT", _NONE).ravel(), stream.get(b"IORI", _NONE)
                if len(shutter) and (shutter > 0).all():
                    times.append(packet.start + packet.duration / len(shutter) * np.arange(len(shutter)))
                    exposures.append(shutter)
                if quaternions.shape[1] == 4:  # w, x, y, z
                    angles = 2 * np.arctan2(np.linalg.norm(quaternions[:, 1:], axis=1), np.abs(quaternions[:, 0]))
                    turned = float(np.fmax.reduce(angles, initial=turned))  # those that are NaN do not count
        return cls(np.concatenate(times), np.concatenate(exposures), turned)

    @property
    def stabilised(self) -> bool:
        """Whether the camera has stabilised its images."""
        return self.turned > _SMALLEST_TURN

    def exposures_at(self, times: Array) -> Array:
        """Exposures in s of frames at times in s of the video."""
        return np.interp(times, self.times, self.exposures)


def is_mp4(head: bytes) -> bool:
    """Whether a file begins as an MP4 or QuickTime file."""
    return head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")


def read_gpmf(path: Path) -> tuple[Array, Array, str, str]:
    """Times (N,) in s, rates (N, 3) in rad/s, a description and the axes of the first gyroscope in a GPMF track."""
    try:
        track = _packets(path)
        packets = [packet for packet in track if packet.gyroscope]
        rates = [_rates(packet.gyroscope) for packet in packets]
        times = _sample_times(packets, np.array([len(part) for part in rates])) if packets else _NONE
    except ValueError as error:
        raise ValueError(f"{path}: damaged MP4 file: {error}") from error
    if not packets:
        raise ValueError(
            f"{path}: a video without a GPMF track (gpmd) that has angular rates (GYRO); read them from another file"
        )
    letters = (bytes(packet.gyroscope.get(b"ORIN", _NONE).astype(np.uint8)) for packet in packets)
    axes = next(filter(None, (text.decode("latin-1").strip("\0 ") for text in letters)), "")
    source = f"GPMF track, {len(packets)} packets" + (f", axes {axes}" if axes else "")
    if CameraTrack.of(track).stabilised:
        source += ", images that the camera has stabilised (IORI)"
    return times, np.concatenate(rates), source, axes or "XYZ"


def read_camera_track(path: Path) -> CameraTrack | None:
    """What the GPMF track of a video states about its frames; None for other files and without a track.

    A damaged one causes a ``UserWarning``, and is not used.
    """
    if not path.is_file():
        return None
    with path.open("rb") as file:
        if not is_mp4(file.read(64)):
            return None
    try:
        packets = _packets(path)
    except ValueError as error:
        warnings.warn(f"{path}: the GPMF track is damaged and is not used: {error}", stacklevel=2)
        return None
    return CameraTrack.of(packets) if packets else None


def _packets(path: Path) -> list[_Packet]:
    """Packets of the first GPMF track; none without one. Damage is a ``ValueError``."""
    av = needed_package("av", "reading the gyroscope of a video", "video")
    try:
        with av.open(str(path), format="mp4") as container:
            for track in container.streams.data:
                packets = list[_Packet]()
                for packet in container.demux(track):
                    data, unit = bytes(packet), track.time_base
                    if not data or (not packets and data[:4] != b"DEVC"):  # the end, or another kind of track
                        break
                    if len(packets) == _MAX_PACKETS:
                        raise ValueError(f"more than {_MAX_PACKETS:,} GPMF packets")
                    start, duration = (float((ticks or 0) * unit) for ticks in (packet.pts, packet.duration))
                    devices = [[*map(_stream, _contents(device, b"STRM"))] for device in _contents(data, b"DEVC")]
                    if not devices:
                        raise ValueError(f"GPMF packet {len(packets)} has no device (DEVC)")
                    rated = [(device, stream) for device in devices for stream in device if b"GYRO" in stream]
                    packets.append(_Packet(start, duration, *(rated[0] if rated else (devices[0], {}))))
                if packets:
                    return packets
                container.seek(0)
    except av.error.FFmpegError as error:
        raise ValueError(error.strerror) from error
    return []


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


def _stream(data: bytes) -> _Stream:
    """The values of a stream that are read."""
    stream: _Stream = {}
    for key, kind, size, content in _entries(data):
        if key in _KEYS and content:
            dtype = np.dtype(_NUMBERS.get(kind, "V1"))
            if dtype.kind == "V" or size % dtype.itemsize:
                raise ValueError(f"GPMF values {key!r} of type {kind!r} and {size} bytes")
            stream[key] = np.frombuffer(content, dtype).astype(np.float64).reshape(-1, size // dtype.itemsize)
    return stream


def _rates(gyroscope: _Stream) -> Array:
    """Rates (N, 3) in rad/s of one packet."""
    rates, scale = gyroscope[b"GYRO"], gyroscope.get(b"SCAL", np.ones((1, 1))).ravel()
    if rates.shape[1] != 3 or len(scale) not in (1, 3) or not scale.all():
        raise ValueError(f"GYRO with {rates.shape[1]} values per sample and SCAL {scale.tolist()}")
    return rates / scale


def _sample_times(packets: list[_Packet], counts: Array) -> Array:
    """Times (N,) in s of the samples of all packets, which have ``counts`` samples.

    The samples up to the end of a packet were taken until then: a straight line, of which the offset and the slope are
    those of the clock that ``align_motion`` fits. The first packet may begin late, and the last may end early.
    """
    # Number of each sample: those that are missing have numbers, if the totals (TSMP) are stated.
    ends = np.cumsum(counts)
    totals = np.array([packet.gyroscope.get(b"TSMP", np.full((1, 1), np.nan))[0, 0] for packet in packets])
    if (np.diff(totals) >= counts[1:]).all():
        ends = (totals - totals[0]).astype(np.int64) + counts[0]
    number = np.concatenate([end - count + np.arange(count) for end, count in zip(ends, counts, strict=True)])
    # Time of each number, of a few packets by their duration.
    starts = np.array([packet.start for packet in packets])
    if len(packets) < 3:
        first, slope = starts[0], (starts[-1] + packets[-1].duration - starts[0]) / ends[-1]
    else:
        slope, first = np.polyfit(ends[:-1], starts[1:], 1)
    return np.asarray(first + slope * number)
