"""The modules as parts of a model: batches, copies, state, compilers, mixed precision, workers, gradients, arrays."""

import copy
import io
import pickle

import numpy as np
import pytest
import torch
from torch import nn
from truth import MARGIN, Motion, crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv

TIMING = rsv.SensorTiming(row_time=40e-6, exposure_rows=30, frame_rows=320)
MOTIONS = (Motion((3.1, 4.2), (130.0, 90.0), (0.4, 1.3)), Motion((2.2, 1.4), (70.0, 210.0), (-1.0, 2.0)))
METHODS = ("exact", "banded", "dewarp")


@pytest.fixture(scope="module")
def scene():
    return draw_scene(256 + 2 * MARGIN, 160 + 2 * MARGIN, seed=4)


@pytest.fixture(scope="module")
def frames(scene):
    """A batch (2, 2, 1, 256, 160) of two stacks with different vibrations."""
    stacks = [take_frames(scene, TIMING, motion, 2, 0.002, seed=seed) for seed, motion in enumerate(MOTIONS)]
    return torch.from_numpy(np.stack(stacks)[:, :, None]).float()


@pytest.fixture(scope="module")
def vibration():
    return rsv.Vibration.stacked([motion.vibration() for motion in MOTIONS])


@pytest.fixture(scope="module")
def blur():
    psf = rsv.row_psf(
        MOTIONS[0].vibration(), TIMING.row_starts(1, 48)[0], TIMING, interpolation="cubic", quadrature="gauss"
    )
    return rsv.RowVaryingBlur(psf)


def modules(blur, vibration):
    """Name, module and arguments for small frames."""
    small = torch.rand(2, 2, 1, 48, 40, generator=torch.Generator().manual_seed(1))
    yield "blur", blur, (small,)
    for method in METHODS:
        yield method, rsv.VibrationRestorer(TIMING, method=method), (small, vibration)


def test_modules_restore_a_batch_and_state_their_options(frames, scene):
    """From frames to restored frames: 5 dB better than the input, with gradients and a representation."""
    detector, restorer = rsv.VibrationDetector(TIMING, tones=1), rsv.VibrationRestorer(TIMING, method="dewarp")
    taken = frames.clone().requires_grad_()
    detection = detector(taken)
    restored = restorer(taken, detection)
    assert restored.shape == frames.shape
    assert detection.reliable.all()
    for stack in range(2):
        before, after = (decibel(images[stack, 0, 0].detach(), crop(scene)) for images in (frames, restored))
        assert after > before + 5
    restored.square().mean().backward()
    assert taken.grad.abs().sum() > 0
    text = repr(nn.ModuleList([detector, restorer]))
    assert "VibrationDetector(timing=SensorTiming(row_time=4e-05, exposure_rows=30" in text
    assert text.count(", tones=1)") == text.count("), method='dewarp')") == 1
    with pytest.raises(TypeError, match="unknown option 'blur'"):
        rsv.VibrationRestorer(TIMING, blur=1)


def test_copies_state_and_autocast(frames, blur, vibration):
    """Copies and stored states give the same result, which does not depend on mixed precision."""
    for name, module, arguments in modules(blur, vibration):
        expected = module(*arguments)
        stored = io.BytesIO()
        torch.save(module.state_dict(), stored)
        for other in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
            stored.seek(0)
            other.load_state_dict(torch.load(stored, weights_only=True))
            assert torch.equal(other(*arguments), expected), name
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert torch.equal(module(*arguments), expected), name
    detector = pickle.loads(pickle.dumps(rsv.VibrationDetector(TIMING, method="bands", tones=1)))
    assert (detector.options.method, detector.options.tones) == ("bands", 1)
    expected = detector(frames[0]).vibration
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(detector(frames[0]).vibration.amplitude, expected.amplitude)


def test_only_deterministic_algorithms_are_used(blur, vibration):
    """Forward and backward passes run with ``use_deterministic_algorithms`` and are reproducible."""
    torch.use_deterministic_algorithms(True)
    try:
        for name, module, (frames, *rest) in modules(blur, vibration):
            gradients = []
            for _ in range(2):
                images = frames.clone().requires_grad_()
                module(images, *rest).square().sum().backward()
                gradients.append(images.grad)
            assert torch.equal(*gradients), name
    finally:
        torch.use_deterministic_algorithms(False)


def test_compiled_models_have_one_graph_break(blur, vibration):
    """The model is compiled before and after each module; the module itself is not compiled."""
    frames = torch.rand(2, 1, 48, 40, generator=torch.Generator().manual_seed(2))
    restorer = rsv.VibrationRestorer(TIMING, method="dewarp", check=False)
    motion = vibration[0]

    def blurred(images):
        return blur(images * 2) + 1

    def restored(images):
        return restorer(images * 2, motion) + 1

    for model in (blurred, restored):
        torch.compile(model, backend="eager")(frames)  # the first call has one more graph break for preparation
        torch._dynamo.reset()
        explained = torch._dynamo.explain(model)(frames)
        assert (explained.graph_count, explained.graph_break_count) == (2, 1)
        assert torch.equal(torch.compile(model, backend="eager")(frames), model(frames))


class Stacks(torch.utils.data.Dataset):
    """Stacks that are detected and restored in the process that loads them."""

    def __init__(self, frames):
        self.frames = frames
        self.detector = rsv.VibrationDetector(TIMING, method="bands", tones=1)
        self.restorer = rsv.VibrationRestorer(TIMING, method="dewarp")

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        return self.restorer(self.frames[index], self.detector(self.frames[index]).vibration)


def test_workers_equal_the_main_process(frames):
    data = Stacks(frames)
    loader = torch.utils.data.DataLoader(data, batch_size=2, num_workers=2)
    torch.testing.assert_close(next(iter(loader)), torch.stack([data[0], data[1]]), rtol=0, atol=1e-6)


@pytest.mark.parametrize("method", [*METHODS, "richardson-lucy"])
def test_gradients_reach_frames_and_vibration(method):
    """Against central differences, in float64."""
    generator = torch.Generator().manual_seed(5)
    frames = torch.nn.functional.avg_pool2d(torch.rand(1, 2, 52, 44, generator=generator, dtype=torch.float64), 5, 1)[0]
    values = torch.tensor([[1.3, 2.1], [130.0, 90.0], [0.4, 1.3]], dtype=torch.float64)
    fixed = {"exact": {"noise": 0.01}, "banded": {"noise_to_signal": 0.01}}.get(method, {})
    restorer = rsv.VibrationRestorer(TIMING, method=method, check=False, **fixed)

    def restored(images, numbers):
        return restorer(images, rsv.Vibration(*numbers))

    inputs = (frames.requires_grad_(), values.requires_grad_())
    assert torch.autograd.gradcheck(restored, inputs, eps=1e-5, fast_mode=True)
    assert torch.autograd.grad(restored(*inputs).square().sum(), values)[0].abs().min() > 0
