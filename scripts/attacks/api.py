"""Calls of the Python interface with hostile arguments.

Every public function, class, module and method has a valid call here. Each trial replaces one or two arguments by
values of other types, extreme numbers, or damaged tensors, and must end with a result or with an exception that names
the argument. A name of ``rsvib_torch.__all__`` without a valid call raises an error.
"""

import copy
import inspect
import math
import os
import random
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from attacks.files import BANDS, DETECTION
from attacks.trial import Trial
from attacks.warm import in_warm_child
from torch import Tensor

import rsvib_torch as rsv

SECONDS, MEMORY = 10.0, 2 << 30  # limits of one trial; bytes in addition to those of the valid calls
_NOT_CALLED = {"RestorationWarning", "TimingWarning"}  # categories of warnings
_OF_THE_PACKAGE = {"codes", "from_parameters", "mapped"}  # methods that only the package calls


@dataclass(frozen=True)
class Call:
    """A valid call: ``of(**arguments)``; methods of the result are called without further arguments."""

    of: Callable[..., Any]
    arguments: Mapping[str, Any]


def _with_fields(value: Any) -> Call:
    """The constructor of a dataclass with the values of an object."""
    names = [field.name for field in fields(value) if field.init]
    return Call(type(value), {name: getattr(value, name) for name in names})


def _methods(value: Any, **arguments: Any) -> dict[str, Call]:
    """All public methods of an object whose arguments are known by name."""
    calls, arguments = {}, {"results": [value, value], **arguments}
    for name, method in inspect.getmembers(value, callable):
        of_package = str(getattr(method, "__module__", "")).startswith("rsvib_torch")
        if name.startswith("_") or name in _OF_THE_PACKAGE or not of_package:
            continue
        parameters = inspect.signature(method).parameters
        known = {key: arguments[key] for key in parameters if key in arguments}
        needed = [key for key, one in parameters.items() if one.default is one.empty and one.kind < one.VAR_KEYWORD]
        if any(key not in known for key in needed if parameters[key].kind is not parameters[key].VAR_POSITIONAL):
            raise LookupError(f"{type(value).__name__}.{name}: no value for {set(needed) - set(known)}")
        calls[f"{type(value).__name__}.{name}"] = Call(method, known)
    return calls


@cache
def calls(folder: Path) -> dict[str, Call]:  # noqa: PLR0915 - values of all parameters
    """Valid calls of everything in ``rsvib_torch.__all__``, by name."""
    folder.mkdir(parents=True, exist_ok=True)
    generator = torch.Generator("cpu").manual_seed(0)
    timing = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=104, frame_start_times=(0.0, 0.0104, 0.021))
    vibration = rsv.Vibration([1.2, 0.8], [130.0, 170.0], [0.3, 0.9], image_motion=(5.0, 3.0))
    noise = torch.randn(1, 1, 160, 128, generator=generator, dtype=torch.float64)
    scene = 0.5 + 0.2 * torch.nn.functional.avg_pool2d(noise, 3, 1, 1)[0, 0].to(torch.float32)
    frames = rsv.simulate_frames(scene, timing, vibration, 3, frame_size=(96, 64))
    detected = rsv.detect_vibration(frames, timing, **DETECTION)
    free = rsv.detect_motion(frames, timing, **BANDS)
    restored = rsv.restore(frames, timing, vibration, method="dewarp", check=False)
    rows, columns = torch.meshgrid(torch.arange(64.0), torch.arange(48.0), indexing="ij")
    edge = torch.sigmoid((columns - 24 - 0.1 * (rows - 32)) / 0.7) * 0.6 + 0.2
    image = edge.repeat(2, 3)
    curve = rsv.slanted_edge_mtf(edge)
    times = torch.linspace(-0.01, 0.05, 121, dtype=torch.float64)
    path = torch.stack([0.5 * torch.sin(800 * times), 0.3 * torch.cos(700 * times)], -1)
    recorded = rsv.FreeMotion.through(times, path)
    stripes = torch.stack([0.5 + 0.3 * torch.sin(rows[:, :1] * 0.5 + phase).expand(-1, 32) for phase in (0.0, 1.0)])
    stack, motion_file = folder / "frames.npy", folder / "motion.csv"
    rsv.write_stack(stack, frames, dtype="float32")
    video = folder / "frames.mkv"
    of_video = rsv.StackInfo(tuple(frames.shape), "uint8", 255.0, frame_rate=96.0)
    rsv.write_stack(video, frames.clamp(0, 1), dtype="uint8", like=of_video)
    lines = [f"{t:.9g},{x:.9g},{y:.9g}" for t, (x, y) in zip(times.tolist(), path.tolist(), strict=True)]
    motion_file.write_text("\n".join(["time,x,y", *lines]))
    rates_file = folder / "rates.csv"
    rates_file.write_text("\n".join(["time,gx_rad_s,gy_rad_s,gz_rad_s", *(f"{line},0" for line in lines)]))
    rates = rsv.read_gyroscope(rates_file)
    unit = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    pairs = torch.zeros(2, 3, dtype=torch.float64)
    values = (0.0, 1e-4, 1.0, 1e-4, unit, unit, 500.0, 1.0, 1e-4, 1e-6, pairs, unit, 0.01, unit[:2])
    rotation = rsv.RotationAlignment(recorded, "YxZ", *values, pairs, pairs, True, ())
    detected.save(folder / "vibration.json")
    options: dict[str, Any] = {"detection": DETECTION, "restoration": {"method": "dewarp"}}
    options |= {"full_scale": None, "force": False, "device": "cpu"}
    windows = {"window": 3, "memory": "1GB", "workers": 1, **options}
    rsv.process_stack(stack, folder / "out.npy", timing, **windows)
    manifest = rsv.read_manifest(folder / "out.npy.manifest.json")
    psf = rsv.row_psf(vibration, timing.row_starts(1, 96)[0], timing)
    blur = rsv.RowVaryingBlur(psf)
    random_tones = {"amplitude": (0.5, 2.0), "frequency": (40.0, 200.0)}
    augmentation = rsv.RollingShutterVibration(timing, **random_tones)
    detector = rsv.VibrationDetector(timing, **DETECTION)
    restorer = rsv.VibrationRestorer(timing, method="dewarp", check=False)
    verdict = rsv.judge_restoration(frames, restored, timing, vibration)
    optics, sensor_noise = rsv.Optics(0.5, 0.4, 1.0), rsv.SensorNoise(5000.0, 0.01, 12, 0.01, 0.01, 0.01, 3)
    calibration = rsv.RowTimeCalibration(1e-4, 1e-6, 12.0, 0.3, 1000.0, 104.0, "forward", ())
    info = rsv.read_stack_info(stack)
    figure = rsv.motion_figure(vibration)
    tracker = rsv.VibrationTracker(rsv.SensorTiming(1e-4, 6, 104), window=2)
    tracked = [tracker.update(frame) for frame in frames][-1]
    camera = rsv.Camera(300.0, (3.0, -2.0), (-0.1, 0.02, 1e-3, -2e-3, 0.0))
    components = torch.zeros(2, 3, dtype=torch.float64)
    # values of the parameters of all functions and methods, by name
    pool: dict[str, Any] = {"frames": frames, "timing": timing, "vibration": vibration, "motion": recorded, **BANDS}
    pool |= {"recorded": recorded, "offsets": (-0.001, 0.001), "camera": camera, "info": info, "manifest": manifest}
    pool |= {"detected": detected, "detection": detected, "result": detected, "detections": [detected]}
    pool |= {"restored": restored, "figure": figure, "psf": psf, "measured": path, "curves": {"raw": [curve]}}
    pool |= {"scene": scene, "noise": sensor_noise, "image": image, "reference": image, "roi": edge, "rim": 4}
    pool |= {"times": times, "starts": times, "later_starts": times + 0.01, "start": times, "end": times + 0.01}
    pool |= {"exposure_time": 6e-4, "duration": 6e-4, "interval": 0.0104, "first": 0.0, "last": 0.03, "highest": 500.0}
    pool |= {"order": [1, 0], "signs": [1.0, -1.0], "device": "cpu", "path": stack, "offset": 0.001, "scale": 1.0}
    pool |= {"gain": (1.0, 1.0), "factor": 1.5, "displacement": path, "spacing": 5e-4, "motions": [recorded, recorded]}
    pool |= {"vibrations": [vibration, vibration], "axes": 3, "components": components, "batch_shape": (2,)}
    pool |= {"frequency": torch.tensor([0.1, 0.2], dtype=torch.float64), "num_rows": 96, "num_frames": 3}
    pool |= {"height": 24, "width": 16, "u": times * 10, "v": times * 10, "input": frames[:, None], "size": (96, 64)}
    pool |= {"count": 2, "shape": (3, 96, 64), "dtype": "float32", "frame": frames[0].numpy(), "x": scene}
    pool |= {"y": frames[0], "scene_shape": (160, 128), "tones": None, "flicker_frequency": 1000.0, "raw": frames[0]}
    pool |= {"place": torch.zeros(2), "delays": [0.0, 0.04], "data_range": 1.0, "source": stack}
    pool |= {"row_time": 1e-4, "pixel_size": 5e-6, "frame_rate": 30.0}

    def call(function: Callable[..., Any], **others: Any) -> Call:
        """A valid call: all parameters, with these values, those of the pool, or their defaults."""
        known = {
            name: others.get(name, pool.get(name, one.default))
            for name, one in inspect.signature(function).parameters.items()
            if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
        }
        return Call(function, others | {name: value for name, value in known.items() if value is not inspect._empty})

    fast = {"method": "bands", "tones": 1}
    new = {name: folder / name for name in ("new.npy", "new.mkv", "figure.png", "maps")}
    different: dict[str, dict[str, Any]] = {  # values that differ from the pool, by function
        "align_motion": {"camera": None, "recorded": rates},
        "calibrate_row_time": {"frames": stripes},
        "calibrate_row_time_by_motion": {"row_time": (5e-5, 2e-4)},
        "comparison_figure": {"size": 32, "restored": restored[0]},
        "detect_motion": {"iterations": 1},
        "detect_vibration": fast,
        "motion_figure": {"motion": vibration, "last": 0.1},
        "process_stack": {"sink": new["new.npy"], **windows},
        "process_video": {"source": video, "sink": new["new.mkv"], "restoration": {"method": "dewarp"}},
        "psnr": {"image": restored, "reference": frames},
        "read_gyroscope": {"path": rates_file},
        "read_manifest": {"path": folder / "out.npy.manifest.json"},
        "read_motion": {"path": motion_file, "unit": "rad", "focal_length": 100.0},
        "read_vibration": {"path": folder / "vibration.json"},
        "row_psf": {"starts": timing.row_starts(1, 96)[0]},
        "save_figure": {"path": new["figure.png"], "dpi": 20},
        "simulate_frames": {"frame_size": (64, 48), "num_frames": 2, "generator": generator},
        "ssim": {"image": restored, "reference": frames},
        "windows_figure": {"times": [0.0]},
        "write_offsets": {"path": folder / "offsets.csv"},
        "write_stack": {"path": folder / "written.tif", "like": info},
        "write_table": {"path": folder / "tones.csv"},
    }
    functions = {name: getattr(rsv, name) for name in rsv.__all__ if inspect.isfunction(getattr(rsv, name))}
    result = {name: call(function, **different.get(name, {})) for name, function in functions.items()}
    result["detect_vibration direct"] = call(rsv.detect_vibration)
    for method in ("phase", "projection"):
        result[f"register_bands {method}"] = call(rsv.register_bands, method=method)
    methods: dict[str, dict[str, Any]] = {
        "exact": {"joint": False, "prior": "gaussian", "noise": "auto", "regularisation": 1.0},
        "banded": {"half_rows": 8, "noise_to_signal": "auto"},
        "dewarp": {"vibration": detected},
        "richardson-lucy": {"iterations": 2},
    }
    for method, chosen in methods.items():
        result[f"restore {method}"] = call(rsv.restore, method=method, check=method == "exact", **chosen)
    augmentation(frames[:, None])
    constructed: dict[str, Call] = {
        "FixedDewarp": call(rsv.FixedDewarp, num_frames=3),
        "FreeMotion": call(rsv.FreeMotion, coefficients=recorded.coefficients, start=0.0, tones=vibration),
        "RollingShutterVibration": call(rsv.RollingShutterVibration, **random_tones, exposure_rows=(4.0, 8.0), tones=1),
        "RowVaryingBlur": call(rsv.RowVaryingBlur, frame_width=64, origin=(4, 4), scene_size=(160, 128)),
        "SensorTiming": _with_fields(timing),
        "Vibration": call(rsv.Vibration, amplitude=[1.2, 0.8], frequency=[130.0, 170.0], image_motion=(5.0, 3.0)),
        "VibrationDetector": call(rsv.VibrationDetector, **fast),
        "VibrationRestorer": call(rsv.VibrationRestorer, joint=False),
        "VibrationTracker": call(rsv.VibrationTracker, timing=rsv.SensorTiming(1e-4, 6, 104)),
    }
    result |= constructed
    modules = {"VibrationDetector": detector, "VibrationRestorer": restorer, "RollingShutterVibration": augmentation}
    for name, module in modules.items():
        result[f"{name}.forward"] = call(module.forward)
    result["FixedDewarp.forward"] = Call(rsv.FixedDewarp(timing, vibration, (96, 64), 3).forward, {"frames": frames})
    result["RollingShutterVibration.drawn_vibration"] = call(augmentation.drawn_vibration)
    report = rsv.process_stack(stack, folder / "again.npy", timing, **windows)
    described = (detected.std, curve, optics, sensor_noise, info, report, verdict, calibration, camera)
    described += (tracked,)
    described += (detected.spectrum(), rsv.CameraMode("A", "B", "", 1920, 1080, 30.0, 0.01, 1e-4, 3, "forward"))
    described += (detected, detected.offsets, free, rates, rotation)
    for value in described:
        result[type(value).__name__] = _with_fields(value)
    for value in (vibration, recorded, timing, *described):
        result |= _methods(
            value, **pool | {"path": folder / "out.json", "size": 2, "count": 3, "mosaic": "RGGB", "origin": 0.1}
        )
    for name, given in (("forward", "scene"), ("A", "x"), ("A_adjoint", "y")):
        result[f"RowVaryingBlur.{name}"] = Call(getattr(blur, name), {given: pool[given]})
    for name in ("displacement", "factors", "rays"):
        result[f"Camera.{name}"] = call(getattr(camera, name), x=times[:2], y=times[2:4])
    missing = set(rsv.__all__) - _NOT_CALLED - {name.partition(" ")[0] for name in result}
    if missing:
        raise LookupError(f"no valid call of {', '.join(sorted(missing))}")
    return result


def _expressions(text: str) -> list[str]:
    return text.strip().replace("\n", " | ").split(" | ")


# Hostile values: expressions, which are evaluated for each trial and name it; ``t`` is the valid tensor.
_VALUES = _expressions(r"""
0 | -1 | math.nan | math.inf | -math.inf | 1e300 | -1e300 | 5e-324 | 1e-40 | 1e308 | 1e9 | 10**9 | 10**30 | 2**63
-10**30 | 0.5 | True | np.int64(3) | np.float32(np.nan) | None | 'nonsense' | '' | 'a\0b' | 'x' * 100_000 | b'\xff\x00'
1 + 2j | object() | [] | [[1, [2, 3]], 'x'] | {'a': 1} | {1, 2} | len | rsv.Vibration | [[1.0], [1.0, 2.0]]
[None, None] | [math.nan, math.nan] | [1e300, 1e300] | [0, 0] | [-1, -1] | [10**9, 10**9] | [2, 2, 2] | (2, 3, 4, 5, 6)
(number for number in (1.0, 2.0)) | torch.zeros(0) | torch.tensor(2.0) | torch.zeros((), device='meta') | '/'
'/dev/zero' | b'/tmp/x' | '/tmp/' + 'x' * 5000 | rsv.Vibration.still() | rsv.Vibration.still((4,))
rsv.Vibration(1e5, 50.0) | rsv.Vibration(1.0, 1e8) | rsv.Vibration(1.0, 50.0, image_motion=(1e5, 1e5))
rsv.Vibration(torch.tensor([1.0, 1.0], requires_grad=True), 50.0) | rsv.SensorTiming(1e-9, 1.0, 104.0)
rsv.SensorTiming(1e-4, 1.0, 10.0) | rsv.SensorTiming(1e-4, 6, 104, frame_start_times=[0.0])
rsv.SensorTiming(1e-4, 6, 104, frame_start_times=[1e9, 1e9 + 1, 1e9 + 2])
rsv.SensorTiming(1e-4, 6, 104, scan_axis='x', readout_direction='reverse')
""")
_TENSORS = _expressions(r"""
t.to('meta') | t.to_sparse() | t.flatten(0, -2).to_sparse_csr() if t.ndim > 1 else t.to_sparse()
torch.nested.nested_tensor([t.float(), t.float()[:1]])
torch.nested.nested_tensor([t.float(), t.float()[:1]], layout=torch.jagged)
torch.quantize_per_tensor(t.float(), 0.01, 0, torch.quint8) | t.to(torch.complex64) | t > 0.5
(100 * t).nan_to_num().to(torch.int64) | (100 * t.abs()).nan_to_num().to(torch.uint32)
(100 * t.abs()).nan_to_num().to(torch.uint16) | t.half() | t.bfloat16() | t.float().to(torch.float8_e4m3fn)
t.double() | t.float().requires_grad_() | torch.full_like(t, math.inf, dtype=torch.float32)
torch.full_like(t, math.nan, dtype=torch.float32)
t.float().flatten().index_fill(0, torch.tensor([t.numel() // 2]), math.nan).reshape(t.shape)
t.float().flatten().index_fill(0, torch.tensor([t.numel() // 2]), math.inf).reshape(t.shape) | t.float() * 1e38
torch.full_like(t, 3e38, dtype=torch.float32) | t.double() * 1e300 | t.float() * 1e-40 | t.double() * 1e-300
torch.zeros_like(t) | -t.float() | t[:0] | t[..., :0] | t[:1] | t[..., :1] | t[None, None, None]
t[0] if t.ndim else t | t.transpose(0, -1) if t.ndim else t | t[:1].expand(t.shape) | t.numpy()[..., ::-1]
t.numpy().astype(object) | np.ma.masked_invalid(t.numpy()) | t.numpy().astype(str)
(1000 * t.numpy()).astype('datetime64[s]') | np.zeros(tuple(t.shape), dtype=[('a', 'f4'), ('b', 'f4')])
t.numpy().astype(np.float16) | t.numpy().astype(np.longdouble) | t.numpy().astype('>f8')
np.broadcast_to(t.numpy()[:1], t.shape) | list(t) | [t, t[:1]] | torch.nn.Parameter(t.float())
""")


def _candidates(value: Any) -> list[str]:
    """The hostile values for an argument with this valid value."""
    of_tensor = isinstance(value, (Tensor, np.ndarray))  # damaged tensors are most likely to pass the first checks
    return _VALUES + (_TENSORS * 2 if of_tensor else [])


def _hostile(expression: str, value: Any) -> Any:
    names = {"math": math, "np": np, "rsv": rsv, "torch": torch}
    if expression in _TENSORS:
        names["t"] = torch.as_tensor(value).detach().clone()
    return eval(expression, names)


def _nan_without_reason(result: Any) -> bool:
    """Whether a result that claims to be reliable is not finite."""
    reliable = getattr(result, "reliable", None)
    vibration = getattr(result, "vibration", None)
    if not isinstance(reliable, Tensor) or vibration is None:
        return False
    values = torch.cat([vibration.amplitude, vibration.frequency, vibration.phase], -1)
    return bool((reliable & ~torch.isfinite(values).all(-1)).any())


Item = tuple[str, tuple[tuple[str, str], ...]]


def _name(item: Item) -> str:
    return f"{item[0]}({', '.join(f'{argument}={hostile}' for argument, hostile in item[1])})"


def prepare(folder: Path) -> None:
    """Hostile relative paths must not reach the working directory of the program."""
    folder.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    calls(folder / "valid")


def attempt(folder: Path, item: Item) -> str:
    """One call with hostile arguments."""
    name, changes = item
    call = calls(folder / "valid")[name]
    place = folder / "trial"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    arguments = {
        key: place / value.name
        if (isinstance(value, Path) and not value.exists()) or (key in ("sink", "manifest") and isinstance(value, Path))
        else value
        for key, value in call.arguments.items()
    }
    try:
        arguments |= {argument: _hostile(kind, call.arguments[argument]) for argument, kind in changes}
    except Exception as error:  # PyTorch or the package cannot make this value
        raise ValueError(f"not made: {type(error).__name__}") from error
    torch.manual_seed(0)
    before = {key: copy.deepcopy(value) for key, value in arguments.items() if isinstance(value, np.ndarray)}
    result = call.of(**arguments)
    str(result) if type(result).__module__.startswith("rsvib_torch") else None
    if _nan_without_reason(result):
        return "reliable, but not finite"
    changed = (key for key, value in before.items() if not _equal(value, arguments[key]))
    return next((f"{key} was changed" for key in changed), "")


def _equal(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether an array of numbers is unchanged; other arrays are not compared."""
    kind = before.dtype.kind
    return kind not in "biuf" or np.array_equal(before, after, equal_nan=kind == "f")


def items(known: Mapping[str, Call], count: int, seed: int) -> list[Item]:
    """Trials: every argument in turn with the next of its hostile values, then two arguments at a time."""
    choice = random.Random(seed)
    queues = {
        (name, argument): choice.sample(names := list(dict.fromkeys(_candidates(value))), len(names))
        for name, call in known.items()
        for argument, value in call.arguments.items()
    }
    singles: list[Item] = []
    while any(queues.values()):
        singles += [(name, ((argument, queue.pop()),)) for (name, argument), queue in queues.items() if queue]
    pairs: list[Item] = []
    wide = [name for name, call in known.items() if len(call.arguments) > 1]
    for _ in range(count):
        name = choice.choice(wide)
        two = choice.sample(list(known[name].arguments.items()), 2)
        pairs.append((name, tuple((argument, choice.choice(_candidates(value))) for argument, value in two)))
    part = min(len(singles), -(-3 * count // 4))
    return (singles[:part] + pairs)[:count]


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Trials of hostile calls, three quarters of them with one hostile argument."""
    torch.set_num_threads(1)
    chosen = items(calls(folder / "listed" / "valid"), count, seed)
    named = [(_name(item), item) for item in chosen]
    yield from in_warm_child(attempt, named, folder / "child", limit=SECONDS, memory=MEMORY, prepare=prepare)
