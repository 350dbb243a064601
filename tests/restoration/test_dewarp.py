"""Methods ``"dewarp"`` and ``"banded"``, and ``FixedDewarp``: the same result, without graph breaks and in ONNX."""

from functools import partial

import numpy as np
import pytest
import torch
from truth import Motion, crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv

TIMING = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
dewarp = partial(rsv.restore, method="dewarp")


@pytest.mark.parametrize(("method", "noise", "gain"), [("dewarp", 0.0, 25), ("banded", 0.003, 20)])
def test_distortion_is_removed(method, noise, gain):
    motion, scene = Motion(), draw_scene(336, 288, seed=14, blur=1.0)
    truth, frames = crop(scene), torch.from_numpy(take_frames(scene, TIMING, motion, 2, noise))
    good, half = (rsv.restore(frames, TIMING, one.vibration(), method=method) for one in (motion, motion.scaled(0.5)))
    for frame, restored, halfway in zip(frames, good, half, strict=True):
        assert decibel(restored, truth) > decibel(frame, truth) + gain
        assert decibel(halfway, truth) < decibel(frame, truth) + 12


def test_sinusoids_are_interpolated_exactly():
    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=1, frame_rows=2048)
    motion = Motion(phase=(0.2, 2.0))
    rows, columns = np.arange(300.0)[:, None], np.arange(200.0)
    x, y = motion.displacement((rows[:, 0] + 0.5) * timing.row_time).T

    def scene(r, c):
        return np.sin(0.5 * r + 0.3 * c) + np.sin(0.9 * r - 0.7 * c)

    frame = torch.from_numpy(scene(rows - y[:, None], columns - x[:, None]))
    restored = dewarp(frame[None], timing, motion.vibration())[0].numpy()
    assert abs(restored - scene(rows, columns))[16:-16, 24:-24].max() < 2e-3
    assert abs(frame.numpy() - scene(rows, columns))[16:-16, 24:-24].max() > 1


VIBRATION = rsv.Vibration([2.1, 1.6], [110.0, 90.0], [0.5, 1.0], image_motion=(40.0, 20.0))


def recording(**layout):
    """Timing, two colour frames (2, 3, 72, 90), the module for them and the result that it must have."""
    timing = rsv.SensorTiming(row_time=1e-4, exposure_rows=10, frame_rows=120, **layout)
    scene = torch.from_numpy(draw_scene(120, 140, seed=3)).float().expand(3, -1, -1)
    frames = rsv.simulate_frames(scene, timing, VIBRATION, num_frames=2, frame_size=(72, 90))
    fixed = rsv.FixedDewarp(timing, VIBRATION, (72, 90), num_frames=2)
    return timing, frames, fixed, dewarp(frames, timing, VIBRATION, check=False)


@pytest.mark.parametrize("layout", [{}, {"scan_axis": -1}, {"readout_direction": "reverse"}])
def test_result_is_that_of_restore(layout):
    timing, frames, fixed, expected = recording(**layout)
    for stack in (frames, frames[:, 0], torch.stack([frames, frames.flip(-1)])):
        restored = dewarp(stack, timing, VIBRATION, check=False)
        torch.testing.assert_close(fixed(stack), restored, atol=5e-6, rtol=0)
    assert (expected - frames).abs().max() > 0.05


def test_graph_has_no_break():
    _, frames, fixed, expected = recording()
    compiled = torch.compile(fixed, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(frames), expected, atol=5e-6, rtol=0)


@pytest.mark.filterwarnings("ignore:`isinstance:FutureWarning")  # of PyTorch, within its exporter
def test_onnx_and_exported_program_give_the_same_result(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    _, frames, fixed, expected = recording()
    program = torch.export.export(fixed, (frames,))
    torch.testing.assert_close(program.module()(frames), expected, atol=5e-6, rtol=0)
    torch.onnx.export(program, (), tmp_path / "dewarp.onnx", verbose=False)
    session = onnxruntime.InferenceSession(tmp_path / "dewarp.onnx")
    (restored,) = session.run(None, {session.get_inputs()[0].name: frames.numpy()})
    np.testing.assert_allclose(restored, expected, atol=1e-5)


def test_gradient_reaches_the_frames():
    _, frames, fixed, _ = recording()
    weights = torch.rand(frames.shape, generator=torch.Generator().manual_seed(1))
    given = frames.clone().requires_grad_()
    (fixed(given) * weights).sum().backward()
    change = torch.rand(frames.shape, generator=torch.Generator().manual_seed(2))
    along = ((fixed(frames + change) - fixed(frames)).double() * weights).sum()  # the module is linear
    assert float((given.grad.double() * change).sum()) == pytest.approx(float(along), rel=1e-4)


def test_boundaries_are_not_periodic():
    frames = torch.full((1, 128, 96), 0.2)
    frames[:, :, :12] = 1.0
    frames[:, :12] = 1.0
    restored = rsv.restore(frames, TIMING, rsv.Vibration([3.1, 5.2], [50.0, 30.0], [0.5, 1.0]), method="banded")
    assert (restored[:, 40:, -16:] - 0.2).abs().max() < 1e-3
    assert (restored[:, -16:, 40:] - 0.2).abs().max() < 1e-3
    assert restored.amax() > 0.8
