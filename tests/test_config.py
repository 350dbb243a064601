"""Configuration files: the examples are valid, and every error is one line."""

from pathlib import Path

import pytest
from refusals import refuses

from rsvib_torch.config import read_config
from rsvib_torch.motion.timing import SensorTiming

CONFIGS = Path(__file__).parents[1] / "configs"
SENSOR = "[sensor]\nrow_time = 2e-5\nexposure_rows = 20\nframe_rows = 512\n"


def read(tmp_path, text):
    (tmp_path / "camera.toml").write_text(text)
    return read_config(tmp_path / "camera.toml")


def test_the_timing_of_a_file_has_the_errors_of_its_sensor(tmp_path):
    path = tmp_path / "camera.toml"
    for text in (SENSOR, SENSOR + "[detection]\ntones = 2\n"):
        path.write_text(text)
        assert SensorTiming.from_file(path) == read_config(path).timing
    for text in (
        "",
        "sensor = 3\n",
        SENSOR.replace("frame_rows", "rows"),
        SENSOR.replace("row_time = ", "row_time = -"),
        "[",
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"camera\.toml") as of_timing:
            SensorTiming.from_file(str(path))
        with pytest.raises(ValueError, match=r"camera\.toml") as of_config:
            read_config(path)
        assert str(of_timing.value) == str(of_config.value)


@pytest.mark.parametrize("name", ["iso12233", "in_orbit", "push_scan"])
def test_shipped_configs_have_the_camera_of_the_paper(name):
    config = read_config(CONFIGS / f"{name}.toml")
    assert config.timing == SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


def test_only_the_sensor_is_required_and_missing_options_are_not_filled_in(tmp_path):
    config = read(tmp_path, SENSOR)
    assert config.timing == SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
    assert (config.full_scale, config.detection, config.restoration) == (None, {}, {})
    config = read(tmp_path, SENSOR + 'scan_axis = "x"\nreadout_direction = "reverse"\nframe_start_times = [0.0, 0.5]\n')
    assert (config.timing.scan_axis, config.timing.readout_direction) == (-1, "reverse")
    assert config.timing.frame_start_times == (0.0, 0.5)
    text = "[detection]\ntones = 2\n[restoration]\nmethod = 'banded'\nhalf_rows = 8\nnoise_to_signal = 1e-3\n"
    config = read(tmp_path, SENSOR + text)
    assert config.detection == {"tones": 2}
    assert config.restoration == {"method": "banded", "half_rows": 8, "noise_to_signal": 1e-3}


def test_exposure_and_frame_period_in_seconds(tmp_path):
    expected = SensorTiming(row_time=2e-5, exposure_rows=25, frame_rows=2000)
    text = "[sensor]\nrow_time = 2e-5\nexposure_time = 0.5e-3\nframe_rate = 25\n"
    timing = read(tmp_path, text).timing
    assert (timing.exposure_rows, timing.frame_rows) == pytest.approx((25, 2000), rel=1e-12)
    assert read(tmp_path, text + "exposure_rows = 25\nframe_rows = 2000.3\n").timing.frame_rows == 2000.3  # they agree
    assert read(tmp_path, text.replace("exposure_time = 0.5e-3", "exposure_rows = 25")).timing == expected


def test_keys_that_replace_those_of_the_file(tmp_path):
    (tmp_path / "camera.toml").write_text(SENSOR + "full_scale = 4095\n[detection]\ntones = 2\n")
    config = read_config(tmp_path / "camera.toml", sensor={"frame_rate": 40.0, "scan_axis": "x"})
    assert config.timing == SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=1250, scan_axis="x")
    assert (config.full_scale, config.detection, config.source) == (4095, {"tones": 2}, str(tmp_path / "camera.toml"))
    alone = read_config(None, sensor={"row_time": 2e-5, "exposure_rows": 20.0, "frame_rows": 512.0})
    assert alone.timing == read(tmp_path, SENSOR).timing
    assert alone.source == "the command line"
    with pytest.raises(ValueError, match="the command line: sensor: exposure_time or exposure_rows is missing"):
        read_config(None, sensor={"row_time": 2e-5, "frame_rate": 30.0})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SENSOR.replace("2e-5", "'fast'"), "sensor.row_time must be a number, got 'fast'"),
        (SENSOR.replace("20", "0"), "sensor.exposure_rows must be larger than 0, got 0"),
        (SENSOR.replace("2e-5", "0.02"), "sensor: row_time=0.02 s is longer than 10 ms; row_time is in seconds"),
        (SENSOR.replace("frame_rows = 512", ""), "sensor: frame_rate or frame_rows is missing"),
        (SENSOR + "frame_rate = 50", "sensor: frame_rate=50 contradicts frame_rows=512: with this row_time it is"),
        (SENSOR + "exposure_time = 1e-3", "sensor: exposure_time=0.001 contradicts exposure_rows=20: with this"),
        (SENSOR.replace("frame_rows = 512", "frame_rate = 0.04"), "sensor: frame_rate=0.04 is less than 0.1; it is in"),
        ("", "sensor is missing; expected a table with row_time, exposure_time"),
        (SENSOR + "rows = 5", "unknown option 'sensor.rows'; the options are row_time, exposure_time, exposure_rows,"),
        (SENSOR + "scan_axis = 'z'", "sensor.scan_axis must be 'y' or 'x', got 'z'"),
        (SENSOR + "frame_start_times = [0, 'a']", "sensor.frame_start_times[1] must be a number, got 'a'"),
        (SENSOR + "[detection]\nband_rows = 32.5", "detection.band_rows must be a whole number, got 32.5"),
        (SENSOR + "[detection]\ntones = 'few'", "detection.tones must be"),
        (SENSOR + "[restoration]\nmethod = 'magic'", "restoration.method must be '"),
        (SENSOR + "[restoration]\nmethod = 'banded'\nhalf_row = 1", "unknown option 'restoration.half_row'; "),
        (SENSOR + "[stack]\nwindow = 1", "stack.window must be at least 2, got 1"),
        ("[sensor", "not a TOML file: Expected ']'"),
    ],
)
def test_errors_are_one_line(tmp_path, text, message):
    with pytest.raises(ValueError) as caught:
        read(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'camera.toml'}: {message}")
    assert "\n" not in str(caught.value)


def test_files_that_are_not_configurations(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_config(tmp_path / "none.toml")
    (tmp_path / "image.toml").write_bytes(b"\x89PNG\xff\xfe")
    refuses(lambda: read_config(tmp_path / "image.toml"), r"image\.toml: not a TOML file")
