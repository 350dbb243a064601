import math

import numpy as np
import pytest
import torch
from truth import Motion, draw_scene, take_frames

from rsvib_torch import detect_vibration, register_bands
from rsvib_torch.registration.gradients import RowSpectra, row_gradients, row_shifts

MARGIN = 40


def pair_of(camera, motion, seed, noise, rows=2048, columns=512, num_frames=2):
    """Noisy frames of a scene drawn from the seed."""
    scene = draw_scene(rows + 2 * MARGIN, columns + 2 * MARGIN, seed)
    frames = take_frames(scene, camera, motion, num_frames, noise, seed=seed, samples=8)
    return torch.from_numpy(frames).float()


def errors(vibration, motion):
    """Period %, amplitude %, phase in pi of each axis: (3, 2)."""
    truth = motion.vibration()
    turn = torch.remainder(vibration.phase - truth.phase + math.pi, 2 * math.pi) - math.pi
    period = 100 * (truth.frequency / vibration.frequency - 1)
    amplitude = 100 * (vibration.amplitude / truth.amplitude - 1)
    return torch.stack([period, amplitude, turn / math.pi])[..., 0].abs()


CASES = {
    "paper": (Motion(phase=(-2.1, 0.3)), 0.005, (0.01, 0.15, 0.001)),
    "paper, noisy": (Motion(phase=(1.9, -1.1)), 0.02, (0.03, 0.6, 0.003)),
    "small": (Motion((0.2, 0.13), (155.0, 155.0), (0.8, -2.6)), 0.005, (0.1, 1.0, 0.01)),
    "push-scan": (Motion((1.2, 0.8), (83.0, 110.0), (2.7, 0.2), (500.0, 0.0)), 0.005, (0.03, 0.2, 0.002)),
}


@pytest.mark.parametrize("name", CASES)
def test_direct_at_the_limit(paper_camera, name):
    motion, noise, limits = CASES[name]
    frames = pair_of(paper_camera, motion, 41, noise)
    result = detect_vibration(frames, paper_camera, method="direct")
    assert result.vibration.amplitude.shape == (2, 1)
    assert result.reliable.all()
    for error, limit in zip(errors(result.vibration, motion), limits, strict=True):
        assert float(error.max()) < limit, (name, error.tolist(), limit)


def test_direct_beats_bands_and_keeps_the_curve(paper_camera):
    motion = Motion(phase=(0.9, 2.2))
    frames = pair_of(paper_camera, motion, 42, 0.005)
    bands, direct = (detect_vibration(frames, paper_camera, method=method) for method in ("bands", "direct"))
    assert bool(
        (
            errors(direct.vibration, motion)[1]
            < 0.5 * bands.std.amplitude[:, 0] / bands.vibration.amplitude[:, 0] * 100
        ).all()
    )
    assert bool((direct.std.amplitude < bands.std.amplitude).all())
    # the curve is that of the bands, and the refined motion explains it as well as the bands' own fit
    torch.testing.assert_close(direct.offsets.offsets, bands.offsets.offsets, equal_nan=True)
    assert bool((direct.residual < 1.2 * bands.residual + 1e-3).all())


def test_two_tones_over_four_frames_are_counted(paper_camera):
    first = Motion((1.5, 1.2), (41.0, 97.0), (0.7, 0.3))
    second = Motion((0.6, 0.4), (180.0, 66.0), (2.1, -2.0))

    class Both:
        def displacement(self, times):
            return first.displacement(times) + second.displacement(times)

    frames = pair_of(paper_camera, Both(), 43, 0.005, columns=384, num_frames=4)
    found = detect_vibration(frames, paper_camera, method="direct").vibration
    assert found.amplitude.shape == (2, 2)
    for k, motion in enumerate((first, second)):
        truth = motion.vibration()
        assert (found.frequency[:, k] / truth.frequency[:, 0] - 1).abs().max() < 2e-4
        assert (found.amplitude[:, k] / truth.amplitude[:, 0] - 1).abs().max() < 5e-3


def test_still_camera_and_blind_frequency_are_refused(paper_camera):
    still = pair_of(paper_camera, Motion((0.0, 0.0), (0.0, 0.0), (0.0, 0.0)), 44, 0.005, columns=256)
    result = detect_vibration(still, paper_camera, method="direct")
    assert not result.reliable.any()
    assert bool((result.vibration.amplitude == 0).all())
    blind = 1 / paper_camera.frame_period
    frames = pair_of(paper_camera, Motion((2.0, 1.0), (blind, 90.0), (0.4, 1.0)), 45, 0.005, columns=256)
    result = detect_vibration(frames, paper_camera, method="direct")
    assert result.reliable.tolist() == [False, True]
    assert result.vibration.frequency[1, 0].item() == pytest.approx(90.0, rel=2e-3)


@pytest.mark.parametrize("remaining", [0.0, 0.05, -0.3])
@pytest.mark.parametrize("num_frames", [2, 3])
def test_rows_tell_a_known_shift(remaining, num_frames):
    """Frames moved along the rows by multiples of a shift: every row tells each frame's place about the mean."""
    scene = draw_scene(96, 192, 46)
    u = np.fft.rfftfreq(192)
    moved = [
        np.fft.irfft(np.fft.rfft(scene) * np.exp(-2j * np.pi * u * p * remaining), n=192) for p in range(num_frames)
    ]
    noise = 1e-5 * np.random.default_rng(1).standard_normal((num_frames, 96, 192))
    frames = torch.from_numpy(np.stack(moved) + noise)[None, :, :, 16:-16]
    spectra = RowSpectra(frames)
    rows = torch.arange(96, dtype=torch.float64).expand(1, num_frames, 96)
    seen = ((rows >= 8) & (rows <= 87)).double()
    none = torch.zeros_like(rows)
    gradients = row_gradients(spectra, rows, none, seen)
    expected = remaining * (torch.arange(num_frames) - (num_frames - 1) / 2)

    def told(shift):
        matrix, right = row_shifts(spectra, gradients, rows, shift, seen)
        known = matrix[0, :, 0, 0] > 0
        assert known.tolist() == seen[0, 0].bool().tolist()
        total, sums = matrix[0].sum(0), right[0].sum(1)
        return torch.linalg.solve(total, sums[..., None])[..., 0]

    shifts = told(none)
    torch.testing.assert_close(shifts[:, 0], expected.double(), rtol=0.1, atol=2e-4)
    assert shifts[:, 1].abs().max() < 0.02 * abs(remaining) + 1e-5
    # what is taken out beforehand does not remain
    assert told(expected[None, :, None].expand(1, -1, 96).double()).abs().max() < 1e-3


def test_direct_refuses_what_bands_refuse(paper_camera):
    with pytest.raises(ValueError, match="constant"):
        detect_vibration(torch.ones(2, 256, 256), paper_camera, method="direct")
    assert register_bands(torch.rand(2, 128, 128), paper_camera).offsets.shape[-1] == 2
