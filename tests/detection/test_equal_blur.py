from dataclasses import replace

import numpy as np
import pytest
import torch
from truth import Motion, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration, simulate_frames
from rsvib_torch.detection.rows.displacements import (
    differential_motion,
    frame_groups,
    measure_groups,
    stack_spectra,
    uneven_motion,
)

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


def test_residual_displacements_about_the_true_motion_are_zero(pairs):
    """Without the correction for kernels that change from row to row they would be 3e-3 px."""
    frames, camera = pairs
    truth = for_both_stacks(MOTION)
    groups = frame_groups(stack_spectra(frames, None), camera, truth, pairs_if_blurred_differently=True)
    found, _ = measure_groups(groups, camera, truth)
    moved = truth.mean_displacement(torch.from_numpy(found.exposure_starts), found.exposure_time)
    wrong = (found.displacements - found.relative(moved.numpy()))[:, 8:-8, 0]
    wrong = wrong.reshape(len(wrong), -1, 8, 2).mean(2)  # of 64 rows each
    assert (np.sqrt(np.square(wrong).mean(1)) < [8e-4, 1.5e-3]).all()


@pytest.mark.parametrize(("exposure_rows", "sizes"), [(2, [7, 6, 6]), (60, [2] * 16)])
def test_groups_that_are_measured_together_equal_single_ones(exposure_rows, sizes):
    """Long records consist of many groups; of 17 frames, 16 pairs if the exposure blurs them differently."""
    camera = SensorTiming(row_time=1e-4, exposure_rows=exposure_rows, frame_rows=100).in_row_order()
    motion = Vibration([1.0, 0.7], [70.0, 55.0], [0.3, 1.0], image_motion=(3.0, -2.0))
    scenes = [torch.from_numpy(draw_scene(152, 184, seed)).float() for seed in (7, 8)]
    taken = [simulate_frames(scene, camera, motion, 17, frame_size=(96, 128)) for scene in scenes]
    of_stacks, spectra = motion.expanded(2), stack_spectra(torch.stack(taken), None)
    together, single = (
        frame_groups(spectra, camera, of_stacks, pairs_if_blurred_differently=True, one_at_a_time=one_at_a_time)
        for one_at_a_time in (False, True)
    )
    assert [group.size for group in single] == sizes
    assert len(together) < len(single)
    measured, gradients = measure_groups(together, camera, of_stacks)
    expected, of_single = measure_groups(single, camera, of_stacks)
    np.testing.assert_allclose(measured.displacements, expected.displacements, atol=1e-5)
    np.testing.assert_allclose(measured.information, expected.information, rtol=1e-3, atol=1e-2)
    again, _ = measure_groups(together, camera, of_stacks, gradients)
    np.testing.assert_allclose(again.displacements, expected.displacements, atol=1e-5)
    for halves in (differential_motion, uneven_motion):
        np.testing.assert_allclose(halves(gradients, 2), halves(of_single, 2), atol=1e-4)
    later, of_later = together[0].stacks(torch.tensor([1])), motion.expanded(1)
    part, _ = measure_groups([later], camera, of_later)
    count = part.displacements.shape[1]
    np.testing.assert_allclose(part.displacements, expected.displacements[1:, :count], atol=1e-5)


@pytest.mark.parametrize("exposure_rows", [10, 60])
def test_rows_far_outside_the_frames_do_not_lengthen_the_record(exposure_rows):
    """A fit of frames with a wrong timing may displace them by any distance; the frequency grid must stay bounded."""
    camera = SensorTiming(row_time=1e-4, exposure_rows=exposure_rows, frame_rows=80).in_row_order()
    frames = torch.rand(1, 2, 64, 96, generator=torch.Generator().manual_seed(0))
    far = Vibration([0.0, 1e4], [1.0, 0.5], 1.5).expanded(1)
    measured, _ = measure_groups(frame_groups(stack_spectra(frames, None), camera, far), camera, far)
    assert measured.duration[0] <= 3 * 64 * camera.row_time
    assert not measured.visible.any()
    assert np.isfinite(measured.displacements).all()
