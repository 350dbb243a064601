from dataclasses import replace

import pytest
import torch
from truth import Motion, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.detection.rows import displacements
from rsvib_torch.detection.rows.displacements import FrameGroup, frame_groups, measure_groups, stack_spectra
from rsvib_torch.registration.row_spectra import RowSpectra

MOTION = Motion((3.1, 5.2), (50.0, 30.0), (-1.39, -1.42))


@pytest.fixture(scope="module")
def pairs(paper_camera):
    """Noiseless half frames of two scenes (B, 2, H, W), exposed for 400 rows."""
    camera = replace(paper_camera, exposure_rows=400)
    taken = [take_frames(draw_scene(1104, 464, seed), camera, MOTION, 2, samples=64) for seed in (5, 6)]
    return torch.stack([torch.from_numpy(frames).float() for frames in taken]), camera


def for_both_stacks(motion: Motion) -> Vibration:
    one = motion.vibration()
    values = (one.amplitude, one.frequency, one.phase, one.image_motion)
    return Vibration(*(value.expand(2, *value.shape) for value in values))


def prepared(frames, camera):
    """Spectra of the frames, the positions of the scene rows by the true motion, and the function that warps them."""
    spectra, truth = RowSpectra(frames), for_both_stacks(MOTION)
    group = FrameGroup(spectra, camera.frame_starts(2).expand(2, -1))
    positions = displacements._Positions.of(group, camera, truth)
    return spectra, positions, displacements._warp_to_scene(spectra, positions, camera, truth)


def test_residual_displacements_about_the_true_motion_are_zero(pairs):
    """Without the correction for kernels that change from row to row they would be 3e-3 px."""
    frames, camera = pairs
    truth = for_both_stacks(MOTION)
    groups = frame_groups(stack_spectra(frames, None), camera, truth, pairs_if_blurred_differently=True)
    found, _ = measure_groups(groups, camera, truth)
    expected = found.relative(truth.mean_displacement(found.exposure_starts, found.exposure_time))
    wrong = (found.displacements - expected)[:, 8:-8, 0].unflatten(1, (-1, 8)).mean(2)  # of 64 rows each
    assert bool((wrong.square().mean(1).sqrt() < torch.tensor([8e-4, 1.5e-3])).all())


def test_warped_frames_of_a_pair_are_equal(pairs):
    frames, camera = pairs
    spectra, positions, warp = prepared(frames, camera)

    def difference(warped):
        images = torch.fft.irfft(warped, n=spectra.length)[:, :, 40:-40, 40 : frames.shape[-1] - 40]
        return float((images[:, 0] - images[:, 1]).square().mean().sqrt())

    whole = warp(slice(None))
    assert difference(whole) < 0.04 * difference(spectra.warped(positions.rows, positions.shift))
    parts = torch.cat([warp(slice(first, first + 300)) for first in range(0, frames.shape[-2], 300)], 2)
    torch.testing.assert_close(parts, whole, atol=1e-4, rtol=1e-4)


def test_frames_with_equal_blur_are_only_warped(paper_camera, pairs):
    frames, _ = pairs
    spectra, positions, warp = prepared(frames, paper_camera)
    torch.testing.assert_close(warp(slice(None)), spectra.warped(positions.rows, positions.shift))


def test_rows_far_outside_the_frames_do_not_lengthen_the_record():
    """A fit of frames with a wrong timing may displace them by any distance; the frequency grid must stay bounded."""
    camera = SensorTiming(row_time=1e-4, exposure_rows=10, frame_rows=80).in_row_order()
    frames = torch.rand(1, 2, 64, 96, generator=torch.Generator().manual_seed(0))
    far = Vibration([0.0, 1e4], [1.0, 0.5], 1.5).expanded(1)
    measured, _ = measure_groups(frame_groups(stack_spectra(frames, None), camera, far), camera, far)
    assert float(measured.duration) <= 3 * 64 * camera.row_time
    assert not bool(measured.visible.any())


def test_rows_between_scene_rows_are_those_of_the_exact_solution():
    timing = SensorTiming(row_time=2e-5, exposure_rows=200, frame_rows=2048).in_row_order()
    motion = Vibration([[[3.1], [5.2]]], [[[53.0], [65.0]]], [[[0.4], [1.3]]], [[20.0, -30.0]])
    rows = torch.arange(300, dtype=torch.float64)[None, None]
    columns, starts = torch.zeros(1, 1, 1, dtype=torch.float64), torch.tensor([[[0.0], [0.04]]], dtype=torch.float64)
    positions = displacements._Positions.of_rows(rows, columns, starts, timing, motion)
    away = 12 * torch.rand(1, 2, 300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) - 6
    expected = displacements._Positions.of_rows(
        rows[..., None] + away, columns[..., None], starts[..., None], timing, motion
    )
    found = displacements._between_rows(positions, timing, motion, away)
    torch.testing.assert_close(found, (expected.rows, expected.shift), rtol=0, atol=2e-6)
    far, _ = displacements._between_rows(positions, timing, motion, 1e12 * away)  # of a fit that diverged
    assert far.isfinite().all()
