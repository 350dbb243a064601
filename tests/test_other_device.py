"""Computations stay on the device of their tensors: tested on a simulated GPU."""

import threading
from dataclasses import replace

import pytest
import torch
from simulated_gpu import SIMULATED_GPU, DeviceError, SimulatedGpuTensor, simulated_gpu

import rsvib_torch as rsv
from rsvib_torch.execution.parallel import full_precision

SIZE = 128
TIMING = rsv.SensorTiming(row_time=20.52e-6 * 16, exposure_rows=2, frame_rows=SIZE)
LONG = replace(TIMING, exposure_rows=24)
SHAKE = rsv.Vibration([1.6, 2.1], [50.0, 30.0], [0.4, 1.1])
FREE = rsv.FreeMotion(torch.zeros(2, 40), 0.0, 0.01, SHAKE)
TOLERANCE = 1e-4  # of full scale


def frames(timing=TIMING):
    size = int(timing.frame_rows)
    generator = torch.Generator().manual_seed(3)
    texture = torch.rand(1, 1, size // 4, size // 4, generator=generator)
    scene = torch.nn.functional.interpolate(texture, (size + 64, size + 64), mode="bicubic")[0, 0]
    taken = rsv.simulate_frames(scene, timing, SHAKE, 2, frame_size=(size, size))
    return (taken + 0.003 * torch.randn(taken.shape, generator=generator)).clamp(0.0, 1.0)


def with_missing(images):
    images = images.clone()
    images[0, 30:38, 40:60] = torch.nan
    return images


def numbers(result):
    """All tensors of a result, by name."""
    if isinstance(result, torch.Tensor):
        return {"": result}
    if isinstance(result, tuple | list):
        return {f"{i}{name}": value for i, part in enumerate(result) for name, value in numbers(part).items()}
    named = vars(result) if hasattr(result, "__dict__") else {}
    return {f".{key}{name}": value for key, part in named.items() for name, value in numbers(part).items()}


def gradient(images, timing):
    images = images.detach().clone().requires_grad_(True)
    restored = rsv.restore(images, timing, SHAKE, check=False)
    return torch.autograd.grad(restored.square().sum(), images)[0]


def gradient_of_motion(images, timing):
    amplitude = SHAKE.amplitude.clone().requires_grad_(True)
    motion = rsv.Vibration(amplitude, SHAKE.frequency, SHAKE.phase)
    restored = rsv.restore(images, timing, motion, check=False)
    (found,) = torch.autograd.grad(restored.square().sum(), amplitude)
    return found.to(images.device)


def blurred_and_back(images, timing):
    psf = rsv.row_psf(SHAKE.to(images.device), timing.row_starts(1, images.shape[-2], images.device)[0], timing)
    blur = rsv.RowVaryingBlur(psf)
    return blur.A(images), blur.A_adjoint(images)


def augmented(images, timing):
    torch.manual_seed(5)
    shake = rsv.RollingShutterVibration(timing, amplitude=(1.0, 2.0), frequency=(30.0, 60.0), p=1.0)
    return shake(images[:, None])


WORK = {
    "detect": lambda images, timing: rsv.detect_vibration(images, timing).vibration,
    "detect, long exposures": lambda images, timing: rsv.detect_vibration(images, timing).vibration,
    "detect, bands": lambda images, timing: rsv.detect_vibration(images, timing, method="bands").vibration,
    "phase": lambda images, timing: rsv.register_bands(images, timing, method="phase"),
    "detect, holes": lambda images, timing: rsv.detect_vibration(with_missing(images), timing).vibration,
    "detect, batch": lambda images, timing: (
        rsv.detect_vibration(images[None, :, None].expand(2, -1, -1, -1, -1), timing).vibration
    ),
    "free": lambda images, timing: rsv.detect_motion(images, timing).motion,
    "exact": lambda images, timing: rsv.restore(images, timing, SHAKE),
    "exact, long exposures": lambda images, timing: rsv.restore(images, timing, SHAKE),
    "joint": lambda images, timing: rsv.restore(images, timing, SHAKE, joint=True),
    "edges": lambda images, timing: rsv.restore(images, timing, SHAKE, prior="edges"),
    "holes": lambda images, timing: rsv.restore(with_missing(images), timing, SHAKE),
    "saturated": lambda images, timing: rsv.restore(images.clamp(max=0.6), timing, SHAKE, saturation=0.6),
    "dewarp": lambda images, timing: rsv.restore(images, timing, SHAKE, method="dewarp"),
    "module": lambda images, timing: rsv.VibrationRestorer(timing, method="dewarp")(images, SHAKE),
    "module, motion of the CPU": lambda images, timing: rsv.VibrationRestorer(timing, method="dewarp")(images, FREE),
    "richardson-lucy": lambda frames, timing: rsv.restore(
        frames, timing, SHAKE, method="richardson-lucy", iterations=5
    ),
    "gradient": gradient,
    "gradient of the motion": gradient_of_motion,
    "blur": blurred_and_back,
    "augmentation": augmented,
    "simulate": lambda images, timing: rsv.simulate_frames(images[0], timing, SHAKE, 2, frame_size=(64, 64)),
    "register": rsv.register_bands,
    "judge": lambda images, timing: rsv.judge_restoration(images, images.clone(), timing, SHAKE).misfit_before,
}


@pytest.mark.filterwarnings("ignore::rsvib_torch.RestorationWarning")
@pytest.mark.parametrize("name", WORK)
def test_results_stay_on_the_device_and_are_those_of_the_cpu(name):
    timing = LONG if "long" in name else TIMING
    images = frames(timing)
    here = numbers(WORK[name](images, timing))
    with simulated_gpu():
        there = numbers(WORK[name](images.to(SIMULATED_GPU), timing))
    assert here
    assert here.keys() == there.keys()
    for key, expected in here.items():
        assert isinstance(there[key], SimulatedGpuTensor), f"{key} came back to the CPU"
        found = there[key].as_subclass(torch.Tensor)
        scale = max(1.0, float(expected.detach().double().nan_to_num().abs().amax()))
        torch.testing.assert_close(found, expected, rtol=0.0, atol=TOLERANCE * scale, equal_nan=True)


@pytest.mark.filterwarnings("ignore::rsvib_torch.RestorationWarning")
@pytest.mark.parametrize("name", ["exact", "dewarp", "richardson-lucy", "gradient", "register"])
def test_synchronisations_do_not_grow_with_the_rows(name):
    def count_synchronisations(size):
        timing = replace(TIMING, frame_rows=size)
        images = frames(timing)
        with simulated_gpu() as device:
            WORK[name](images.to(SIMULATED_GPU), timing)
        return sum(device.synchronisations.values())

    assert count_synchronisations(256) <= count_synchronisations(128) + 4


REFUSED = {
    "sum": lambda here, there: here + there,
    "in place": lambda here, there: there.add_(here),
    "numbers in a stack": lambda here, there: torch.stack([here.sum(), there.sum()]),
    "NumPy": lambda here, there: there.numpy(),
    "generator": lambda here, there: torch.rand(3, device=there.device, generator=torch.Generator()),
}


@pytest.mark.parametrize("name", REFUSED)
def test_the_simulated_device_refuses_what_a_gpu_refuses(name):
    here = torch.arange(4.0)
    with simulated_gpu(), pytest.raises(DeviceError):
        REFUSED[name](here, here.to(SIMULATED_GPU))


def formats():
    backends = (torch.backends.cuda.matmul, torch.backends.cudnn.conv, torch.backends.mkldnn.matmul)
    return [backend.fp32_precision for backend in backends]


# PyTorch 2.9 warns where the earlier and the newer names of these settings are used together
MIXED_NAMES = pytest.mark.filterwarnings("ignore:Please use the new API settings:UserWarning")


@pytest.fixture
def short_products():
    """Allow float32 products in formats of lower precision."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    yield
    torch.set_float32_matmul_precision(before)


@MIXED_NAMES
def test_products_have_full_precision_and_settings_are_restored(short_products):
    allowed = formats()
    assert allowed != ["ieee"] * 3
    assert full_precision(formats)() == ["ieee"] * 3
    assert formats() == allowed

    def fails():
        raise RuntimeError

    with pytest.raises(RuntimeError):
        full_precision(fails)()
    assert formats() == allowed
    assert torch.get_float32_matmul_precision() == "medium"


@MIXED_NAMES
def test_overlapping_threads_restore_the_settings(short_products):
    allowed, begun, ended = formats(), threading.Event(), threading.Event()

    def long():
        begun.set()
        ended.wait(10)
        return formats()

    found = []
    thread = threading.Thread(target=lambda: found.append(full_precision(long)()))
    thread.start()
    begun.wait(10)
    assert full_precision(formats)() == ["ieee"] * 3
    ended.set()
    thread.join()
    assert found == [["ieee"] * 3]
    assert formats() == allowed
