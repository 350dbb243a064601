"""Files of gyroscopes: CSV, and videos with a GPMF track by a writer that shares nothing with the reader."""

import struct

import numpy as np

TIMES = np.arange(60) / 200.0
RATES = np.round(np.stack([0.5 * np.sin(20 * TIMES), -0.3 * np.cos(9 * TIMES), 0.1 + 0.4 * TIMES], -1), 3)


def write_rates(path, rates):
    """A CSV file of ``AngularRates``."""
    rows = np.column_stack([rates.times, rates.rates])
    np.savetxt(path, rows, "%.12g", ",", header="time_s,gx_rad_s,gy_rad_s,gz_rad_s", comments="")


def box(kind, *contents):
    content = b"".join(contents)
    return struct.pack(">I", 8 + len(content)) + kind + content


def entry(key, kind, size, count, content):
    return key + kind + struct.pack(">BH", size, count) + content + b"\0" * (-len(content) % 4)


def packet(rates, *, total, orientation=b"", turned=None, exposures=None):
    accelerations = entry(b"ACCL", b"s", 6, 1, struct.pack(">hhh", 1, 2, 3))
    if turned is not None:  # quaternions of the images against the camera
        is_whole = np.isfinite(turned).all()
        quaternions = np.round(32767 * np.asarray(turned)).astype(">i2" if is_whole else ">f4")
        accelerations = entry(b"SCAL", b"s", 2, 1, struct.pack(">h", 32767)) + accelerations
        kind, size = (b"s", 8) if is_whole else (b"f", 16)
        accelerations += entry(b"IORI", kind, size, len(quaternions), quaternions.tobytes())
    more = b""
    if exposures is not None:  # s, of the frames
        values = entry(b"SHUT", b"f", 4, len(exposures), np.asarray(exposures).astype(">f4").tobytes())
        more = entry(b"STRM", b"\0", 1, len(values), values)
    parts = [entry(b"TSMP", b"L", 4, 1, struct.pack(">I", total))]
    parts.append(entry(b"SCAL", b"s", 2, 1, struct.pack(">h", 1000)))
    if orientation:
        parts.append(entry(b"ORIN", b"c", 1, 3, orientation))
    raw = np.round(np.asarray(rates) * 1000).astype(">i2").tobytes()
    parts.append(entry(b"GYRO", b"s", 6, len(rates), raw))
    other = entry(b"STRM", b"\0", 1, len(accelerations), accelerations)
    own = b"".join(parts)
    content = entry(b"DVID", b"L", 4, 1, b"\0\0\0\1") + other + more + entry(b"STRM", b"\0", 1, len(own), own)
    return entry(b"DEVC", b"\0", 1, len(content), content)


def mp4(path, packets, *, offsets=None, **options):
    """A video whose only track has the packets, each in a chunk of its own."""
    start = box(b"ftyp", b"mp41", b"\0\0\0\0")
    track = _track(packets, offsets or _places(packets, len(start) + 8), **options)
    path.write_bytes(start + box(b"mdat", *packets) + box(b"moov", box(b"mvhd", b"\0" * 20), track))
    return path


def add_track(path, packets):
    """Add a track with the packets to a video whose last box is moov."""
    data = path.read_bytes()
    place = data.rindex(b"moov") - 4
    track = _track(packets, _places(packets, place + 8))
    path.write_bytes(data[:place] + box(b"mdat", *packets) + box(b"moov", data[place + 8 :], track))


def _places(packets, place):
    return [place + sum(map(len, packets[:number])) for number in range(len(packets))]


def _track(packets, places, *, duration=300, kind=b"gpmd"):
    number = len(packets)
    table = box(
        b"stbl",
        box(b"stsd", struct.pack(">II", 0, 1), struct.pack(">I4s", 16, kind), b"\0" * 8),
        box(b"stts", struct.pack(">IIII", 0, 1, number, duration)),
        box(b"stsc", struct.pack(">IIIII", 0, 1, 1, 1, 1)),
        box(b"stsz", struct.pack(">III", 0, 0, number), *(struct.pack(">I", len(data)) for data in packets)),
        box(b"stco", struct.pack(">II", 0, number), *(struct.pack(">I", at) for at in places)),
    )
    header = box(b"mdhd", struct.pack(">IIIII", 0, 0, 0, 1000, 0), b"\0" * 4)
    return box(b"trak", box(b"mdia", header, box(b"minf", table)))


def packets_of(**options):
    """Packets of 20 samples of the rates, at 200 Hz, with options of ``packet`` or functions of the packet's number."""
    parts = []
    for number, at in enumerate(range(0, len(RATES), 20)):
        given = {name: value(number) if callable(value) else value for name, value in options.items()}
        parts.append(packet(RATES[at : at + 20], total=at + 20, **given))
    return parts
