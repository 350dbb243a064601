"""TIFF files that were written page by page: one stack, or a message that names the page that differs."""

import numpy as np
import pytest
import tifffile
from refusals import refuses

from rsvib_torch.io import open_stack

GREY = np.random.default_rng(8).integers(0, 4096, (10, 40, 30)).astype(np.uint16)
COLOUR = np.random.default_rng(9).integers(0, 256, (4, 40, 30, 3)).astype(np.uint8)

# Options of each page by its number. tifffile treats pages whose options differ as several series; of files with more
# than seven pages without metadata it compares only some.
GREY_PAGES = {
    "default": lambda i: {},
    "no metadata": lambda i: {"metadata": None},
    "own metadata": lambda i: {"metadata": {"exposure": i, "axes": "YX"}},
    "description": lambda i: {"description": f"frame {i}"},
    "some descriptions": lambda i: {"description": f"frame {i}"} if i % 2 else {},
    "zlib": lambda i: {"compression": "zlib"},
    "zlib, description": lambda i: {"compression": "zlib", "description": "x", "predictor": True},
    "some zlib": lambda i: {"compression": "zlib" if i % 2 else None},
    "some zlib, no metadata": lambda i: {"compression": (None, "zlib", "lzma")[i % 3], "metadata": None},
    "page 2 zlib, no metadata": lambda i: {"compression": "zlib" if i == 2 else None, "metadata": None},
    "resolution": lambda i: {"resolution": (100 + i, 100), "contiguous": False},
    "tags": lambda i: {"extratags": [(65000, "I", 1, i, True)], "contiguous": False},
    "multipage": lambda i: {"subfiletype": 2, "metadata": None, "datetime": True},
}


def write_pages(path, pages, options=lambda i: {}, **file_options):
    with tifffile.TiffWriter(path, **file_options) as tif:
        for number, page in enumerate(pages):
            tif.write(page, **options(number))


def check_frames(path, expected):
    """Compare the frames of a file, read in any order; returns what is known of the stack."""
    reader = open_stack(path)
    assert (reader.info.shape, reader.info.dtype) == (expected.shape, expected.dtype.name)
    for index in (len(expected) - 1, *range(len(expected))):
        np.testing.assert_array_equal(reader.frame(index), expected[index])
    reader.close()
    return reader.info


@pytest.mark.parametrize(
    ("case", "file_options"),
    [*((case, {}) for case in GREY_PAGES), ("some zlib, no metadata", {"bigtiff": True, "byteorder": ">"})],
)
def test_grey_pages_are_one_stack(tmp_path, case, file_options):
    write_pages(tmp_path / "a.tif", GREY, GREY_PAGES[case], **file_options)
    check_frames(tmp_path / "a.tif", GREY)


@pytest.mark.parametrize("options", [{}, {"contiguous": False}, {"compression": "zlib", "description": "x"}])
def test_colour_pages_are_one_stack(tmp_path, options):
    expected = np.moveaxis(COLOUR, -1, 1)
    write_pages(tmp_path / "chunky.tif", COLOUR, lambda i: {"photometric": "rgb", **options})
    check_frames(tmp_path / "chunky.tif", expected)
    write_pages(
        tmp_path / "planar.tif", expected, lambda i: {"photometric": "rgb", "planarconfig": "separate", **options}
    )
    check_frames(tmp_path / "planar.tif", expected)


def test_pages_of_other_writers(tmp_path):
    for frame in GREY:
        tifffile.imwrite(tmp_path / "appended.tif", frame, append=True)
    check_frames(tmp_path / "appended.tif", GREY)
    write_pages(tmp_path / "images.ome.tif", GREY, ome=True)  # one OME image per page
    check_frames(tmp_path / "images.ome.tif", GREY)
    parts = (GREY[:2], GREY[2:5], GREY[5:])
    write_pages(tmp_path / "parts.tif", parts, lambda i: {"photometric": "minisblack", "contiguous": False})
    check_frames(tmp_path / "parts.tif", GREY)
    write_pages(tmp_path / "floats.tif", GREY[:, None].astype(np.float32), lambda i: {"compression": "lzma"})
    check_frames(tmp_path / "floats.tif", GREY.astype(np.float32))


def test_thumbnails_masks_and_pyramids_are_not_frames(tmp_path):
    small = GREY[:, ::4, ::4]
    thumbnail = {"subfiletype": 1, "metadata": None}
    write_pages(tmp_path / "last.tif", [*GREY, small[0]], lambda i: thumbnail if i == 10 else {"metadata": None})
    write_pages(tmp_path / "first.tif", [small[0], *GREY], lambda i: {"metadata": None} if i else thumbnail)
    pairs = [page for pair in zip(GREY, small, strict=True) for page in pair]
    write_pages(tmp_path / "pairs.tif", pairs, lambda i: thumbnail if i % 2 else {"metadata": None})
    write_pages(
        tmp_path / "mask.tif",
        [GREY[0], GREY[0] > 5, *GREY[1:]],
        lambda i: {"subfiletype": 4 if i == 1 else 0, "metadata": None},
    )
    write_pages(tmp_path / "pyramid.tif", pairs, lambda i: thumbnail if i % 2 else {"metadata": None, "subifds": 1})
    for name in ("last", "first", "pairs", "mask", "pyramid"):
        check_frames(tmp_path / f"{name}.tif", GREY)
    write_pages(tmp_path / "only.tif", GREY, lambda i: thumbnail)
    check_frames(tmp_path / "only.tif", GREY)


@pytest.mark.parametrize(("number", "metadata"), [(1, None), (3, {}), (9, None)])
@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda page: page[:32], {}, "32 x 30 px uint16"),
        (lambda page: page[:, :16], {}, "40 x 16 px uint16"),
        (lambda page: page.astype(np.uint8), {}, "40 x 30 px uint8"),
        (lambda page: page.astype(np.float32), {"compression": "zlib"}, "40 x 30 px float32"),
        (lambda page: page[..., None].repeat(3, -1), {"photometric": "rgb"}, "40 x 30 px, 3 channels, uint16"),
        (lambda page: page, {"photometric": "miniswhite"}, "40 x 30 px uint16 MINISWHITE"),
    ],
)
def test_message_names_the_page_that_differs(tmp_path, number, metadata, change, options, message):
    pages = [change(page) if index == number else page for index, page in enumerate(GREY)]
    path = tmp_path / "a.tif"
    write_pages(path, pages, lambda i: {"metadata": metadata, **(options if i == number else {})})
    expected = f"frames of different size or kind: page {number} is {message}, page 0 is 40 x 30 px uint16$"
    refuses(lambda: open_stack(path), expected)


def test_several_arrays_with_channels_are_refused(tmp_path):
    array = GREY[:6].reshape(2, 3, 40, 30)
    options = {"photometric": "minisblack", "contiguous": False}
    for metadata, name in ({"axes": "TCYX"}, "TCYX"), ({}, "unknown"):
        write_pages(tmp_path / "a.tif", [array, array], lambda i, m=metadata: {"metadata": m, **options})
        refuses(lambda: open_stack(tmp_path / "a.tif"), rf"several arrays, .* has shape .2, 3, 40, 30. .axes {name}")


def test_full_scale_of_the_first_page_and_no_frame_times_of_one_page(tmp_path):
    path = tmp_path / "a.tif"
    write_pages(path, GREY, lambda i: {"metadata": {"full_scale": 4095, "frame_times": [0.1]}, "contiguous": False})
    reader = open_stack(path)
    assert (reader.info.full_scale, reader.info.frame_times) == (4095.0, None)
    reader.close()
