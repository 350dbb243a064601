"""Angular rates from gyroflow logs, GPMF tracks and CSV files, written here byte by byte."""

import math

import numpy as np
import pytest
from gpmf_file import RATES, TIMES, box, mp4, packets_of
from refusals import refuses

import rsvib_torch as rsv
from rsvib_torch.gyroscope import read_camera_track


def gcsv(path, *, orientation="XYZ", columns="t,gx,gy,gz,ax,ay,az", rows=None):
    """A gyroflow log with times in ms and rates in units of 0.5 mrad/s."""
    raw = np.round(RATES / 5e-4).astype(int)
    rows = [f"{5 * i},{x},{y},{z},0,0,1" for i, (x, y, z) in enumerate(raw)] if rows is None else rows
    start = ["GYROFLOW IMU LOG", "version,1.3", "id,test", f"orientation,{orientation}"]
    path.write_text("\n".join([*start, "tscale,0.001", "gscale,0.0005", columns, *rows]) + "\n")
    return path


def test_gyroflow_log(tmp_path):
    found = rsv.read_gyroscope(gcsv(tmp_path / "clip.gcsv"))
    assert np.allclose(found.times.numpy(), TIMES, atol=1e-12)
    assert np.allclose(found.rates.numpy(), RATES, atol=1e-12)
    assert "gyroflow" in found.source
    assert "200 Hz" in found.summary()


def test_orientation_of_a_gyroflow_log(tmp_path):
    found = rsv.read_gyroscope(gcsv(tmp_path / "clip.gcsv", orientation="YxZ")).rates.numpy()
    assert np.allclose(found, np.stack([RATES[:, 1], -RATES[:, 0], RATES[:, 2]], -1), atol=1e-12)


@pytest.mark.parametrize(
    ("names", "factor"),
    [
        ("time_s,x_rad_s,y_rad_s,z_rad_s", 1.0),
        ("t (s),gx (deg/s),gy (deg/s),gz (deg/s)", 180 / math.pi),
        ("Timestamp, gyro_x dps, gyro_y dps, gyro_z dps", 180 / math.pi),
    ],
)
def test_csv(tmp_path, names, factor):
    path = tmp_path / "clip.csv"
    np.savetxt(path, np.column_stack([TIMES, RATES * factor]), "%.10g", ",", header=names, comments="")
    found = rsv.read_gyroscope(path)
    assert np.allclose(found.times.numpy(), TIMES, atol=1e-9)
    assert np.allclose(found.rates.numpy(), RATES, atol=1e-8)


def test_gopro_video(tmp_path):
    found = rsv.read_gyroscope(mp4(tmp_path / "clip.MP4", packets_of(), duration=100))
    assert np.allclose(found.times.numpy(), TIMES, atol=1e-9)  # packets of 20 samples in 0.1 s
    assert np.allclose(found.rates.numpy(), RATES, atol=1e-9)
    turned = rsv.read_gyroscope(mp4(tmp_path / "turned.mp4", packets_of(orientation=b"zXy"), duration=100)).rates
    assert np.allclose(turned.numpy(), np.stack([-RATES[:, 2], RATES[:, 0], -RATES[:, 1]], -1), atol=1e-9)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: gcsv(path, rows=["0,1,2,3", "5,x,2,3"]), "line 9: gx must be a number, got 'x'"),
        (lambda path: gcsv(path, orientation="XXZ"), "orientation must have x, y and z once each"),
        (lambda path: path.write_text("time,gx,gy,gz\n" + "0,0,0,0\n" * 5), "states no unit of the rates"),
        (lambda path: path.write_text("time,gx,rate_x,gy,gz\n"), "2 columns of the rate about x"),
        (lambda path: path.write_text("time,x_dps,y_dps,z_dps\n" + "7" * 200_000), "field larger than field limit"),
        (
            lambda path: path.write_text("t,x_dps,y_dps,z_dps\n" + "1,0,0,0\n" * 5),
            "times must increase, but sample 2 at 1 s",
        ),
        (lambda path: mp4(path, [b"\0\0\0\1"] * 3, kind=b"tmcd"), "a video without a GPMF track"),
        (lambda path: mp4(path, packets_of(), offsets=[2**31] * 3), "a video without a GPMF track"),
        (lambda path: mp4(path, [packets_of()[0][:-40]] * 3), "damaged MP4 file: a GPMF entry"),
        (lambda path: path.write_bytes(box(b"ftyp", b"mp41") + b"\xff\xff\xff\xffmdat"), "damaged MP4 file"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, write, message):
    path = tmp_path / "clip.dat"
    write(path)
    with pytest.raises(ValueError, match=r"clip\.dat") as caught:
        rsv.read_gyroscope(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("columns", "row", "message"),
    [
        ("time,x,y,z", "{0},1,0,1,0,2,0,3", r"line 2: 8 values in 4 columns; write decimal points, not commas"),
        ("time,x,y,z,x", "{0},1,2,3,4", "column 'x' occurs twice|2 columns of the rate about x"),
    ],
)
def test_decimal_commas_and_repeated_columns_are_refused(tmp_path, columns, row, message):
    """Motions were read from the wrong cells: decimal commas shift them, and the last of two columns counted."""
    rows = [row.format(number) for number in range(8)]
    (tmp_path / "a.csv").write_text("\n".join([columns, *rows]))
    message = f"a.{{}}.*({message})"
    refuses(lambda: rsv.read_motion(tmp_path / "a.csv", unit="px"), message.format("csv"))
    refuses(lambda: rsv.read_gyroscope(tmp_path / "a.csv"), message.format("csv"))
    log = gcsv(
        tmp_path / "a.gcsv", columns=columns.replace("time", "t").replace("x", "gx").replace("y,z", "gy,gz"), rows=rows
    )
    refuses(lambda: rsv.read_gyroscope(log), message.format("gcsv").replace("line 2", "line 8").replace("'x'", "'gx'"))


@pytest.mark.parametrize(("turned", "stated"), [((1.0, 0.0, 0.0, 0.0), False), ((0.9998, 0.0, 0.02, 0.0), True)])
def test_images_that_the_camera_has_stabilised_are_stated(tmp_path, turned, stated):
    found = rsv.read_gyroscope(mp4(tmp_path / "clip.mp4", packets_of(turned=[turned] * 3)))
    assert ("IORI" in found.source) == stated
    assert np.allclose(found.rates.numpy(), RATES, atol=1e-9)


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_rotations_of_images_that_are_no_numbers_do_not_hide_the_others(tmp_path, order):
    turned = [(0.9998, 0.0, 0.02, 0.0), (np.nan, np.nan, np.nan, np.nan)][order]
    track = read_camera_track(mp4(tmp_path / "clip.mp4", packets_of(turned=turned)))
    assert track.turned == pytest.approx(0.04, rel=1e-2)
    assert track.stabilised


def test_exposures_and_rotations_of_the_images_in_a_track(tmp_path):
    exposures = [[0.002] * 9, [0.002] * 5 + [0.004] * 4, [0.004] * 9]
    turned = [[0.9998, 0.0, 0.02, 0.0], [1.0, 0.0, 0.0, 0.0]]
    path = mp4(tmp_path / "clip.mp4", packets_of(exposures=lambda number: exposures[number], turned=turned))
    track = read_camera_track(path)
    assert len(track.exposures) == 27
    assert track.exposures_at(np.array([0.1, 0.3 + 0.1, 0.3 + 0.2, 0.8])) == pytest.approx([0.002, 0.002, 0.004, 0.004])
    assert track.turned == pytest.approx(0.04, rel=1e-2)
    assert track.stabilised
    plain = read_camera_track(mp4(tmp_path / "plain.mp4", packets_of()))
    assert len(plain.exposures) == 0
    assert not plain.stabilised
    assert read_camera_track(mp4(tmp_path / "other.mp4", packets_of(), kind=b"text")) is None
    assert read_camera_track(tmp_path / "missing.tif") is None
    damaged = mp4(tmp_path / "damaged.mp4", [packets_of()[0][:-40]] * 3)
    with pytest.warns(UserWarning, match=r"damaged\.mp4: the GPMF track is damaged and is not used: a GPMF entry"):
        assert read_camera_track(damaged) is None
