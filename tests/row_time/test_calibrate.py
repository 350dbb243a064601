"""Row time from flickering light, in frames computed from the definition with NumPy."""

import math
import re

import numpy as np
import pytest
import torch
from program import rsvib
from refusals import refuses
from truth import draw_scene

from rsvib_torch.config import read_config
from rsvib_torch.io import write_stack
from rsvib_torch.row_time import calibrate_row_time

ROW_TIME = 14.578e-6
HEIGHT, WIDTH = 480, 160


def sine(time, frequency=1000.0, contrast=0.6):
    return 1 + contrast * np.sin(2 * np.pi * frequency * time + 0.7)


def blink(time, frequency=1000.0, fraction=0.5):
    return 2.0 * ((time * frequency) % 1.0 < fraction)


def record_frames(light, frames=1, frame_rate=29.97, exposure=65e-6, scene=0.3, **shot):
    """Frames (T, H, W) of light over time, a mean over the exposure of each row in small steps."""
    shot = {"row_time": ROW_TIME, "noise": 0.002, "seed": 0, "start": 0.0123, **shot}
    rows, steps = np.arange(HEIGHT), (np.arange(100) + 0.5) / 100
    begin = shot["start"] + np.arange(frames)[:, None] / frame_rate + rows * shot["row_time"]
    taken = light(begin[..., None] + exposure * steps).mean(-1)[..., None] * scene * np.ones((HEIGHT, WIDTH))
    noise, seed = shot["noise"], shot["seed"]
    noisy = taken + noise * np.random.default_rng(seed).standard_normal(taken.shape)
    return torch.from_numpy(np.clip(noisy, 0, 1)).float()


def shaded():
    """A uniform wall with vignetting and a light spot."""
    v, u = np.meshgrid(np.linspace(-1, 1, HEIGHT), np.linspace(-1, 1, WIDTH), indexing="ij")
    return 0.35 * (1 - 0.5 * (u**2 + v**2)) + 0.1 * np.exp(-((u - 0.4) ** 2 + (v + 0.3) ** 2) / 0.3)


@pytest.mark.parametrize("light", [sine, blink])
def test_row_time_of_one_frame_agrees_within_its_standard_deviation(light):
    found = calibrate_row_time(record_frames(light, scene=shaded()), 1000.0)
    assert found.row_time == pytest.approx(ROW_TIME, rel=5e-4)
    assert abs(found.row_time - ROW_TIME) < 4 * found.row_time_std
    assert found.row_time_std < 3e-3 * ROW_TIME
    assert found.period_rows == pytest.approx(1 / (1000 * ROW_TIME), rel=5e-4)
    assert found.readout_direction is None
    assert found.frame_rows is None


def test_standard_deviations_agree_with_scatter():
    ratios = []
    for seed in range(0, 12, 2):
        row_time = 1e-6 * (9 + 0.9 * seed)
        frames = record_frames(sine, row_time=row_time, noise=0.06, seed=seed)
        found = calibrate_row_time(frames, 1000.0)
        ratios.append((found.row_time - row_time) / found.row_time_std)
    spread = math.sqrt(np.mean(np.square(ratios)))
    assert 0.3 < spread < 1.6


def test_texture_is_removed_by_several_frames():
    """Flicker of 2 % in a textured scene: not detectable in one frame, accurate in four."""
    scene = 0.6 * draw_scene(HEIGHT, WIDTH, 3)
    frames = record_frames(lambda t: sine(t, 997.0, 0.02), frames=4, scene=scene)
    found = calibrate_row_time(frames, 997.0)
    assert found.row_time == pytest.approx(ROW_TIME, rel=2e-3)
    assert abs(found.row_time - ROW_TIME) < 4 * found.row_time_std
    refuses(lambda: calibrate_row_time(frames[:1], 997.0), "no flicker found")


def test_periodic_texture_is_not_detected_as_flicker():
    """A pattern with twice the period also fits the texture, but it does not move between frames."""
    frequency, row_time = 583.7, 19.47e-6  # the phase changes by a third of a period per frame; the period is 88 rows
    scene, shot = 0.6 * draw_scene(HEIGHT, WIDTH, 22), {"row_time": row_time, "noise": 0.003, "seed": 22}
    frames = record_frames(lambda t: sine(t, frequency, 0.1), 4, frequency / 19.472, scene=scene, **shot)
    found = calibrate_row_time(frames, frequency)
    assert found.row_time == pytest.approx(row_time, rel=2e-3)


def test_frame_rate_gives_the_frame_period():
    found = calibrate_row_time(record_frames(sine, frames=3, scene=shaded()), 1000.0, frame_rate=29.97)
    assert found.frame_rows == pytest.approx(1 / (29.97 * ROW_TIME), rel=5e-4)
    in_step = calibrate_row_time(record_frames(sine, frames=3, frame_rate=25.0), 1000.0, frame_rate=25.0)
    assert any("same rows in all frames" in note for note in in_step.notes)


def test_columns_as_scan_axis():
    frames = record_frames(sine, scene=shaded()).transpose(-2, -1)
    assert calibrate_row_time(frames, 1000.0, scan_axis="x").row_time == pytest.approx(ROW_TIME, rel=5e-4)
    refuses(lambda: calibrate_row_time(frames, 1000.0, scan_axis="z"), "scan_axis")
    refuses(lambda: calibrate_row_time(frames, 1000.0), "bands must follow each other along scan_axis")


@pytest.mark.parametrize("start", [0.0123, 0.01247, 0.01261])
def test_bands_of_several_frames_do_not_depend_on_the_phase_of_the_light(start):
    texture = 0.3 + 0.05 * draw_scene(HEIGHT, WIDTH, 5)
    frames = record_frames(blink, frames=4, scene=texture, exposure=200e-6, start=start)
    found = calibrate_row_time(frames, 1000.0, frame_rate=29.97)
    assert abs(found.row_time - ROW_TIME) < 3 * found.row_time_std < 3e-4 * ROW_TIME


def test_a_multiple_of_the_period_is_not_the_period():
    """Texture beside the bands looks like a fundamental of three periods: the row time was a third."""
    row_time, frequency, scene = 21.65252404e-6, 572.6430877, 0.5 * draw_scene(HEIGHT, WIDTH, 481)
    options = {"row_time": row_time, "start": 0.900165, "noise": 0.003, "seed": 500564}
    found = calibrate_row_time(record_frames(lambda t: sine(t, frequency, 0.5), scene=scene, **options), frequency)
    assert abs(found.row_time - row_time) < 3 * found.row_time_std
    assert found.row_time == pytest.approx(row_time, rel=0.01)


@pytest.mark.parametrize(("seed", "count"), [(0, 1), (1, 2)])
def test_frames_without_flicker_are_refused(seed, count):
    frames = record_frames(np.ones_like, frames=count, scene=0.8 * draw_scene(HEIGHT, WIDTH, seed), noise=0.01)
    refuses(lambda: calibrate_row_time(frames, 100.0), "no flicker found")


def test_slanted_stripes_are_not_flicker():
    rows, columns = np.meshgrid(np.arange(HEIGHT), np.arange(WIDTH), indexing="ij")
    stripes = 0.5 + 0.3 * np.sin(2 * np.pi * (rows + 0.5 * columns) / 40)
    refuses(lambda: calibrate_row_time(torch.from_numpy(stripes)[None], 1000.0), "no flicker found")


def test_flicker_too_fast_or_too_slow_for_the_rows():
    fast = record_frames(lambda t: sine(t, 9 / (10 * ROW_TIME)), frames=1, exposure=1e-6)
    refuses(lambda: calibrate_row_time(fast, 9 / (10 * ROW_TIME), frame_rate=29.97), "is ambiguous: row times of")
    finest = record_frames(lambda t: sine(t, 1 / (3 * ROW_TIME)), frames=1, exposure=1e-6)
    refuses(lambda: calibrate_row_time(finest, 1 / (3 * ROW_TIME)), r"repeat every 3\.00 rows")
    slow = record_frames(lambda t: sine(t, 100.0), frames=3, scene=shaded())  # 0.7 periods per frame
    refuses(lambda: calibrate_row_time(slow, 100.0), r"slower than a frame|no flicker found")
    refuses(lambda: calibrate_row_time(record_frames(sine, scene=shaded()), 100.0, frame_rate=29.97), "does not fit")


def test_command(tmp_path, capsys):
    write_stack(tmp_path / "led.tif", record_frames(blink, frames=3, scene=shaded()), dtype="uint8")
    options = ("--frequency", 1000, "--frame-rate", 29.97, "--exposure", "65us", "--out", tmp_path / "sensor.toml")
    assert rsvib("calibrate", tmp_path / "led.tif", *options) == 0
    printed = capsys.readouterr().out
    assert float(re.search(r"row time ([\d.]+)", printed).group(1)) == pytest.approx(1e6 * ROW_TIME, rel=5e-4)
    timing = read_config(tmp_path / "sensor.toml").timing
    assert timing.row_time == pytest.approx(ROW_TIME, rel=5e-4)
    assert timing.exposure_time == pytest.approx(65e-6)
    assert timing.readout_direction == "forward"
    assert timing.frame_rate == pytest.approx(29.97, rel=1e-6)
