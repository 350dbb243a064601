"""Metadata of TIFF files: copied to TIFF files, and listed where they cannot be."""

import json

import numpy as np
import pytest
import tifffile
import torch
from small_stack import FRAMES, draw_counts, process_small
from test_tiff_pages import write_pages

from rsvib_torch.io import metadata_not_kept, read_stack, read_stack_info, write_stack
from rsvib_torch.stacks import read_manifest

GREY = np.random.default_rng(8).integers(0, 4096, (5, 40, 30)).astype(np.uint16)
COLOUR = np.random.default_rng(9).integers(0, 256, (5, 40, 30, 3)).astype(np.uint8)
GREY.flat[0] = 4095
GEOREFERENCE = {
    "ModelPixelScaleTag": (33550, "d", 3, (0.5, 0.25, 0.0)),
    "ModelTiepointTag": (33922, "d", 6, (0.0, 0.0, 0.0, 440720.0, 3751320.0, 0.0)),
    "ModelTransformationTag": (34264, "d", 16, tuple(float(i) / 7 for i in range(16))),
    "GeoKeyDirectoryTag": (34735, "H", 16, (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32611)),
    "GeoDoubleParamsTag": (34736, "d", 2, (298.25, 6378137.0)),
    "GeoAsciiParamsTag": (34737, "s", 0, "WGS 84 / UTM zone 11N|WGS 84|"),
    "RPCCoefficientTag": (50844, "d", 92, tuple(float(i) / 3 for i in range(92))),
}
OTHERS = {
    "GDAL_METADATA": (42112, "s", 0, '<GDALMetadata>\n  <Item name="GAIN">2.5</Item>\n</GDALMetadata>'),
    "GDAL_NODATA": (42113, "s", 0, "-9999"),
    "InterColorProfile": (34675, 7, None, b"a profile \0\1\2"),
    "DateTime": (306, "s", 0, "2024:05:01 10:00:00"),
    "Artist": (315, "s", 0, "Zo\u00eb".encode()),
    "Model": (272, "s", 0, "camera 7"),
    "65001": (65001, "d", 1, 0.25),
}


RESOLUTION = ("XResolution", "YResolution", "ResolutionUnit")


def tags_of(entries, *, first_page=False):
    return [(*entry, first_page) for entry in entries.values()]


def copied(folder, *, output="out.tif", change=lambda frames: frames):
    """Write the frames of in.tif like the input, and return what is not kept."""
    info = read_stack_info(folder / "in.tif")
    scale = info.full_scale or (4095 if info.is_integer else None)
    frames = change(read_stack(folder / "in.tif", full_scale=scale))
    options = {"dtype": info.dtype, "full_scale": scale, "like": info}
    write_stack(folder / output, frames, **options)
    assert torch.equal(read_stack(folder / output, full_scale=scale), frames)
    again = read_stack_info(folder / output)
    assert output.endswith("npy") or again.full_scale == scale
    if output.endswith("tif"):  # a copy of the copy is the same
        assert again.metadata == {name: tag for name, tag in again.metadata.items() if tag is not None}
        write_stack(folder / f"again_{output}", frames, **{**options, "like": again})
        assert read_stack_info(folder / f"again_{output}").metadata == again.metadata
    return metadata_not_kept(info, folder / output, tuple(frames.shape))


def values(path, page=0):
    with tifffile.TiffFile(path) as tif:
        return {tag.code: tag.value for tag in tif.pages.get(page).tags}


@pytest.mark.parametrize(
    ("file_options", "first_page"),
    [({}, True), ({"byteorder": ">", "bigtiff": True}, False), ({"compression": "zlib"}, False)],
)
def test_georeference_and_other_tags_are_kept(tmp_path, file_options, first_page):
    entries = GEOREFERENCE | OTHERS
    tags = tags_of(entries, first_page=first_page)
    options = {"photometric": "minisblack", "metadata": None, "resolution": (300, 200, "INCH")}
    tifffile.imwrite(tmp_path / "in.tif", GREY, extratags=tags, **options, **file_options)
    assert copied(tmp_path) == ()
    for page in (0, 3):
        given, found = values(tmp_path / "in.tif", page), values(tmp_path / "out.tif", page)
        for code, *_ in entries.values():
            assert found.get(code) == given.get(code)
            assert (code in found) == (page == 0 or not first_page)
    assert (found[282], found[283], found[296]) == ((300, 1), (200, 1), 2)


@pytest.mark.parametrize(
    ("dtype", "text", "value"),
    [
        ("uint16", "-9999", None),  # cannot be stored
        ("uint16", "65535", 65535.0),
        ("float32", "-9999", -9999.0),
        ("float32", "nan", None),
        ("float32", "none", None),
    ],
)
def test_nodata_pixels_are_missing(tmp_path, dtype, text, value):
    stored = (GREY % 4000 + 50).astype(dtype)
    stored[:, 3:9, 20:] = 4090 if value is None else value
    tags = [(42113, "s", 0, text, False)]
    tifffile.imwrite(tmp_path / "in.tif", stored, photometric="minisblack", metadata=None, extratags=tags)
    info = read_stack_info(tmp_path / "in.tif")
    assert info.nodata == value
    scale = None if dtype == "float32" else 4095
    frames = read_stack(tmp_path / "in.tif", full_scale=scale)
    missing = np.zeros(stored.shape, bool)
    missing[:, 3:9, 20:] = value is not None
    assert (torch.isnan(frames).numpy() == missing).all()
    write_stack(tmp_path / "out.tif", frames, dtype=dtype, full_scale=scale, like=info)
    assert (tifffile.imread(tmp_path / "out.tif") == stored).all()


def test_tags_of_pages_written_one_by_one(tmp_path):
    def options(number):
        own = {"65001": (65001, "I", 1, number), "40000": (40000, "I", 1, 9)}
        return {
            "extratags": tags_of(GEOREFERENCE | own),
            "datetime": f"2024:01:01 00:00:0{number}",
            "description": f"frame {number}",
            "metadata": {"temperature": number},
        }

    write_pages(tmp_path / "in.tif", GREY, options)
    lost = {
        "DateTime (differs between pages)",
        "tag 65001 (differs between pages)",
        "ImageDescription (differs between pages)",
        "JSON metadata",
        "XPos",
    }
    assert set(copied(tmp_path)) == lost
    given, found = values(tmp_path / "in.tif"), values(tmp_path / "out.tif", 4)
    assert all(found[code] == given[code] for code, *_ in GEOREFERENCE.values())
    stated = {"description": "orbit 7", "contiguous": False}
    write_pages(tmp_path / "in.tif", GREY, lambda i: stated)
    assert copied(tmp_path) == ()
    with tifffile.TiffFile(tmp_path / "out.tif") as tif:
        assert tif.pages.first.description == "orbit 7"


def test_descriptions_are_kept(tmp_path):
    metadata = {"axes": "TYX", "full_scale": 4095, "frame_times": [0.0, 1.0, 2.0, 3.0, 4.5], "camera": "K1"}
    text = "orbit 7, \u00b5m"
    options = {"photometric": "minisblack", "description": text.encode(), "metadata": metadata}
    tifffile.imwrite(tmp_path / "in.tif", GREY, **options)
    assert copied(tmp_path) == ("JSON metadata",)
    metadata.pop("camera")
    with tifffile.TiffFile(tmp_path / "out.tif") as tif:
        assert tif.pages.first.description == text
        assert json.loads(tif.pages.first.description1) == {"shape": [5, 40, 30], **metadata}
    assert read_stack_info(tmp_path / "out.tif").frame_times == (0.0, 1.0, 2.0, 3.0, 4.5)
    assert copied(tmp_path, change=lambda frames: frames[:2]) == ("JSON metadata", "frame times")


@pytest.mark.parametrize("options", [{"imagej": True}, {"ome": True}])
def test_descriptions_of_the_arrangement_are_listed_and_the_resolution_is_kept(tmp_path, options):
    metadata = {"axes": "TYX", "unit": "um", "Labels": [f"frame {i}" for i in range(5)]}
    arguments = {"photometric": "minisblack", "resolution": (1 / 2.5, 1 / 5), "metadata": metadata}
    tifffile.imwrite(tmp_path / "in.tif", GREY, **options, **arguments)
    assert copied(tmp_path) == ("ImageDescription",)
    given, found = values(tmp_path / "in.tif"), values(tmp_path / "out.tif")
    assert all(given[code] == found[code] for code in (282, 283, 296))
    assert set(copied(tmp_path, output="out.npy")) == {"ImageDescription", *RESOLUTION}


def test_other_formats_and_sizes_lose_metadata(tmp_path):
    options = {"photometric": "minisblack", "resolution": (300, 200, "INCH"), "metadata": {"full_scale": 4095}}
    entries = {name: entry for name, entry in (GEOREFERENCE | OTHERS).items() if name != "65001"}
    tags = [*tags_of(entries), (274, "H", 1, 6, False)]
    tifffile.imwrite(tmp_path / "in.tif", GREY, extratags=tags, **options)
    assert set(copied(tmp_path, output="out.npy")) == {*entries, *RESOLUTION, "full scale", "orientation"}
    assert set(copied(tmp_path, output="out.h5")) == {*entries, *RESOLUTION}
    assert set(copied(tmp_path, output="folder")) == {*entries, *RESOLUTION}
    assert set(copied(tmp_path, change=lambda frames: frames[:, :32])) == {*GEOREFERENCE, *RESOLUTION}
    assert copied(tmp_path, change=lambda frames: frames[:2]) == ()


@pytest.mark.parametrize("layout", [{"tile": (16, 32), "compression": "zlib", "predictor": 2}, {}])
def test_a_folder_of_tiff_files_becomes_one_with_the_same_names_and_tags(tmp_path, layout):
    (tmp_path / "in").mkdir()
    for index, frame in enumerate(draw_counts()):
        moved = {"ModelTiepointTag": (33922, "d", 6, (0.0, 0.0, 0.0, 440720.0 + index, 3751320.0, 0.0))}
        date = {"DateTime": (306, "s", 0, f"2024:01:01 00:00:{index:02d}")}
        name, tags = f"S2_{index + 8}_B4.TIF", tags_of(GEOREFERENCE | moved | date)
        tifffile.imwrite(tmp_path / "in" / name, frame, extratags=tags, metadata=None, **layout)
    report = process_small(tmp_path / "in", tmp_path / "out")
    assert (report.not_kept, report.restored) == ((), report.windows)
    info = read_stack_info(f"{tmp_path / 'in'}[2:4]")
    write_stack(
        tmp_path / "part",
        read_stack(f"{tmp_path / 'in'}[2:4]", full_scale=4095),
        dtype="uint16",
        full_scale=4095,
        like=info,
    )
    assert sorted(path.name for path in (tmp_path / "part").iterdir()) == ["S2_10_B4.TIF", "S2_11_B4.TIF"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {path.name for path in (tmp_path / "in").iterdir()}
    for path in [*(tmp_path / "out").iterdir(), *(tmp_path / "part").iterdir()]:
        with tifffile.TiffFile(tmp_path / "in" / path.name) as before, tifffile.TiffFile(path) as after:
            taken, kept = before.pages.first, after.pages.first
            assert kept.dtype == taken.dtype
            for code in (306, *(entry[0] for entry in GEOREFERENCE.values())):
                assert kept.tags[code].value == taken.tags[code].value
    assert not np.array_equal(
        tifffile.imread(tmp_path / "out" / "S2_9_B4.TIF"), tifffile.imread(tmp_path / "in" / "S2_9_B4.TIF")
    )
    lost = metadata_not_kept(read_stack_info(tmp_path / "in"), tmp_path / "big", (FRAMES, 192, 128))
    assert "ModelTiepointTag (differs between files)" in lost


def test_thumbnails_and_other_images_are_listed(tmp_path):
    with tifffile.TiffWriter(tmp_path / "in.tif") as tif:
        for frame in GREY:
            tif.write(frame, metadata=None, subifds=1)
            tif.write(frame[::2, ::2], subfiletype=1, metadata=None)
        tif.write(GREY[0, ::4, ::4], subfiletype=1, metadata=None)
    assert copied(tmp_path) == ("SubIFDs", "thumbnails and masks")


def test_runs_keep_metadata_and_list_what_is_lost(tmp_path):
    source = tmp_path / "in.tif"
    tifffile.imwrite(source, draw_counts(), photometric="minisblack", imagej=False, extratags=tags_of(GEOREFERENCE))
    report = process_small(source, tmp_path / "out.tif")
    assert (report.not_kept, report.frames) == ((), FRAMES)
    found = values(tmp_path / "out.tif", FRAMES - 1)
    assert all(found[code] == value for code, _, _, value in GEOREFERENCE.values())
    report = process_small(source, tmp_path / "out.npy")
    assert report.not_kept == tuple(GEOREFERENCE)
    assert read_manifest(report.manifest).not_kept == tuple(GEOREFERENCE)
    again = process_small(source, tmp_path / "out.npy", resume=True)
    assert (again.not_kept, again.resumed) == (report.not_kept, report.windows)
