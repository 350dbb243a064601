"""Dewarping by a fixed vibration: the result of ``restore``, as a graph without breaks and in ONNX."""

import numpy as np
import pytest
import torch
from refusals import refuses
from truth import draw_scene

import rsvib_torch as rsv

VIBRATION = rsv.Vibration([2.1, 1.6], [110.0, 90.0], [0.5, 1.0], image_motion=(40.0, 20.0))


def recording(**layout):
    """Timing, and two colour frames (2, 3, 72, 90)."""
    timing = rsv.SensorTiming(row_time=1e-4, exposure_rows=10, frame_rows=120, **layout)
    scene = torch.from_numpy(draw_scene(120, 140, seed=3)).float().expand(3, -1, -1)
    return timing, rsv.simulate_frames(scene, timing, VIBRATION, num_frames=2, frame_size=(72, 90))


def expected(frames, timing):
    return rsv.restore(frames, timing, VIBRATION, method="dewarp", check=False)


@pytest.mark.parametrize("layout", [{}, {"scan_axis": -1}, {"readout_direction": "reverse"}])
def test_result_is_that_of_restore(layout):
    timing, frames = recording(**layout)
    dewarp = rsv.FixedDewarp(timing, VIBRATION, (72, 90), num_frames=2)
    for stack in (frames, frames[:, 0], torch.stack([frames, frames.flip(-1)])):
        torch.testing.assert_close(dewarp(stack), expected(stack, timing), atol=5e-6, rtol=0)
    assert (expected(frames, timing) - frames).abs().max() > 0.05


def test_graph_has_no_break():
    timing, frames = recording()
    dewarp = rsv.FixedDewarp(timing, VIBRATION, (72, 90), num_frames=2)
    compiled = torch.compile(dewarp, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(frames), expected(frames, timing), atol=5e-6, rtol=0)


@pytest.mark.filterwarnings("ignore:`isinstance:FutureWarning")  # of PyTorch, within its exporter
def test_onnx_and_exported_program_give_the_same_result(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    timing, frames = recording()
    dewarp = rsv.FixedDewarp(timing, VIBRATION, (72, 90), num_frames=2)
    program = torch.export.export(dewarp, (frames,))
    torch.testing.assert_close(program.module()(frames), expected(frames, timing), atol=5e-6, rtol=0)
    torch.onnx.export(program, (), tmp_path / "dewarp.onnx", verbose=False)
    session = onnxruntime.InferenceSession(tmp_path / "dewarp.onnx")
    (restored,) = session.run(None, {session.get_inputs()[0].name: frames.numpy()})
    np.testing.assert_allclose(restored, expected(frames, timing), atol=1e-5)


def test_gradient_reaches_the_frames():
    timing, frames = recording()
    dewarp = rsv.FixedDewarp(timing, VIBRATION, (72, 90), num_frames=2)
    weights = torch.rand(frames.shape, generator=torch.Generator().manual_seed(1))
    given = frames.clone().requires_grad_()
    (dewarp(given) * weights).sum().backward()
    change = torch.rand(frames.shape, generator=torch.Generator().manual_seed(2))
    along = ((dewarp(frames + change) - dewarp(frames)).double() * weights).sum()  # the module is linear
    assert float((given.grad.double() * change).sum()) == pytest.approx(float(along), rel=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vibration": VIBRATION.expanded(2)}, "vibration is a batch"),
        ({"vibration": rsv.Vibration([1.0, 1.0, 1e-3], [50.0] * 3)}, "roll, zoom or a camera"),
        ({"size": (500, 90)}, "500"),
        ({"vibration": rsv.Vibration(500.0, 50.0)}, "more than its size"),
    ],
)
def test_arguments_that_restore_refuses_are_refused(change, message):
    timing, _ = recording()
    arguments = {"timing": timing, "vibration": VIBRATION, "size": (72, 90), "num_frames": 2} | change
    refuses(lambda: rsv.FixedDewarp(**arguments), message)


def test_frames_of_another_size_are_refused():
    timing, frames = recording()
    dewarp = rsv.FixedDewarp(timing, VIBRATION, (72, 90), num_frames=2)
    refuses(lambda: dewarp(frames[:1]), r"frames must be stacks of .* = \(2, 72, 90\)")
    refuses(lambda: dewarp(frames.double()), r"frames must be torch\.float32", TypeError)
