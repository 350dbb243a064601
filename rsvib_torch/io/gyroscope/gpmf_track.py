"""Angular rates from the GPMF track of videos of GoPro cameras.

Formats: ISO/IEC 14496-12 (boxes of MP4 files), and https://github.com/gopro/gpmf-parser (GPMF: entries of a key of four
characters, a type, a size and a number of values, aligned to 4 bytes; entries of type 0 contain entries). A packet
holds devices (DEVC), these streams (STRM), and one stream of each kind the samples (GYRO) after their scale (SCAL).
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.free_memory import size_text
from rsvib_torch.io.gyroscope.gcsv_log import check_orientation, oriented
from rsvib_torch.io.gyroscope.rates_table import angular_rates
from rsvib_torch.motion.gyroscope_rates import AngularRates

__all__ = ["is_mp4", "read_gpmf"]

Array = NDArray[np.float64]

_MAX_INDEX = 2**27  # bytes of the box moov: 128 MiB are the index of a day of video
_MAX_PACKET = 2**24  # bytes of a packet, which holds one second: 16 MiB
_NUMBERS = {
    b"b": "i1", b"B": "u1", b"s": ">i2", b"S": ">u2", b"l": ">i4", b"L": ">u4", b"f": ">f4", b"d": ">f8", b"j": ">i8",
    b"J": ">u8",
}  # fmt: skip


def is_mp4(head: bytes) -> bool:
    """Whether a file begins as an MP4 or QuickTime file."""
    return head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")


def read_gpmf(path: Path) -> AngularRates:
    """Angular rates of the first gyroscope in the GPMF track of a video."""
    with path.open("rb") as file:
        try:
            packets = _packets(path, file)
            parts = list(_parts(path, file, packets))
        except (struct.error, IndexError) as error:
            raise ValueError(f"{path}: damaged MP4 file: {error}") from error
    if not parts:
        raise ValueError(f"{path}: the GPMF track has no angular rates (GYRO)")
    rates = np.concatenate([part.rates for part in parts])
    orientation = parts[0].orientation
    source = f"{path.name}, GPMF track, {len(parts)} packets" + (f", axes {orientation}" if orientation else "")
    rates = oriented(rates, orientation) if orientation else rates
    return angular_rates(path, _sample_times(parts), rates, source)


# MP4


@dataclass(frozen=True)
class _Packet:
    """Place in the file, and time in s, of one packet of the track."""

    place: int
    size: int
    start: float
    duration: float


def _boxes(data: bytes, start: int = 0) -> Iterator[tuple[bytes, bytes]]:
    """Kinds and contents of the boxes in ``data``."""
    while start + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, start)
        head = 8
        if size == 1:
            (size,) = struct.unpack_from(">Q", data, start + 8)
            head = 16
        if size == 0:
            size = len(data) - start
        if size < head or start + size > len(data):
            raise IndexError(f"a box {kind!r} of {size} bytes in {len(data) - start} bytes")
        yield kind, data[start + head : start + size]
        start += size


def _inside(data: bytes, *kinds: bytes) -> bytes | None:
    """Content of a box that is nested in boxes of the given kinds; None if one of them is missing."""
    for kind in kinds:
        found = next((content for name, content in _boxes(data) if name == kind), None)
        if found is None:
            return None
        data = found
    return data


def _index(path: Path, file: BinaryIO) -> bytes:
    """Content of the box moov."""
    end, place = path.stat().st_size, 0
    while place + 8 <= end:
        file.seek(place)
        head = file.read(16)
        size, kind = struct.unpack_from(">I4s", head)
        length = 8
        if size == 1:
            (size,) = struct.unpack_from(">Q", head, 8)
            length = 16
        size = end - place if size == 0 else size
        if size < length or place + size > end:
            raise IndexError(f"a box {kind!r} of {size_text(size)} in {size_text(end - place)}; the file is truncated")
        if kind == b"moov":
            if size > _MAX_INDEX:
                raise ValueError(f"{path}: an index of {size_text(size)}; expected at most {size_text(_MAX_INDEX)}")
            file.seek(place + length)
            return file.read(size - length)
        place += size
    raise ValueError(f"{path}: an MP4 file without index (moov): the recording was interrupted")


def _table(data: bytes | None, name: str, head: int, dtype: str, width: int) -> NDArray[np.int64]:
    """Table (N, width) of a box whose number of entries is in the last 4 bytes of its head."""
    if data is None:
        raise IndexError(f"no box {name}")
    (count,) = struct.unpack_from(">I", data, head - 4)
    item = np.dtype(dtype).itemsize * width
    if head + count * item > len(data):
        raise IndexError(f"a box {name} of {len(data)} bytes with {count} entries")
    return np.frombuffer(data, dtype, count * width, head).astype(np.int64).reshape(-1, width)


def _packets(path: Path, file: BinaryIO) -> list[_Packet]:
    """Packets of the first GPMF track."""
    for kind, track in _boxes(_index(path, file)):
        if kind != b"trak":
            continue
        media = _inside(track, b"mdia")
        table = None if media is None else _inside(media, b"minf", b"stbl")
        description = None if table is None else _inside(table, b"stsd")
        if media is not None and table is not None and description is not None and description[12:16] == b"gpmd":
            return _packets_of_track(path, media, table)
    raise ValueError(f"{path}: a video without a GPMF track (gpmd); read its gyroscope from another file")


def _packets_of_track(path: Path, media: bytes, table: bytes) -> list[_Packet]:
    header = _inside(media, b"mdhd")
    if header is None:
        raise IndexError("no box mdhd")
    (timescale,) = struct.unpack_from(">I", header, 20 if header[0] == 1 else 12)
    if timescale == 0:
        raise IndexError("a track with 0 units per second")
    whole = path.stat().st_size
    sizes_box = _inside(table, b"stsz") or b""
    equal, count = struct.unpack_from(">II", sizes_box, 4)
    if equal and count * equal > whole:
        raise IndexError(f"{count} packets of {equal} bytes in a file of {whole} bytes")
    sizes = np.full(count, equal) if equal else _table(sizes_box, "stsz", 12, ">u4", 1)[:, 0]
    if sizes.sum() > whole:
        raise IndexError(f"packets of {sizes.sum()} bytes in a file of {whole} bytes")
    large = _inside(table, b"co64")
    chunks = _table(large or _inside(table, b"stco"), "stco", 8, ">u8" if large else ">u4", 1)[:, 0]
    runs = _table(_inside(table, b"stsc"), "stsc", 8, ">u4", 3)
    # packets of each chunk: runs of chunks state their first chunk, from 1
    ends = np.append(runs[1:, 0], len(chunks) + 1)
    repeats = ends - runs[:, 0]
    if (repeats < 0).any() or repeats.sum() != len(chunks):
        raise IndexError("chunks of packets in no order")
    each = np.repeat(runs[:, 1], repeats)
    durations = _table(_inside(table, b"stts"), "stts", 8, ">u4", 2)
    if each.sum() != count or durations[:, 0].sum() != count:
        raise IndexError(f"{count} packets, {each.sum()} in chunks, {durations[:, 0].sum()} with times")
    chunk = np.repeat(np.arange(len(chunks)), each)
    before = np.cumsum(sizes) - sizes
    first = np.cumsum(each) - each
    places = chunks[chunk] + before - before[np.minimum(first, max(count - 1, 0))][chunk]
    lasting = np.repeat(durations[:, 1], durations[:, 0]) / timescale
    starts = np.cumsum(lasting) - lasting
    return [
        _Packet(int(place), int(size), float(start), float(duration))
        for place, size, start, duration in zip(places, sizes, starts, lasting, strict=True)
    ]


# GPMF


@dataclass(frozen=True)
class _Part:
    """Samples of one packet.

    Attributes:
        rates: (N, 3) rad/s.
        start: Time of the packet in s.
        duration: Its duration in s.
        stamp: Time of the first sample in s, exact to 1 us (STMP); None if the packet does not state it.
        tick: The same on the clock of the camera, exact to 1 ms (TICK); None if the packet does not state it.
        total: Samples up to the end of the packet that it states; None if it states none.
        orientation: Axes in the order of the file; empty if they are not stated.
    """

    rates: Array
    start: float
    duration: float
    stamp: float | None
    tick: float | None
    total: int | None
    orientation: str


def _entries(data: bytes) -> Iterator[tuple[bytes, bytes, int, int, bytes]]:
    """Key, type, size of a value, number of values, and content of the GPMF entries in ``data``."""
    place = 0
    while place + 8 <= len(data):
        key, kind, size, count = struct.unpack_from(">4scBH", data, place)
        if key == b"\0\0\0\0":
            return  # padding
        length = size * count
        if place + 8 + length > len(data):
            raise IndexError(f"a GPMF entry {key!r} of {length} bytes in {len(data) - place - 8} bytes")
        yield key, kind, size, count, data[place + 8 : place + 8 + length]
        place += 8 + (length + 3) // 4 * 4


def _values(kind: bytes, size: int, content: bytes) -> Array:
    """Values (N, C) of an entry."""
    dtype = np.dtype(_NUMBERS.get(kind, "V1"))
    if dtype.kind == "V" or size == 0 or size % dtype.itemsize:
        raise IndexError(f"GPMF values of type {kind!r} and {size} bytes")
    return np.frombuffer(content, dtype).astype(np.float64).reshape(-1, size // dtype.itemsize)


def _parts(path: Path, file: BinaryIO, packets: list[_Packet]) -> Iterator[_Part]:
    """Samples of the gyroscope of the first device that has one."""
    chosen: bytes | None = None
    for packet in packets:
        if packet.size > _MAX_PACKET:
            raise ValueError(f"{path}: a packet of {size_text(packet.size)}; at most {size_text(_MAX_PACKET)} expected")
        file.seek(packet.place)
        data = file.read(packet.size)
        if len(data) < packet.size:
            raise IndexError(f"a packet at byte {packet.place} beyond the end of the file")
        for key, _, _, _, device in _entries(data):
            if key != b"DEVC":
                continue
            number = next((content for name, *_, content in _entries(device) if name == b"DVID"), b"")
            if chosen is not None and number != chosen:
                continue
            part = next(filter(None, (_part(s, packet) for name, *_, s in _entries(device) if name == b"STRM")), None)
            if part is not None:
                chosen = number
                yield part
                break


def _part(stream: bytes, packet: _Packet) -> _Part | None:
    """Samples of a stream; None if it has no angular rates."""
    found = {key: (kind, size, content) for key, kind, size, _, content in _entries(stream)}
    if b"GYRO" not in found:
        return None
    rates = _values(*found[b"GYRO"])
    if not len(rates):
        return None
    if rates.shape[1] != 3:
        raise IndexError(f"GYRO with {rates.shape[1]} values per sample")
    scale = _values(*found[b"SCAL"]).ravel() if b"SCAL" in found else np.ones(1)
    if len(scale) not in (1, 3) or not (scale != 0).all():
        raise IndexError("GYRO with a wrong SCAL")
    letters = found[b"ORIN"][2].decode("latin-1").strip("\0 ") if b"ORIN" in found else ""
    stamp = float(_values(*found[b"STMP"])[0, 0]) * 1e-6 if b"STMP" in found else None
    tick = float(_values(*found[b"TICK"])[0, 0]) * 1e-3 if b"TICK" in found else None
    total = int(_values(*found[b"TSMP"])[0, 0]) if b"TSMP" in found else None
    orientation = check_orientation(letters) if letters else ""
    return _Part(rates / scale, packet.start, packet.duration, stamp, tick, total, orientation)


def _sample_times(parts: list[_Part]) -> Array:
    """Times (N,) in s of the samples of all packets.

    If packets state the times of their first samples to 1 us, samples in between are at equal distances. Otherwise the
    clock of the gyroscope is regular: a straight line through the times of the packets on the clock of the camera, or
    in the video, in which the camera puts those samples that it has.
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
    ticks = np.array([np.nan if part.tick is None else part.tick for part in parts])
    if len(parts) < 3:
        return np.asarray(starts[0] + duration / ends[-1] * number)
    if (np.diff(stamps) > 0).all():
        step = (stamps[-1] - stamps[0]) / firsts[-1]
        known = np.append(stamps, stamps[-1] + step * counts[-1])
        return np.asarray(np.interp(number, np.append(firsts, ends[-1]), known))
    clock = ticks if (np.diff(ticks) > 0).all() else starts
    slope, first = np.polyfit(firsts, clock - clock.mean(), 1)
    return np.asarray(first + starts.mean() + slope * number)
