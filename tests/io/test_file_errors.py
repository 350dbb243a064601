"""Files that cannot be read or written: a one-line message, and no incomplete output."""

import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile
import torch
from refusals import refuses

from rsvib_torch.files.atomic import whole
from rsvib_torch.io import read_stack, read_stack_info, write_stack

FRAMES = torch.rand(3, 9, 7, generator=torch.Generator().manual_seed(1))


COUNTS = (FRAMES.numpy() * 4095).astype("uint16")


def write_pages(path):
    with tifffile.TiffWriter(path, bigtiff=True) as tif:
        for frame in COUNTS:
            tif.write(frame, metadata=None)


WRITERS = {  # the file, and how many of its last bytes are not needed
    "ours.tif": (lambda path: write_stack(path, FRAMES, dtype="uint16", full_scale=4095), 16),  # the resolution
    "pages.tif": (write_pages, 0),
    "packed.tif": (
        lambda path: tifffile.imwrite(path, COUNTS, photometric="minisblack", compression="zlib", metadata=None),
        0,
    ),
    "a.png": (lambda path: write_stack(path, FRAMES[:1], dtype="uint8"), 0),
    "a.npy": (lambda path: np.save(path, COUNTS), 0),
}


@pytest.mark.parametrize("name", WRITERS)
def test_files_that_are_truncated_anywhere_are_refused(tmp_path, name):
    write, more = WRITERS[name]
    write(tmp_path / name)
    data = (tmp_path / name).read_bytes()
    for length in range(len(data) - more):
        (tmp_path / name).write_bytes(data[:length])
        with pytest.raises(ValueError, match=rf"{name}: (not a readable|truncated|frame \d cannot be)") as caught:
            read_stack(tmp_path / name, full_scale=4095)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("shape", "dtype", "options", "message"),
    [
        ((9, 7), "uint8", {"photometric": "miniswhite"}, "MINISWHITE"),
        ((9, 8), "bool", {}, "pixels are bool"),
        ((2, 5, 9, 7), "uint8", {"metadata": {"axes": "TZYX"}}, "an axis of frames"),
    ],
)
def test_tiff_files_that_are_not_stacks_are_refused(tmp_path, shape, dtype, options, message):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros(shape, dtype), **{"photometric": "minisblack"} | options)
    refuses(lambda: read_stack(tmp_path / "a.tif"), message)


def test_png_damage_is_refused(tmp_path):
    write_stack(tmp_path / "good.png", FRAMES[:1], dtype="uint8")
    data = (tmp_path / "good.png").read_bytes()
    path = tmp_path / "bad.png"
    for place in range(8, len(data) - 4, 5):  # behind the pixels is the checksum of the end
        path.write_bytes(data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :])
        refuses(lambda: read_stack(path), r"bad\.png")
    extra = b"sRGB\x09"  # behind the header: no rendering intent, which does not concern the pixels
    chunk = struct.pack(">I", 1) + extra + struct.pack(">I", zlib.crc32(extra))
    path.write_bytes(data[:33] + chunk + data[33:])
    assert torch.equal(read_stack(path), read_stack(tmp_path / "good.png"))


def test_png_folders_that_are_not_stacks_are_refused(tmp_path):
    refuses(lambda: read_stack(tmp_path), "contains no PNG, TIFF or JPEG files")
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 5), np.uint8))
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((4, 6), np.uint8))
    refuses(lambda: read_stack(tmp_path), r"a.png is \(4, 5\) uint8 .*, b.png is \(4, 6\) uint8")


def test_npy_damage_is_refused(tmp_path):
    path = tmp_path / "frames.npy"
    np.save(path, np.zeros((3, 9, 7), np.uint8))
    data = path.read_bytes()
    path.write_bytes(data.replace(b"(3, 9, 7)", b"(3, 9" + b"9" * 3 + b")"))
    refuses(lambda: read_stack_info(path), "truncated: the header states")
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    refuses(lambda: read_stack(path), "pixels are object")
    np.save(path, np.asfortranarray(np.arange(189, dtype=np.uint8).reshape(3, 9, 7)))
    refuses(lambda: read_stack(path), r"store numpy\.ascontiguousarray")
    for shape, message in (
        ((5,), "expected"),
        ((2, 9, 7, 3), r"channels last; store \(T, C, H, W\)"),
        ((0, 9, 7), "expected"),
    ):
        np.save(path, np.zeros(shape, np.uint8))
        refuses(lambda: read_stack(path), message)


def test_png_folder_with_other_frames_is_not_written(tmp_path):
    write_stack(tmp_path / "frames", FRAMES, dtype="uint8")
    write_stack(tmp_path / "frames", 1 - FRAMES, dtype="uint8")  # the same names again
    torch.testing.assert_close(read_stack(tmp_path / "frames"), 1 - FRAMES, atol=0.002, rtol=0)
    with pytest.raises(ValueError, match=r"contains other PNG files, e\.g\. frame_0002\.png"):
        write_stack(tmp_path / "frames", FRAMES[:2], dtype="uint8")
    assert len(list((tmp_path / "frames").iterdir())) == 3


def test_failure_while_writing_leaves_the_old_file_and_nothing_else(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(ZeroDivisionError), whole(tmp_path / "a.txt") as part:
        part.write_text("half" * (1 // part.write_text("")))
    with pytest.raises(ZeroDivisionError), whole(tmp_path / "new" / "deep", "folder") as folder:
        (folder / "b.txt").write_text("half" * (1 // (folder / "a.txt").write_text("")))
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"
    (tmp_path / "taken" / "z.txt").mkdir(parents=True)
    with (
        pytest.raises(IsADirectoryError, match=r"z\.txt: it is a folder"),
        whole(tmp_path / "taken", "folder") as folder,
    ):
        (folder / "b.txt").write_text((folder / "z.txt").write_text("half") * "x")
    assert [p.name for p in (tmp_path / "taken").iterdir()] == ["z.txt"]
    with whole(tmp_path / "new" / "deep", "folder") as folder:
        (folder / "b.txt").write_text("whole")
    assert (tmp_path / "new" / "deep" / "b.txt").read_text() == "whole"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "new", "taken"]


def test_temporary_folders_of_killed_processes_are_removed_unless_in_use(tmp_path):
    abandoned = tmp_path / ".a[1].txt.k2_w9xyz.part"
    abandoned.mkdir()
    (abandoned / "a[1].txt").write_text("half")
    others = [tmp_path / name for name in (".b.txt.k2_w9xyz.part", ".a[1].txt.part", "a[1].txt.k2_w9xyz.part", "far")]
    for folder in others:
        folder.mkdir()
    (tmp_path / ".a[1].txt.linked00.part").symlink_to(tmp_path / "far", target_is_directory=True)
    with whole(tmp_path / "a[1].txt") as first:
        assert not abandoned.exists()
        with whole(tmp_path / "a[1].txt") as second:
            first.write_text("first")
            second.write_text("second")
        assert (tmp_path / "a[1].txt").read_text() == "second"
    assert (tmp_path / "a[1].txt").read_text() == "first"
    remaining = {"a[1].txt", ".a[1].txt.linked00.part", *(folder.name for folder in others)}
    assert {path.name for path in tmp_path.iterdir()} == remaining


def test_file_systems_without_locks_are_written_to(tmp_path, monkeypatch):
    def refuse(file, operation):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("fcntl.flock", refuse)
    kept = tmp_path / ".a.txt.k2_w9xyz.part"  # could be in use
    kept.mkdir()
    with whole(tmp_path / "a.txt") as part:
        part.write_text("whole")
    assert {path.name for path in tmp_path.iterdir()} == {"a.txt", kept.name}


def test_paths_that_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.tif").mkdir()
    for path, message in {
        tmp_path / "none" / "a.tif": "none does not exist",
        tmp_path / "file" / "a.tif": "file does not exist",
        tmp_path / "folder.tif": "it is a folder",
        tmp_path / "file": "a file of that name exists",
    }.items():
        with pytest.raises(OSError, match=message):
            write_stack(path, FRAMES, dtype="uint8")

    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    for path in (tmp_path / "a.tif", tmp_path / "folder"):
        with pytest.raises(OSError, match=r"cannot write .* is not writable \(Permission denied\)"):
            write_stack(path, FRAMES, dtype="uint8")


def test_permissions_of_a_replaced_file_are_kept(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    path.chmod(0o640)
    with whole(path) as part:
        part.write_text("new")
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("new", 0o640)


def counts_in(folder, **options):
    np.save(folder / "frames.npy", np.full((2, 4, 4), 4096, np.uint16))
    return read_stack(folder / "frames.npy", **options)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (counts_in, ValueError, "full scale of uint16 frames unknown: pass full_scale"),
        (lambda at: counts_in(at, full_scale=4095), ValueError, "counts reach 4096, beyond full_scale=4095"),
        (lambda at: counts_in(at, full_scale=70000), ValueError, r"70000 exceeds the largest uint16 value"),
        (lambda at: write_stack(at / "a.tif", FRAMES, dtype="uint16"), ValueError, r"a\.tif: full scale of uint16"),
        (lambda at: write_stack(at / "a", FRAMES, dtype="uint8", full_scale=300), ValueError, "exceeds the largest"),
        (
            lambda at: write_stack(at / "a.xyz", FRAMES),
            ValueError,
            r"unknown file ending '\.xyz'; expected \.npy, \.h5, \.hdf5, \.hdf, \.png, \.tif, \.tiff, \.mkv, \.mp4, "
            r"\.mov, \.m4v or a name without an ending for a folder",
        ),
        (lambda at: write_stack(at / "a.png", FRAMES, dtype="uint8"), ValueError, "a PNG file holds one frame, got 3"),
        (lambda at: write_stack(at / "a.png", FRAMES[:1]), ValueError, "png files hold uint8, uint16; got"),
        (lambda at: write_stack(at / "a", FRAMES.new_zeros(3, 5, 9, 7), dtype="uint8"), ValueError, "1, 3 or 4 chan"),
        (lambda at: write_stack(at / "a.tif", FRAMES / 0, dtype="uint8"), ValueError, "NaN or infinite pixels"),
        (lambda at: write_stack(at / "none" / "a.tif", FRAMES), OSError, "none does not exist"),
    ],
)
def test_what_cannot_be_read_or_written_is_refused(tmp_path, call, error, message):
    refuses(lambda: call(tmp_path), message, error)
    assert {path.name for path in tmp_path.iterdir()} <= {"frames.npy"}
