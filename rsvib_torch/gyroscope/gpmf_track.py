"""Angular rates from the GPMF track of videos of GoPro cameras.

Format: https://github.com/gopro/gpmf-parser (entries of a key of four characters, a type, a size and a number of
values, aligned to 4 bytes; entries of type 0 contain entries). A packet holds devices (DEVC), these streams (STRM), and
one stream of each kind the samples (GYRO) after their scale (SCAL).
"""

import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rsvib_torch.checks.values import needed_package
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates, angular_rates
from rsvib_torch.numerics.tables import Array

_MAX_PACKETS = 10**5  # 28 hours; cameras write one per second
_SMALLEST_TURN = 2e-3  # rad; 1 px with a focal length of 500 px

_NUMBERS = {
    b"b": "i1", b"B": "u1", b"s": ">i2", b"S": ">u2", b"l": ">i4", b"L": ">u4", b"f": ">f4", b"d": ">f8", b"j": ">i8",
    b"J": ">u8",
}  # fmt: skip


class _NoTrackError(ValueError):
    """A video has no GPMF track."""


def is_mp4(head: bytes) -> bool:
    """Whether a file begins as an MP4 or QuickTime file."""
    return head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")


def read_gpmf(path: Path) -> AngularRates:
    """Angular rates of the first gyroscope in the GPMF track of a video."""
    try:
        parts = list(_parts(_packets(path)))
    except (struct.error, IndexError) as error:
        raise ValueError(f"{path}: damaged MP4 file: {error}") from error
    if not parts:
        raise ValueError(f"{path}: the GPMF track has no angular rates (GYRO)")
    rates = np.concatenate([part.rates for part in parts])
    orientation = parts[0].orientation
    source = f"{path.name}, GPMF track, {len(parts)} packets" + (f", axes {orientation}" if orientation else "")
    if any(part.stabilised for part in parts):
        source += ", images that the camera has stabilised (IORI)"
    return angular_rates(path, _sample_times(parts), rates, source, orientation or "XYZ")


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
    times, exposures, turned = [], [], 0.0
    try:
        for packet in _packets(path):
            for _, streams in _devices(packet.data):
                for stream in streams:
                    shutter = _found(stream, b"SHUT")
                    if shutter is not None and len(shutter) and (shutter > 0).all():
                        times.append(packet.start + packet.duration / len(shutter) * np.arange(len(shutter)))
                        exposures.append(shutter[:, 0])
                    turned = max(turned, _largest_turn(stream))
    except _NoTrackError:
        return None
    except (ValueError, struct.error, IndexError) as error:
        problem = str(error).removeprefix(f"{path}: ")
        warnings.warn(f"{path}: the GPMF track is damaged and is not used: {problem}", stacklevel=2)
        return None
    if not times:
        return CameraTrack(np.zeros(0), np.zeros(0), turned)
    return CameraTrack(np.concatenate(times), np.concatenate(exposures), turned)


@dataclass(frozen=True)
class _Packet:
    """Content of one packet of the track, with its time and duration in s."""

    data: bytes
    start: float
    duration: float


def _packets(path: Path) -> Iterator[_Packet]:
    """Packets of the first GPMF track."""
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
    raise _NoTrackError(f"{path}: a video without a GPMF track (gpmd); read its gyroscope from another file")


# GPMF


@dataclass(frozen=True)
class _Part:
    """Samples of one packet."""

    rates: Array  # (N, 3) rad/s
    start: float  # s, time of the packet
    duration: float  # s
    stamp: float | None  # s, time of the first sample on the clock of the camera (STMP); None: not stated
    earliest: float | None  # s, the earliest time that any stream of the packet states
    total: int | None  # samples up to the end of the packet that it states
    orientation: str  # axes in the order of the file; empty if they are not stated
    stabilised: bool = False  # whether the images are turned against the camera


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
        for number, streams in _devices(packet.data):
            if chosen is not None and number != chosen:
                continue
            stamps = [stamp for stamp in map(_stamp, streams) if stamp is not None]
            earliest = min(stamps, default=None)
            part = next(filter(None, (_part(stream, packet, earliest) for stream in streams)), None)
            if part is not None:
                chosen = number
                yield replace(part, stabilised=max(map(_largest_turn, streams)) > _SMALLEST_TURN)
                break


def _devices(data: bytes) -> Iterator[tuple[bytes, list[bytes]]]:
    """Number and streams of each device in a packet."""
    for key, *_, device in _entries(data):
        if key == b"DEVC":
            entries = [(name, content) for name, *_, content in _entries(device)]
            number = next((content for name, content in entries if name == b"DVID"), b"")
            yield number, [content for name, content in entries if name == b"STRM"]


def _found(stream: bytes, key: bytes) -> Array | None:
    """Values (N, C) of the entry of a stream that has a key; None if there is none."""
    return next((_values(kind, size, content) for name, kind, size, content in _entries(stream) if name == key), None)


def _stamp(stream: bytes) -> float | None:
    """Time of the first sample of a stream in s on the clock of the camera; None if it is not stated."""
    stamp = _found(stream, b"STMP")
    return None if stamp is None else float(stamp[0, 0]) * 1e-6


def _largest_turn(stream: bytes) -> float:
    """Largest rotation in rad of the images against the camera (IORI, quaternions w, x, y, z); 0 without."""
    quaternions = _found(stream, b"IORI")
    if quaternions is None or not len(quaternions) or quaternions.shape[1] != 4:
        return 0.0
    return float(2 * np.arctan2(np.linalg.norm(quaternions[:, 1:], axis=1), np.abs(quaternions[:, 0])).max())


def _part(stream: bytes, packet: _Packet, earliest: float | None) -> _Part | None:
    """Samples of a stream; None if it has no angular rates."""
    rates = _found(stream, b"GYRO")
    if rates is None or not len(rates):
        return None
    if rates.shape[1] != 3:
        raise IndexError(f"GYRO with {rates.shape[1]} values per sample")
    scale, total = _found(stream, b"SCAL"), _found(stream, b"TSMP")
    scale = np.ones(1) if scale is None else scale.ravel()
    if len(scale) not in (1, 3) or not (scale != 0).all():
        raise IndexError("GYRO with a wrong SCAL")
    letters = next((content for name, *_, content in _entries(stream) if name == b"ORIN"), b"")
    orientation = letters.decode("latin-1").strip("\0 ")
    samples = None if total is None else int(total[0, 0])
    return _Part(rates / scale, packet.start, packet.duration, _stamp(stream), earliest, samples, orientation)


def _sample_times(parts: list[_Part]) -> Array:
    """Times (N,) in s of the samples of all packets.

    As in ``GetGPMFSampleRate`` of gpmf-parser, the reference implementation: the clock of stamps (STMP) starts
    anywhere, and the earliest stamp of the first packet is the start of that packet. Without stamps, the samples up to
    the end of a packet were taken until then: a straight line. The first packet may begin late, and the last may end
    early. Ticks (TICK) are not used: they are times of the operating system in ms (gpmf-parser issue 63).
    """
    counts = np.array([len(part.rates) for part in parts])
    ends = np.cumsum(counts)
    stated = np.array([np.nan if part.total is None else part.total for part in parts])
    if (np.diff(stated) >= counts[1:]).all():  # samples that are missing have numbers
        ends = (stated - stated[0]).astype(np.int64) + counts[0]
    firsts = (ends - counts).astype(np.float64)
    number = np.concatenate([first + np.arange(count) for first, count in zip(firsts, counts, strict=True)])
    starts = np.array([part.start for part in parts])
    duration = parts[-1].start + parts[-1].duration - starts[0]
    stamps = np.array([np.nan if part.stamp is None else part.stamp for part in parts])
    if len(parts) < 3:
        return np.asarray(starts[0] + duration / ends[-1] * number)
    if (np.diff(stamps) > 0).all():
        step = (stamps[-1] - stamps[0]) / firsts[-1]
        known = np.append(stamps, stamps[-1] + step * counts[-1]) - (parts[0].earliest or 0.0) + starts[0]
        return np.asarray(np.interp(number, np.append(firsts, ends[-1]), known))
    slope, first = np.polyfit(ends[:-1], starts[1:], 1)
    return np.asarray(first + slope * number)
