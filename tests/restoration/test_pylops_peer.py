"""Comparison with pylops: its operator reproduces the frames, and its best result is the reference."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from truth import MARGIN, Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming
from rsvib_torch.restoration import restore

pytest.importorskip("pylops")
pytest.importorskip("numba")

TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=100, frame_rows=2048)
MOTION = Motion()


@pytest.fixture(scope="module")
def peer():
    """The module of the benchmark."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[2] / "scripts"))
        from benchmarks import pylops_peer

        yield pylops_peer
        for name in [name for name in sys.modules if name.split(".")[0] == "benchmarks"]:
            del sys.modules[name]


@pytest.fixture(scope="module")
def scene_and_frame():
    """A scene and a noiseless frame, whose motion blur includes content beyond the borders of the frame."""
    scene = draw_scene(192 + 2 * MARGIN, 160 + 2 * MARGIN, seed=61)
    return crop(scene), take_frames(scene, TIMING, MOTION, 1, samples=64)[0]


def test_operator_forms_the_frame_and_has_its_adjoint(peer, scene_and_frame):
    scene, frame = scene_and_frame
    operator = peer.frame_operator(scene.shape, TIMING, MOTION.vibration(), "float64")
    formed = (operator @ scene.ravel()).reshape(scene.shape)
    assert decibel(formed, frame, 16) > 55
    assert decibel(scene, frame, 16) < 30
    generator = np.random.default_rng(0)
    x, y = generator.standard_normal((2, scene.size))
    assert (operator @ x) @ y == pytest.approx(x @ (operator.H @ y), rel=1e-10)


def test_exact_restoration_is_more_accurate_than_the_best_of_cgls(peer, scene_and_frame):
    scene, frame = scene_and_frame
    noisy = torch.from_numpy(frame + 0.005 * np.random.default_rng(1).standard_normal(frame.shape)).float()
    best = peer.cgls_restore(noisy.numpy(), TIMING, MOTION.vibration(), torch.from_numpy(scene), 32)
    assert decibel(best.restored, scene) > decibel(noisy, scene) + 15
    assert decibel(restore(noisy[None], TIMING, MOTION.vibration())[0], scene) > decibel(best.restored, scene)
