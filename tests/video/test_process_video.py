"""Videos followed from frame to frame, from file to file, against the scene of an independent camera."""

import itertools
import json
from dataclasses import replace

import av
import numpy as np
import pytest
import torch
from gpmf_file import RATES, add_track, packet
from program import refused, rsvib
from refusals import refuses
from scipy.ndimage import shift as move
from small_video import shifts, sound_of, write_sharp
from truth import MARGIN, Curve, Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, read_manifest, read_stack, read_stack_info
from rsvib_torch.video import process_video

HEIGHT, WIDTH, COUNT, RATE = 168, 144, 40, 30.0
TIMING = SensorTiming(row_time=150e-6, exposure_rows=4, frame_rows=1 / RATE / 150e-6)
LONG = replace(TIMING, exposure_rows=20)
CAMERA = ("--row-time", "150us", "--exposure", "0.6ms", "--frame-rate", "30")
VIBRATION = Motion((2.1, 1.6), (52.0, 71.0), (0.5, 1.0))
TIMES = np.arange(COUNT) / RATE
PART = 32  # frames
OPTIONS = {"restoration": {"method": "dewarp"}, "workers": 2}


def shaken(amplitude=2.0, frequency=3.0, pan=12.0):  # px, Hz, px/s
    """Vibration on a slow pan with shaking along x."""

    def path(t):
        return amplitude * np.sin(2 * np.pi * frequency * t) + pan * t

    return Curve(lambda t: VIBRATION.displacement(t) + np.stack([path(t), 0 * t], -1))


def colours(size):
    """Red, green and blue scene (3, H, W): grey detail, and broad colours."""
    height, width = (side + 2 * MARGIN for side in size)
    grey, first, second = (draw_scene(height, width, seed, blur) for seed, blur in ((3, 0.8), (4, 4.0), (5, 4.0)))
    return np.stack([grey + 0.2 * (first - 0.5), grey, grey + 0.2 * (second - 0.5)]).clip(0.05, 0.95)


SCENE = colours((HEIGHT, WIDTH))
STILL = np.stack([crop(channel) for channel in SCENE])


def counts_of(motion, count=COUNT, scene=SCENE):
    taken = [take_frames(channel, TIMING, motion, count, 0.004, seed=3) for channel in scene]
    return np.clip(np.round(255 * np.stack(taken, -1)), 0, 255).astype(np.uint8)


def grey_counts_of(timing, motion, count):
    taken = take_frames(SCENE[0], timing, motion, count, 0.004, seed=3)
    return np.clip(np.round(255 * np.repeat(taken[..., None], 3, -1)), 0, 255).astype(np.uint8)


def write(path, frames, times=None, **options):
    return write_sharp(path, frames, np.arange(len(frames)) / RATE if times is None else times, **options)


@pytest.fixture(scope="module", name="frames")
def make_frames():
    return counts_of(VIBRATION)


@pytest.fixture(scope="module", name="clip")
def make_clip(frames, tmp_path_factory):
    return write(tmp_path_factory.mktemp("video") / "clip.mp4", frames, sound="aac")


@pytest.fixture(scope="module", name="blurred")
def make_blurred(tmp_path_factory):
    return write(tmp_path_factory.mktemp("video") / "blurred.mp4", grey_counts_of(LONG, VIBRATION, 20))


@pytest.fixture(scope="module", name="shaken_frames")
def make_shaken_frames():
    return counts_of(shaken())


@pytest.fixture(scope="module", name="shaky")
def make_shaky(shaken_frames, tmp_path_factory):
    return write(tmp_path_factory.mktemp("video") / "shaky.mp4", shaken_frames)


def pixels(path):
    return read_stack(path).double().numpy()


def gains(source, restored, still=STILL):
    """dB by which every restored frame is closer to the scene at rest than the frame as taken."""
    return np.array(
        [decibel(b, still, 16) - decibel(a, still, 16) for a, b in zip(pixels(source), restored, strict=True)]
    )


def test_every_frame_is_restored_with_times_and_sound(clip, tmp_path):
    report = process_video(clip, tmp_path / "still.mp4", TIMING, **OPTIONS | {"restoration": {"method": "exact"}})
    restored = pixels(tmp_path / "still.mp4")
    gain = gains(clip, restored)
    assert gain.min() > 6  # also of the first frames, which are given before the vibration is known
    assert np.abs(shifts(restored.mean(1))).max() < 0.05  # px, also at the border of two parts
    assert np.abs(gain[PART - 1] - gain[PART]) < 3  # dB
    assert (report.frames, report.windows, report.restored, report.bad_frames) == (COUNT, 2, 2, 0)
    manifest = read_manifest(report.manifest)
    for found in manifest.detections():
        assert found.vibration.frequency[:, 0].tolist() == pytest.approx([52.0, 71.0], abs=0.1)
    assert [record.outcome for record in manifest.windows] == ["helps", "helps"]
    assert read_stack_info(tmp_path / "still.mp4").frame_times == read_stack_info(clip).frame_times
    assert len(sound_of(clip)) > 3
    assert sound_of(tmp_path / "still.mp4") == sound_of(clip)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["still.mp4", "still.mp4.manifest.json"]


def test_a_part_that_restoration_makes_worse_is_left_as_it_is(frames, tmp_path):
    """The frames by which the second part is judged do not vibrate; the tones are those of all frames."""
    paused = frames.copy()
    noise = np.random.default_rng(1).normal(0, 3, paused[PART : PART + 8].shape)  # without it, they are copies
    paused[PART : PART + 8] = ((255 * STILL).transpose(1, 2, 0) + noise).round().clip(0, 255)
    clip = write(tmp_path / "clip.mp4", paused)
    report = process_video(clip, tmp_path / "still.mp4", TIMING, **OPTIONS)
    windows = read_manifest(report.manifest).windows
    assert [(one.outcome, one.frames) for one in windows] == [("helps", "restored"), ("worse", "as taken")]
    raw, restored = pixels(clip), pixels(tmp_path / "still.mp4")
    assert gains(clip, restored)[: PART - 4].min() > 6
    assert np.abs(restored - raw)[PART:].mean() < 0.01  # of two compressions


def test_colours_are_kept_as_stored(frames, tmp_path):
    """H.264 gets 8 of 10 bits."""
    clip = write(tmp_path / "clip.mp4", frames[:16], encoded="yuv420p10le")
    process_video(clip, tmp_path / "still.mp4", TIMING, **OPTIONS)
    means, tags = [], []
    for path, scale in ((clip, 4), (tmp_path / "still.mp4", 1)):
        with av.open(str(path)) as video:
            frame = next(video.decode(video=0))
            planes = frame.to_ndarray() / scale
            means.append([planes[:HEIGHT].mean(), *planes[HEIGHT:].reshape(2, -1).mean(1)])
            tags.append((frame.colorspace, frame.color_range))
    assert frame.format.name == "yuv420p"
    assert tags[0] == tags[1]
    assert means[0] == pytest.approx(means[1], abs=1.0)  # other content at the border
    assert gains(clip, pixels(tmp_path / "still.mp4")).min() > 6


def test_tones_of_a_wrong_row_time_are_not_reliable(clip, tmp_path):
    timing = SensorTiming(row_time=0.73 * 150e-6, exposure_rows=4 / 0.73, frame_rows=1 / RATE / (0.73 * 150e-6))
    report = process_video(f"{clip}[0:20]", tmp_path / "still.mp4", timing, **OPTIONS)
    for found in read_manifest(report.manifest).detections():
        right = (found.vibration.frequency[:, 0] - torch.tensor([52.0, 71.0])).abs() < 0.2
        assert not (found.reliable & ~right).any()


class _StoppedError(KeyboardInterrupt):
    """Ctrl-C at a chosen frame."""


STEADY = {"border": "crop", "steady": 0.2, **OPTIONS}


@pytest.fixture(scope="module", name="whole")
def process_without_interruption(clip, tmp_path_factory):
    whole = tmp_path_factory.mktemp("video") / "whole.mp4"
    process_video(clip, whole, TIMING, **STEADY)
    return whole


@pytest.mark.parametrize("damage", [None, "damaged part"])
def test_an_interrupted_run_is_resumed(clip, whole, tmp_path, damage):
    def stop(done, total):
        assert total == COUNT
        if done == PART + 4:
            raise _StoppedError

    sink = tmp_path / "again.mp4"
    with pytest.raises(_StoppedError):
        process_video(clip, sink, TIMING, progress=stop, **STEADY)
    assert not sink.exists()
    with pytest.raises(FileExistsError, match="interrupted here after 1 windows; resume it"):
        process_video(clip, sink, TIMING, **STEADY)
    with pytest.raises(ValueError, match=r"cannot resume: settings\.video\.steady was 0\.2, now it is 0\.3"):
        process_video(clip, sink, TIMING, resume=True, **STEADY | {"steady": 0.3})
    if damage is not None:
        part = tmp_path / ".again.mp4.rsvib" / "000000.mp4"
        part.write_bytes(part.read_bytes()[:-100])
    report = process_video(clip, sink, TIMING, resume=True, **STEADY)
    assert report.resumed == (1 if damage is None else 0)
    assert np.array_equal(pixels(sink), pixels(whole))
    shaking = read_manifest(f"{whole}.manifest.json").shaking
    assert read_manifest(report.manifest).shaking == shaking
    assert shaking["frame_to_frame"][1] < 0.2 * shaking["frame_to_frame"][0]
    assert process_video(clip, sink, TIMING, resume=True, **STEADY).resumed == 2  # it is complete
    assert not (tmp_path / ".again.mp4.rsvib").exists()


def test_tones_of_a_video_have_the_standard_deviation_of_the_row_time(clip, tmp_path):
    row_time = 1.01 * 150e-6
    timing = SensorTiming(row_time, 4 / 1.01, 1 / RATE / row_time, row_time_std=0.01 * row_time)
    report = process_video(clip, tmp_path / "still.mp4", timing, **OPTIONS)
    found = read_manifest(report.manifest).detections()[0]
    for name in ("amplitude", "phase"):
        error = getattr(found.vibration, name)[:, 0] - torch.tensor(getattr(VIBRATION, name))
        assert bool((error.abs() < 2 * getattr(found.std, name)[:, 0]).all())


def test_constant_frames_repeat_the_frame_before_and_the_first_one_the_frame_behind(frames, tmp_path):
    changed = frames[:20].copy()
    changed[[0, 12]] = 128
    source = write(tmp_path / "clip.mkv", changed, codec="ffv1", options={}, encoded="bgr0")
    report = process_video(source, tmp_path / "still.mkv", TIMING, **OPTIONS)
    restored = pixels(tmp_path / "still.mkv")
    assert np.array_equal(restored[12], restored[11])
    assert np.array_equal(restored[0], restored[1])
    assert report.bad_frames == 2
    assert decibel(restored[12], STILL, 16) > 30
    assert decibel(restored[13], STILL, 16) > 30


def test_frames_that_were_repeated_do_not_have_the_times_of_the_file(frames, tmp_path):
    """24 frames per second, stored as 30; the encoder changes the copies."""
    source = write(tmp_path / "clip.mp4", frames[np.arange(40) * 24 // 30], options={"crf": "20", "threads": "1"})
    assert sum(np.array_equal(*pair) for pair in itertools.pairwise(pixels(source))) < 4
    report = process_video(source, tmp_path / "still.mp4", TIMING, **OPTIONS)
    assert report.bad_frames == 0
    for found in read_manifest(report.manifest).detections():
        assert [[one.code for one in of_axis][-1] for of_axis in found.findings] == ["frames_repeated"] * 2


def test_tones_of_a_video_whose_frames_are_missing_without_a_gap_in_its_times_are_not_reliable(frames, tmp_path):
    """Tones of 0.1 to 0.2 px beside the right ones were reliable."""
    kept = np.delete(np.arange(COUNT), [12, 21, 22, 30])
    source = write(tmp_path / "clip.mp4", frames[kept])
    report = process_video(source, tmp_path / "still.mp4", TIMING, **OPTIONS)
    found = read_manifest(report.manifest).detections()
    assert not any(bool(one.reliable.any()) for one in found)
    assert "tone_changes" in {reason.code for one in found for of_axis in one.findings for reason in of_axis}


def test_tones_whose_phase_jumps_at_missing_frames_are_not_reliable(tmp_path):
    """With every seventh frame missing, 93 and 121 Hz were stated as 93.44 and 121.16 Hz, without other changes."""
    kept = [number for number in range(46) if number % 7 != 3]
    frames = grey_counts_of(TIMING, Motion((1.2, 0.8), (93.0, 121.0), (0.5, 1.0)), 46)[kept]
    report = process_video(write(tmp_path / "clip.mp4", frames), tmp_path / "still.mp4", TIMING, **OPTIONS)
    for found in read_manifest(report.manifest).detections():
        assert [of_axis[0].code for of_axis in found.findings] == ["tone_changes"] * 2


@pytest.mark.parametrize("stated", [0.3, 1.0])
def test_a_stated_exposure_that_is_too_short_for_the_blur_is_refused(blurred, tmp_path, stated):
    """An exposure of 3 ms, stated as 0.9 ms: amplitudes are 3 to 6 % too small, and nothing else shows it."""
    timing = replace(LONG, exposure_rows=stated * LONG.exposure_rows)
    report = process_video(blurred, tmp_path / "still.mp4", timing, **OPTIONS)
    (found,) = read_manifest(report.manifest).detections()
    codes = [[reason.code for reason in of_axis] for of_axis in found.findings]
    assert codes == ([["blur_contradicts_exposure"]] * 2 if stated < 1 else [[], []])
    if stated < 1:
        assert 1.8 < found.findings[0][0].details["likely_ms"] < 3.6


def test_copies_of_frames_are_moved_along_the_smooth_path(shaken_frames, tmp_path):
    source = write(tmp_path / "clip.mp4", shaken_frames[np.arange(40) * 24 // 30])
    process_video(source, tmp_path / "steady.mp4", TIMING, border="crop", steady=1 / 3, **OPTIONS)
    raw, steady = (shifts(pixels(path).mean(1))[5:-6, 0] for path in (source, tmp_path / "steady.mp4"))
    assert np.sort(np.abs(raw))[4] < 0.02  # copies
    assert np.abs(np.diff(steady)).max() < 0.3  # 0.8 with copies of restored frames


def test_dark_frames_behind_bright_ones_are_no_copies(shaken_frames, tmp_path):
    """They change by a tenth of what the bright ones changed by: all of them counted as copies of the first one."""
    dim = np.linspace(1.0, 0.1, 5).repeat((12, 1, 1, 1, COUNT - 15))[:, None, None]
    source = write(
        tmp_path / "clip.mp4", (shaken_frames * dim[..., None]).round().astype(np.uint8), options={"crf": "8"}
    )
    process_video(source, tmp_path / "steady.mp4", TIMING, border="crop", steady=1 / 3, **OPTIONS)
    raw, steady = (shifts(pixels(path).mean(1) / dim)[17:-4, 0] for path in (source, tmp_path / "steady.mp4"))
    assert np.abs(np.diff(raw)).max() > 2
    assert np.abs(np.diff(steady)).max() < 1  # px, of compression; 4.6 as copies


def test_columns_that_are_read_one_after_another(frames, tmp_path):
    turned = np.ascontiguousarray(frames[:16].transpose(0, 2, 1, 3))
    encoded = {"codec": "ffv1", "options": {}, "encoded": "bgr0"}
    source, sink = write(tmp_path / "clip.mkv", turned, **encoded), tmp_path / "still.mkv"
    timing = SensorTiming(TIMING.row_time, TIMING.exposure_rows, TIMING.frame_rows, scan_axis="x")
    process_video(source, sink, timing, **OPTIONS)
    assert gains(source, pixels(sink), STILL.transpose(0, 2, 1)).min() > 6


def test_rotation_and_missing_frames_are_kept(frames, tmp_path):
    kept = [index for index in range(24) if index not in (9, 15)]  # dropped by the camera
    path = write(tmp_path / "clip.mp4", frames[kept], TIMES[kept], rotation=-90)
    process_video(path, tmp_path / "still.mp4", TIMING, **OPTIONS)
    before, after = read_stack_info(path), read_stack_info(tmp_path / "still.mp4")
    assert before.orientation == after.orientation == 6
    assert before.frame_times == after.frame_times
    assert gains(path, pixels(tmp_path / "still.mp4")).min() > 6


def test_wrong_arguments_are_refused_before_anything_is_written(clip, tmp_path):
    cases = [
        ({"border": "zoom"}, "border must be 'mirror'"),
        ({"steady": -1.0}, "steady must be at least 0"),
        ({"restoration": {"joint": 3}}, "joint must be left out where frames are followed one by one"),
        ({"restoration": {"method": "exact", "half_rows": 3}}, "half_rows is no option of"),
        ({"border": "crop", "steady": 60.0, "memory": "1kB"}, "memory of"),
    ]
    for options, message in cases:
        with pytest.raises((ValueError, TypeError), match=message):
            process_video(clip, tmp_path / "still.mp4", TIMING, **options)
    refuses(lambda: process_video(clip, tmp_path / "still.tif", TIMING), "videos are written to")
    refuses(lambda: process_video(clip, clip, TIMING), "it is the input")
    two = f"{clip}[0:2]"
    refuses(lambda: process_video(two, tmp_path / "still.mp4", TIMING), "at least 3 frames, it has 2")
    assert list(tmp_path.iterdir()) == []


def test_an_axis_without_vibration_is_left_as_taken(tmp_path):
    source = write(tmp_path / "clip.mp4", grey_counts_of(TIMING, Motion((2.1, 0.0), (52.0, 71.0), (0.5, 1.0)), 20))
    report = process_video(source, tmp_path / "still.mp4", TIMING, **OPTIONS)
    assert gains(source, pixels(tmp_path / "still.mp4"), STILL[0]).min() > 6
    (record,) = read_manifest(report.manifest).windows
    assert record.frames == "restored"
    assert [(reason.code, reason.axis) for reason in record.left_alone] == [("axis_not_reliable", "y")]


def test_a_video_without_a_common_motion_is_refused(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (10, HEIGHT, WIDTH, 3), dtype=np.uint8)
    write(tmp_path / "noise.mp4", noise)
    with pytest.raises(ValueError, match="no motion was found that the corners of the frames have in common"):
        process_video(tmp_path / "noise.mp4", tmp_path / "still.mp4", TIMING, **OPTIONS)
    assert [path.name for path in tmp_path.iterdir()] == ["noise.mp4"]


def test_one_command_steadies_a_shaky_video_along_the_mean_of_its_path(shaky, tmp_path, capsys):
    arguments = ("run", shaky, tmp_path / "out", *CAMERA, "--method", "dewarp", "--video")
    steady = (*arguments, "--border", "crop", "--steady", "0.5")
    assert rsvib(*steady, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    # the standard deviation is 0.003 to 0.3 Hz, because the clip is short and its shaking has a period of ten frames
    assert answer["windows"]["tones"]["x"]["tones"][0]["frequency"] == pytest.approx(52.0, abs=0.5)
    assert answer["windows"]["tones"]["x"]["reliable_windows"] == 2
    names = ["before_after.png", "manifest.json", "restored.mp4", "tones.csv", "windows.png"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    raw, frames = (pixels(path).mean(1) for path in (shaky, tmp_path / "out" / "restored.mp4"))
    inner, pan = slice(5, -6), 12.0 / RATE  # near both ends, the mean is over less than a period of the shaking
    assert np.abs(shifts(raw)[inner, 0] - pan).max() > 0.8
    assert (np.abs(shifts(frames)[inner] - [pan, 0.0]).max(0) < [0.2, 0.1]).all()  # the video is compressed twice
    count, height, width = frames.shape
    assert (count, height % 2, width % 2) == (COUNT, 0, 0)
    assert HEIGHT - 16 <= height < HEIGHT - 2
    assert WIDTH - 24 <= width < WIDTH - 4
    margins = json.loads((tmp_path / "out" / "manifest.json").read_text())["margins"]
    assert margins["top"] % 2 == margins["left"] % 2 == 0
    assert min(margins.values()) >= 2
    assert rsvib(*steady, "--resume", "--report") == 0  # the page shows frames of the run
    text = (tmp_path / "out" / "report.html").read_text()
    assert "Frames 8 and 9," in text
    assert "Measured offsets" not in text
    assert "The camera was followed from frame to frame" in text
    wrong = {
        steady: "results exist already",
        (*arguments[:3], *CAMERA, "--steady", "1"): "--steady goes with --video",
        (*steady, "--overwrite", "--joint", "3"): "joint is no option of method='dewarp'",
        (*steady[:-1], "-1", "--overwrite"): "steady must be at least 0, got -1",
    }
    for command, message in wrong.items():
        assert message in refused(capsys, *command)


def test_frames_that_the_camera_has_stabilised_are_moved_as_a_whole(tmp_path, capsys):
    rng = np.random.default_rng(6)
    shift = np.cumsum(rng.normal(0, 1.2, (COUNT, 2)), 0)
    shift -= shift.mean(0)
    taken = [crop(move(SCENE[1], one, order=3, mode="reflect")) for one in shift]
    counts = np.clip(np.round(255 * np.repeat(np.stack(taken)[..., None], 3, -1)), 0, 255).astype(np.uint8)
    clip = write(tmp_path / "clip.mp4", counts)
    turned = [[0.9998, 0.0, 0.02, 0.0]] * 30
    add_track(clip, [packet(RATES[:20], total=20, turned=turned, exposures=[6e-4] * 30)] * 2)
    arguments = ("run", clip, tmp_path / "out", "--row-time", "150us", "--frame-rate", "30", "--video")
    assert rsvib(*arguments, "--steady", "1s", "--method", "dewarp", "--output", "steady.mkv", "--json") == 0
    shown = capsys.readouterr()
    assert len(read_stack(tmp_path / "out" / "steady.mkv")) == COUNT
    assert "the camera has stabilised the frames" in shown.err
    settings = read_manifest(tmp_path / "out" / "manifest.json").settings
    assert settings["video"]["stabilised"] is True
    assert settings["sensor"]["exposure_rows"] == pytest.approx(4, rel=1e-3)
    assert settings["video"]["exposures"] == pytest.approx([6e-4, 6e-4])
    before, after = (data for data in json.loads(shown.out)["shaking"]["frame_to_frame"])
    assert after < 0.1 * before
    rows = json.loads(shown.out)["shaking"]["rows"]
    assert rows[1] < 1.2 * rows[0] + 0.02  # px; nothing was skewed


def test_a_scene_that_repeats_itself_is_refused_where_it_moves_by_much_of_its_period(tmp_path):
    height, width = (side + 2 * MARGIN for side in (HEIGHT, WIDTH))
    period = draw_scene(height, 20, 3, 1.0)
    fence = np.stack([np.tile(period, width // 20 + 1)[:, :width]] * 3)
    clip = write(tmp_path / "fence.mp4", counts_of(shaken(amplitude=25.0, frequency=4.3), scene=fence))
    target = tmp_path / "steady.mp4"
    refuses(lambda: process_video(clip, target, TIMING, steady=1.0, **OPTIONS), "every 20 px")
    assert not target.exists()
