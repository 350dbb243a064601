from dataclasses import replace

import pytest
import torch
from truth import Motion, draw_scene, take_frames

from rsvib_torch import Vibration
from rsvib_torch.detection.rows.equal_blur import Shown, warp_to_same_blur
from rsvib_torch.detection.rows.row_groups import frame_groups, measure_group, stack_spectra
from rsvib_torch.registration.row_spectra import RowSpectra

MOTION = Motion((3.1, 5.2), (50.0, 30.0), (-1.39, -1.42))


@pytest.fixture(scope="module")
def pairs(paper_camera):
    """Noiseless half frames of two scenes (B, 2, H, W), exposed for 400 rows."""
    camera = replace(paper_camera, exposure_rows=400)
    taken = [take_frames(draw_scene(1104, 464, seed), camera, MOTION, 2, samples=64) for seed in (5, 6)]
    return torch.stack([torch.from_numpy(frames).float() for frames in taken]), camera


def of_each_stack(motion: Motion) -> Vibration:
    one = motion.vibration()
    values = (one.amplitude, one.frequency, one.phase, one.image_motion)
    return Vibration(*(value.expand(2, *value.shape) for value in values))


def prepared(frames, camera):
    """Spectra of the frames, where they show the scene by the true motion, and what warps them to it."""
    spectra, truth = RowSpectra(frames), of_each_stack(MOTION)
    place = torch.arange(frames.shape[-2], dtype=torch.float64).expand(2, 1, -1)
    left, starts = torch.zeros(2, 1, 1, dtype=torch.float64), camera.frame_starts(2).expand(2, -1)[..., None]
    shown = Shown.of(place, left, starts, camera, truth)
    return spectra, shown, warp_to_same_blur(spectra, shown, place, left, camera, truth)


def test_rows_are_where_the_motion_says(pairs):
    """Measured around the true motion rows miss nothing; kernels that change from row to row would leave 3e-3 px."""
    frames, camera = pairs
    truth = of_each_stack(MOTION)
    (group,) = frame_groups(stack_spectra(frames, None), camera, truth, alike=True)
    found, _ = measure_group(group, camera, truth, None)
    expected = found.relative(truth.mean_displacement(found.moments, found.exposure_time))
    wrong = (found.displacements - expected)[:, 8:-8, 0].unflatten(1, (-1, 8)).mean(2)  # of 64 rows each
    assert bool((wrong.square().mean(1).sqrt() < torch.tensor([8e-4, 1.5e-3])).all())


def test_both_frames_show_the_same_image(pairs):
    frames, camera = pairs
    spectra, shown, warp = prepared(frames, camera)

    def apart(warped):
        images = torch.fft.irfft(warped, n=spectra.length)[:, :, 40:-40, 40 : frames.shape[-1] - 40]
        return float((images[:, 0] - images[:, 1]).square().mean().sqrt())

    whole = warp(slice(None))
    assert apart(whole) < 0.04 * apart(spectra.warped(shown.rows, shown.shift))
    parts = torch.cat([warp(slice(first, first + 300)) for first in range(0, frames.shape[-2], 300)], 2)
    torch.testing.assert_close(parts, whole, atol=1e-4, rtol=1e-4)


def test_frames_blurred_alike_are_only_warped(paper_camera, pairs):
    frames, _ = pairs
    spectra, shown, warp = prepared(frames, paper_camera)
    torch.testing.assert_close(warp(slice(None)), spectra.warped(shown.rows, shown.shift))
