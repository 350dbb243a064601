"""Files that were crafted to exhaust memory or time: each is opened in a child process with limits for both."""

import io
import os
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import av
import h5py
import numpy as np
from attacks.files import write_tiff
from attacks.trial import Trial
from attacks.warm import in_warm_child
from PIL import Image
from small_stack import TIMING

import rsvib_torch as rsv
from rsvib_torch.config import read_config
from rsvib_torch.report.results import read_vibration
from rsvib_torch.stacks import read_manifest

_SECONDS, _BYTES = 20.0, 2 * 10**9  # limits of one file: processor time, and memory for data
_CAMERA = "[sensor]\nrow_time = 1e-4\nexposure_rows = 6\nframe_rows = 104\nfull_scale = 4095\n"
_DEEP = 20_000

# A case writes a file into a folder and returns its path. The reader follows from the ending: a stack, a configuration,
# a recorded motion, a vibration or a manifest.
Case = Callable[[Path], Path]
CASES: dict[str, Case] = {}
_FILES = {"npy": "a.npy", "PNG": "a.png", "JPEG": "a.jpg", "TIFF": "a.tif"}


def _data(name: str, data: str | bytes, folder: Path) -> Path:
    path = folder / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def _case_of(name: str, data: bytes) -> None:
    """Add a case whose name begins with the format of its data."""
    CASES[name] = partial(_data, _FILES[name.partition(":")[0]], data)


def _sparse(name: str, head: bytes, size: int, folder: Path) -> Path:
    """A file of a large size of which only the beginning is on the disk."""
    path = _data(name, head, folder)
    os.truncate(path, size)
    return path


def _special(name: str, target: str, folder: Path) -> Path:
    """A pipe, or a link to a target, which takes the place of what has this name."""
    path = folder / name
    if path.exists():
        path.rename(folder / "moved")
    if target:
        path.symlink_to(target)
    else:
        os.mkfifo(path)
    return path


# --- .npy ---------------------------------------------------------------------------------------------------------


def _npy(shape: str, dtype: str = "'<u2'", order: str = "False", held: int = 1000) -> bytes:
    text = f"{{'descr': {dtype}, 'fortran_order': {order}, 'shape': {shape}, }}"
    header = text.encode() + b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(held)


_SHAPES = ("(1000000000000, 64, 64)", f"({2**63 - 1}, 2, 2)", "(2, 0, 4)", "(-5, 8, 8)", f"({'9' * 400}, 8, 8)")
for _order, _shape in product(("False", "True"), (*_SHAPES, f"({'2, ' * 60})", "(True, 8, 8)")):
    _case_of(f"npy: shape {_shape[:30]}, Fortran order {_order}", _npy(_shape, order=_order))
for _dtype in ("'O'", "'<U1000000000'", "('<f4', (100000, 100000))", "'|S0'"):
    _case_of(f"npy: type {_dtype}", _npy("(2, 64, 64)", _dtype))
_case_of("npy: nested header", _npy("(" * 5000 + ")" * 5000))
_case_of("npy: header of 4 GB", b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1) + b"{")
CASES["npy: sparse file of 64 GB"] = partial(_sparse, "a.npy", _npy("(8, 65536, 65536)"), 2**36 + 1000)
CASES["npy: 10^8 frames of one pixel"] = partial(_sparse, "a.npy", _npy("(100000000, 1, 1)"), 2 * 10**8 + 1000)

# --- PNG and JPEG -------------------------------------------------------------------------------------------------

_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def _chunk(kind: bytes, body: bytes, length: int | None = None) -> bytes:
    size = len(body) if length is None else length
    return struct.pack(">I", size) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _png(width: int, height: int, bits: int = 8, colour: int = 0, pixels: int = 10**4, more: bytes = b"") -> bytes:
    head = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(min(10**7, pixels - done))) for done in range(0, pixels, 10**7))
    return _SIGNATURE + head + more + _chunk(b"IDAT", packed + packer.flush()) + _chunk(b"IEND", b"")


for _width, _height in ((2**31 - 1, 2**31 - 1), (1, 2**31 - 1), (10**6, 10**6), (0, 0)):
    for _bits, _colour in ((8, 0), (16, 6)):
        _named = f"PNG: {_width} x {_height} px, {_bits} bits, colour type {_colour}"
        _case_of(_named, _png(_width, _height, _bits, _colour))
# Pillow searches a file of any size for its header, at 20 MB/s
CASES["PNG: sparse file of 6 GB"] = partial(_sparse, "a.png", _SIGNATURE, 6 << 30)
CASES["PNG: sparse text of 6 GB"] = partial(_sparse, "a.png", _SIGNATURE + b"\x40\0\0\0tEXt", 6 << 30)
CASES["JPEG: sparse file of 6 GB"] = partial(_sparse, "a.jpg", b"\xff\xd8\xff\xe0", 6 << 30)
CASES["PNG: 30000 x 30000 px in 1 MB"] = lambda folder: _data("a.png", _png(30000, 30000, pixels=30001 * 30000), folder)


def _png_folder(folder: Path) -> Path:
    (folder / "frames").mkdir()
    bomb = _png(12000, 12000, pixels=12001 * 12000)
    for index in range(200):
        _data(f"frames/{index}.png", bomb, folder)
    return folder / "frames"


CASES["PNG: folder of 200 bombs"] = _png_folder
_case_of(
    "PNG: text that expands to 1 GB",
    _png(16, 16, more=_chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(10**7), 9) * 100)),
)
_case_of("PNG: chunk of 4 GB", _png(16, 16, more=_chunk(b"tEXt", b"a", 2**32 - 1)))
_case_of(
    "PNG: Exif that refers to itself",
    _png(16, 16, more=_chunk(b"eXIf", b"MM\0*\0\0\0\x08" + struct.pack(">HHHII", 1, 0x8769, 4, 1, 8) + bytes(4))),
)


def _jpeg(width: int, height: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("L", (16, 16)).save(buffer, "JPEG")
    data = buffer.getvalue()
    start = data.index(b"\xff\xc0") + 5
    return data[:start] + struct.pack(">HH", height, width) + data[start + 4 :]


for _size in ((65500, 65500), (0, 0)):
    _case_of(f"JPEG: {_size[0]} x {_size[1]} px", _jpeg(*_size))

# --- TIFF ---------------------------------------------------------------------------------------------------------


def _page(more: dict[int, tuple[int, int, int]], following: int) -> bytes:
    """The directory of a page of 16 x 16 px, with other or additional tags (type, count, value or offset)."""
    tags = {256: (4, 1, 16), 257: (4, 1, 16), 258: (3, 1, 16), 259: (3, 1, 1), 262: (3, 1, 1), 273: (4, 1, 512)}
    tags |= {277: (3, 1, 1), 278: (4, 1, 16), 279: (4, 1, 512)} | more
    entries = sorted((code, *values) for code, values in tags.items() if values[1])
    table = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return struct.pack("<H", len(entries)) + table + struct.pack("<I", following)


def _pages(start: int, pages: Iterable[dict[int, tuple[int, int, int]]]) -> bytes:
    """Directories that follow each other from an offset."""
    parts: list[bytes] = []
    for more in pages:
        start += len(_page(more, 0))
        parts.append(_page(more, start))
    return b"".join(parts)[:-4] + bytes(4)


def _tiff(more: dict[int, tuple[int, int, int]], following: int = 0, tail: bytes = bytes(4096)) -> bytes:
    """One page of 16 x 16 px, with other or additional tags (type, count, value or offset)."""
    return b"II*\0" + struct.pack("<I", 8) + _page(more, following) + tail


for _code, _name in (
    *((256, "width"), (257, "length"), (258, "bits"), (259, "compression"), (277, "samples"), (278, "rows per strip")),
    *((322, "tile width"), (32997, "depth")),
):
    for _value in (0, 2**32 - 1):
        _case_of(f"TIFF: {_name} {_value}", _tiff({_code: (4, 1, _value)}))
for _code, _name in (
    *((273, "strip offsets"), (279, "strip sizes"), (270, "description"), (330, "SubIFDs"), (34735, "GeoKeys")),
):
    for _kind, _count in ((3, 2**31 - 1), (12, 2**29)):
        _case_of(f"TIFF: {_name}, type {_kind}, {_count} values", _tiff({_code: (_kind, _count, 64)}))
_case_of("TIFF: the next page is the same", _tiff({}, 8))
_case_of("TIFF: SubIFD is the page itself", _tiff({330: (4, 1, 8)}))
_case_of("TIFF: the next page lies beyond the end", _tiff({}, 2**32 - 2))
_case_of(
    "TIFF: strips of one byte",
    _tiff({257: (4, 1, 10**6), 278: (4, 1, 1), 273: (4, 10**6, 512), 279: (4, 10**6, 512)}, 0, bytes(5 * 10**6)),
)
_case_of(
    "TIFF: 60000 x 60000 px in tiles of 16",
    _tiff({256: (4, 1, 60000), 257: (4, 1, 60000), 322: (3, 1, 16), 323: (3, 1, 16), 273: (4, 0, 0)}),
)


def _described(text: str) -> bytes:
    """A page with a description."""
    return _tiff({270: (2, len(text) + 1, 600)}, tail=bytes(474) + text.encode() + bytes(4096))


for _words in ('{"shape": [1000000000, 16, 16]}', "[" * _DEEP, "ImageJ=1.53\nimages=1000000000\nframes=1000000000\n"):
    _case_of(f"TIFF: description {_words[:30]}", _described(_words))


_ENTITIES = "".join(f'<!ENTITY e{i + 1} "{f"&e{i};" * 10}">' for i in range(9))
_case_of(
    "TIFF: OME-XML with entities",
    _described(
        f'<?xml version="1.0"?><!DOCTYPE OME [<!ENTITY e0 "a">{_ENTITIES}]>'
        "<OME><Image><Pixels>&e9;</Pixels></Image></OME>"
    ),
)
CASES["TIFF: OME-XML with 10^9 planes"] = partial(
    _data,
    "a.ome.tif",
    _described(
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">'
        '<Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint16" SizeX="16" SizeY="16" SizeZ="1" SizeC="1" '
        'SizeT="1000000000"><TiffData/></Pixels></Image></OME>'
    ),
)


def _tiff_pages(folder: Path, count: int, alternating: bool = False) -> Path:
    """Pages that share their pixels; every second one can have another size and be marked as a thumbnail."""
    pages = (
        {273: (4, 1, 8)} | ({254: (4, 1, 1), 256: (4, 1, n)} if alternating and n % 2 else {}) for n in range(count)
    )
    return _data("a.tif", b"II*\0" + struct.pack("<I", 520) + bytes(512) + _pages(520, pages), folder)


CASES["TIFF: 30000 pages"] = partial(_tiff_pages, count=30_000)
CASES["TIFF: 20000 pages and thumbnails of different sizes"] = partial(_tiff_pages, count=20_000, alternating=True)


def _tiff_bomb(folder: Path) -> Path:
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(9 * 10**6)) for _ in range(100)) + packer.flush()
    page = {256: (4, 1, 30000), 257: (4, 1, 30000), 258: (3, 1, 8), 259: (3, 1, 8), 278: (4, 1, 30000)}
    pages = _pages(8, 4 * [page | {279: (4, 1, len(packed))}])  # of the same strip
    return _data("a.tif", (b"II*\0" + struct.pack("<I", 8) + pages).ljust(512, b"\0") + packed, folder)


def _tiff_yxt(folder: Path) -> Path:
    write_tiff(folder / "a.tif", np.zeros((3000, 2000, 200), np.uint16), metadata={"axes": "YXT"}, compression="zlib")
    return folder / "a.tif"


CASES |= {"TIFF: 1 MB that expands to 3.6 GB": _tiff_bomb, "TIFF: axes YXT, zlib, expands to 2.4 GB": _tiff_yxt}

# --- HDF5 ---------------------------------------------------------------------------------------------------------


def _hdf5(folder: Path, write: Callable[[h5py.File], None]) -> Path:
    path = folder / "a.h5"
    with h5py.File(path, "w") as file:
        write(file)
    return path


def _zeros(file: h5py.File, shape: tuple[int, ...], **options: object) -> h5py.Dataset:
    return file.create_dataset("frames", shape=shape, dtype="u2", **options)


def _filled(file: h5py.File) -> None:
    _zeros(file, (8, 64, 64), chunks=(1, 1, 1))[:4] = 1


def _virtual(file: h5py.File, source: str) -> None:
    layout = h5py.VirtualLayout(shape=(4, 16, 16), dtype="u2")
    layout[:] = h5py.VirtualSource(source, "frames", shape=(4, 16, 16))
    file.create_virtual_dataset("frames", layout)


def _times(file: h5py.File) -> None:
    _zeros(file, (4, 16, 16))[:] = 0
    file.create_dataset("timestamps", shape=(2**40,), dtype="f8", chunks=(1024,))


for _name, _write in {
    "25 groups linked to the root": lambda file: file.update({f"link{n}": file["/"] for n in range(25)}),
    "2000 groups in each other": lambda file: file.create_group("/".join("a" * 2000)),
    "20000 groups": lambda file: list(map(file.create_group, map(str, range(20_000)))),
    "no pixels stored, 2^60 bytes": partial(_zeros, shape=(2**25, 2**17, 2**17)),
    "chunk of 4 GB": partial(_zeros, shape=(100, 4000, 4000), chunks=(100, 4000, 4000), compression="gzip"),
    "chunks of 1 x 1 x 1": _filled,
    "virtual dataset of a device": partial(_virtual, source="/dev/urandom"),
    "virtual dataset of itself": partial(_virtual, source="a.h5"),
    "2^40 times": _times,
    "external file /dev/urandom": partial(
        _zeros, shape=(4, 16, 16), external=[("/dev/urandom", 0, h5py.h5f.UNLIMITED)]
    ),
    "external link": lambda file: file.__setitem__("frames", h5py.ExternalLink("/dev/urandom", "/a")),
    "soft link to itself": lambda file: file.__setitem__("frames", h5py.SoftLink("/frames")),
    "dataset of type object": lambda file: file.create_dataset("frames", data=["a"] * 4, dtype=h5py.string_dtype()),
    "attribute axes of 60 KB": lambda file: _zeros(file, (2, 8, 8)).attrs.update({"axes": "T" * 60_000}),
}.items():
    CASES[f"HDF5: {_name}"] = partial(_hdf5, write=_write)

# --- Video --------------------------------------------------------------------------------------------------------


def _video(name: str, size: tuple[int, int], count: int, folder: Path) -> Path:
    path = folder / name
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264" if name.endswith("mp4") else "ffv1", rate=30)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p" if name.endswith("mp4") else "gray"
        frame = av.VideoFrame(*size, format=stream.pix_fmt)
        for plane in frame.planes:
            plane.update(bytes(plane.buffer_size))
        for _ in range(count):
            output.mux(stream.encode(frame))
        output.mux(stream.encode())
    return path


CASES["video: 12000 x 12000 px"] = partial(_video, "a.mkv", (12000, 12000), 4)


def _video_large(folder: Path) -> Path:
    path = _video("a.mkv", (64, 64), 4, folder)
    data = path.read_bytes()
    data = data.replace(b"\xb0\x81\x40", b"\xb0\x82\xff\xff"[:3]).replace(b"\xba\x81\x40", b"\xba\x82\xff\xff"[:3])
    return _data("a.mkv", data, folder)


def _video_samples(folder: Path) -> Path:
    data = bytearray(_video("a.mp4", (64, 64), 8, folder).read_bytes())
    for box in (b"stsz", b"stts", b"stco", b"ctts"):
        place = data.find(box)
        if place > 0:
            data[place + 8 : place + 16] = b"\0\0\0\x01\xff\xff\xff\xff"
    return _data("a.mp4", bytes(data), folder)


def _video_frames(folder: Path) -> Path:
    data = bytearray(_video("a.avi", (64, 64), 4, folder).read_bytes())
    place = data.index(b"avih") + 8
    data[place + 16 : place + 20] = b"\xff\xff\xff\xff"
    return _data("a.avi", bytes(data), folder)


CASES["video: .mkv that states 65535 x 65535 px"] = _video_large
CASES["video: .mp4 that states 2^32 - 1 samples"] = _video_samples
CASES["video: .avi that states 2^32 - 1 frames"] = _video_frames
CASES["video: playlist"] = partial(_data, "a.mp4", "#EXTM3U\n/dev/urandom\n")
CASES["video: list of files"] = partial(_data, "a.mkv", "ffconcat version 1.0\nfile /dev/urandom\n")
CASES["video: zeros"] = partial(_sparse, "a.mp4", b"", 10**9)
CASES["video: zeros after a header of .ts"] = partial(_sparse, "a.mts", b"G" + bytes(187), 10**9)

# --- Pipes, devices, links ----------------------------------------------------------------------------------------


for _ending in (".tif", ".png", ".npy", ".h5", ".mp4", ".toml", ".csv", ".vibration.json"):
    for _name, _target in (("pipe", ""), ("device", "/dev/urandom")):
        CASES[f"{_name} {_ending}"] = partial(_special, f"a{_ending}", _target)


def _pipe_in_folder(folder: Path) -> Path:
    (folder / "frames").mkdir()
    _data("frames/a.png", _png(16, 16, pixels=17 * 16), folder)
    return _special("b.png", "", folder / "frames").parent


CASES["pipe in a folder of images"] = _pipe_in_folder

# --- Configuration, motion, vibration, manifest -------------------------------------------------------------------

for _name, _words in {
    "nested lists": "x = " + "[" * _DEEP + "]" * _DEEP,
    "nested tables": "x = " + "{a=" * _DEEP + "1" + "}" * _DEEP,
    "key of 20000 parts": "a" + ".a" * _DEEP + " = 1",
    "tables of 400 depths": "".join(f"[[{'.'.join(['a'] * n)}]]\n" for n in range(1, 400)),
    "10^5 unknown keys": "".join(f"a{n} = 1\n" for n in range(10**5)),
    "number of 10^6 digits": "x = " + "9" * 10**6,
    "exponent": _CAMERA.replace("1e-4", "1e-999999999"),
    "zero bytes": "\0" * 10**6,
}.items():
    CASES[f"TOML: {_name}"] = partial(_data, "a.toml", _words)
CASES["TOML: 64 GB"] = partial(_sparse, "a.toml", b"#", 2**36)
for _kind in ("vibration", "manifest"):
    for _name, _words in {
        "nested lists": "[" * _DEEP,
        "nested tables": '{"a":' * _DEEP + "1" + "}" * _DEEP,
        "long number": '{"version": ' + "9" * 10**6 + "}",
        "nested value": f'{{"format": "rsvib {_kind}", "version": 1, "vibration": ' + "[" * 900 + "]" * 900 + "}",
        "10^5 unknown keys": "{" + ",".join(f'"a{n}": 1' for n in range(10**5)) + "}",
        "10^6 tones": '{"format": "rsvib vibration", "version": 1, "vibration": {"amplitude": ['
        + ",".join(["[" + ",".join(["1.0"] * 10**5) + "]"] * 2)
        + "]}}",
    }.items():
        CASES[f"{_kind}: {_name}"] = partial(_data, f"a.{_kind}.json", _words)
for _name, _words in {
    "field of 10 MB": 'time,x,y\n"' + "1" * 10**7,
    "times of 10^300 s": "time,x,y\n" + "".join(f"{n}e300,0,0\n" for n in range(5)),
    "10^6 columns": "time,x,y" + ",a" * 10**6 + "\n0,0,0\n",
    "10^5 lines": "time,x,y\n" + "".join(f"{n / 1000},0,0\n" for n in range(10**5)),
    "open quotation": 'time,x,y\n"' + "\n" * 10**5,
}.items():
    CASES[f"CSV: {_name}"] = partial(_data, "a.csv", _words)


def attempt(folder: Path, path: Path) -> str:
    """Read a file as the commands do, and detect its vibration if it is a stack."""
    os.chdir(path.parent)
    name = path.name
    if name.endswith(".toml"):
        read_config(path)
    elif name.endswith(".csv"):
        rsv.read_motion(path, unit="px")
    elif name.endswith(".vibration.json"):
        read_vibration(path, TIMING)
    elif name.endswith(".manifest.json"):
        read_manifest(path).detections()
    else:
        frames = rsv.read_stack(path, full_scale=None if name.endswith(("png", "jpg", "mp4", "avi")) else 65535)
        rsv.detect_vibration(frames[:3, ..., :256, :256], TIMING, method="bands", tones=1)
    return ""


def crafted(names: Sequence[str], folder: Path) -> Iterator[Trial]:
    """Write files one by one, and read them in a child process with limits of memory and processor time."""

    def items() -> Iterator[tuple[str, Path]]:
        for index, name in enumerate(names):
            place = folder / f"{index}"
            place.mkdir()
            yield name, CASES[name](place)

    yield from in_warm_child(attempt, items(), folder, limit=_SECONDS, memory=_BYTES)


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Read up to ``count`` crafted files; all of them are read if there are no more, otherwise a random choice."""
    order = np.random.default_rng(seed).permutation(len(CASES))
    names = list(CASES)
    yield from crafted(names if count >= len(names) else [names[index] for index in order[:count]], folder)
