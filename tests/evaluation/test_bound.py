import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

import rsvib_torch as rsv
from rsvib_torch.evaluation.bound import Recording, cramer_rao_bound, projected_information
from rsvib_torch.numerics.splines import bspline_coefficients

TIMING = rsv.SensorTiming(row_time=160e-6, exposure_rows=3, frame_rows=300)
FIELDS = ("amplitude", "frequency", "period", "phase", "image_motion")


def smooth_scene(height, width, seed=0, highest=0.2):
    """Noise without frequencies above ``highest`` cycles per px."""
    generator = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(generator.standard_normal((height, width)))
    v, u = np.meshgrid(np.fft.fftfreq(height), np.fft.rfftfreq(width), indexing="ij")
    radius = np.hypot(u, v)
    spectrum *= np.exp(-((radius / (0.6 * highest)) ** 2)) * (radius < highest)
    scene = np.fft.irfft2(spectrum, s=(height, width))
    return 0.5 + 0.12 * scene / scene.std()


# --- independent dense model: matrices from spline coefficients to the pixels of the frames -------------------------

DENSE_TIMING = rsv.SensorTiming(row_time=400e-6, exposure_rows=3, frame_rows=50)
HEIGHT, WIDTH, EDGE, NODES = 36, 8, 12, 24
RIDGE = 1e-10  # of the largest element of the normal matrix
TRUTH = {"ax": 0.7, "fx": 43.0, "px": 0.4, "ay": 0.9, "fy": 31.0, "py": 1.1, "vx": 6.0, "vy": -9.0}


def displacement(times, axis, values):
    a, f, p, v = (values[name + axis] for name in "afpv")
    return a * np.sin(2 * np.pi * f * times + p) + v * times


def dense_operator(values, num_frames):
    """Matrix from spline coefficients (rows x WIDTH, periodic along rows) to frames, exposures as midpoint sums."""
    basis = BSpline.basis_element(np.arange(15) - 7.0, extrapolate=False)
    turn = np.fft.fftfreq(WIDTH)
    dft = np.fft.fft(np.eye(WIDTH), axis=0)
    scene_rows = HEIGHT + 2 * EDGE
    operator = np.zeros((num_frames, HEIGHT, WIDTH, scene_rows, WIDTH))
    for p in range(num_frames):
        for r in range(HEIGHT):
            start = (p * DENSE_TIMING.frame_rows + r) * DENSE_TIMING.row_time
            times = start + (np.arange(NODES) + 0.5) / NODES * DENSE_TIMING.exposure_time
            x, y = displacement(times, "x", values), displacement(times, "y", values)
            taps = np.nan_to_num(basis((EDGE + r - y)[:, None] - np.arange(scene_rows))) / NODES
            ramps = np.exp(-2j * np.pi * x[:, None] * turn)
            kernels = (taps.T[:, :, None] * ramps[None]).sum(1)  # (scene rows, frequencies)
            for k in np.flatnonzero(taps.any(0)):
                operator[p, r, :, k] = (dft.conj().T / WIDTH @ (kernels[k][:, None] * dft)).real
    return operator.reshape(num_frames * HEIGHT * WIDTH, -1)


def dense_information(coefficients, num_frames, explain):
    """Information in the derivatives of the frames after projection onto the complement of the scene."""
    order = ("ax", "fx", "px", "vx", "ay", "fy", "py", "vy")
    derivatives = []
    for name in order:
        step = 1e-4 * max(1.0, abs(TRUTH[name]))
        up, down = (dense_operator({**TRUTH, name: TRUTH[name] + s}, num_frames) for s in (step, -step))
        derivatives.append((up - down) @ coefficients / (2 * step))
    derivatives = np.stack(derivatives, axis=1)
    operator = dense_operator(TRUTH, num_frames)
    # columns are periodic; only those within the frame are used
    times = (np.arange(num_frames)[:, None] * DENSE_TIMING.frame_rows + np.arange(HEIGHT)) * DENSE_TIMING.row_time
    x, y = (displacement(times + 0.5 * DENSE_TIMING.exposure_time, axis, TRUTH) for axis in "xy")
    window = np.zeros((num_frames, HEIGHT, WIDTH))
    for p, r, q in np.ndindex(num_frames, HEIGHT, num_frames):
        found = np.interp(r - y[p, r], np.arange(HEIGHT) - y[q], np.arange(HEIGHT), left=-1, right=-1)
        if q != p and found >= 0:
            place = np.arange(WIDTH) - x[p, r] + np.interp(found, np.arange(HEIGHT), x[q])
            window[p, r] += (place >= 0) & (place <= WIDTH - 1)
    residual = (derivatives - operator @ explain(operator, derivatives)) * (window.reshape(-1, 1) > 0)
    return residual.T @ residual


def ridge(operator, derivatives):
    normal = operator.T @ operator
    small = RIDGE * normal.diagonal().max()
    return np.linalg.solve(normal + small * np.eye(len(normal)), operator.T @ derivatives)


def least_squares(operator, derivatives):
    return np.linalg.lstsq(operator, derivatives, rcond=RIDGE**0.5)[0]


@pytest.mark.parametrize(
    ("num_frames", "explain", "tolerance"), [(2, ridge, 5e-4), (2, least_squares, 1e-2), (3, ridge, 5e-4)]
)
def test_projection_equals_dense_algebra(num_frames, explain, tolerance):
    scene = torch.from_numpy(smooth_scene(HEIGHT + 2 * EDGE, WIDTH, seed=3))
    coefficients = bspline_coefficients(scene, 13, -2).numpy().ravel()
    motion = rsv.Vibration(*([TRUTH[name + axis] for axis in "xy"] for name in "afpv"))

    def sensitivity(times):
        """Derivatives of the displacement by amplitude, frequency, phase and image motion of both axes."""
        parts = []
        for axis in "xy":
            turn = 2 * np.pi * times
            angle = TRUTH["f" + axis] * turn + TRUTH["p" + axis]
            slope = TRUTH["a" + axis] * angle.cos()
            parts += [angle.sin(), slope * turn, slope, times]
        return torch.stack(parts)

    size, axes = (HEIGHT, WIDTH), (0, 0, 0, 0, 1, 1, 1, 1)
    recording = Recording(scene, DENSE_TIMING.in_row_order(), motion, num_frames, size, axes, sensitivity)
    found = projected_information(recording, margin=0).numpy()  # the scene is periodic
    expected = dense_information(coefficients, num_frames, explain)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() <= tolerance
    nothing = dense_information(coefficients, num_frames, lambda a, d: np.zeros((a.shape[1], 8)))
    share = np.diag(expected) / np.diag(nothing)
    assert share.max() < 0.96  # the scene explains a part of all parameters, and more than half of some
    assert share.min() < 0.5


def values_of(bound):
    return torch.cat([getattr(bound, name).flatten() for name in FIELDS])


@pytest.mark.parametrize("num_frames", [2, 3])
def test_closed_form_agrees_on_a_band_limited_scene(num_frames):
    scene = torch.from_numpy(smooth_scene(332, 112))
    motion = rsv.Vibration([1.3, 2.1], [50.0, 30.0], [0.4, 1.3], [20.0, -30.0])
    exact, closed = (
        values_of(cramer_rao_bound(scene, TIMING, motion, num_frames, noise=0.01, frame_size=(280, 64), method=method))
        for method in ("projection", "gradients")
    )
    assert ((closed / exact - 1).abs() < 0.04).all()


@pytest.mark.parametrize("method", ["projection", "gradients"])
def test_closed_form_of_a_wave_along_rows(method):
    # a wave along x with amplitude a measures x only: J = (2 pi u a)^2 W / 4 noise^2 sum d offset d offset'
    u, a, width, noise = 0.1, 0.2, 480, 0.01
    columns = np.arange(width + 40)
    scene = torch.from_numpy(np.tile(0.5 + a * np.sin(2 * np.pi * u * columns), (340, 1)))
    timing = rsv.SensorTiming(row_time=160e-6, exposure_rows=3, frame_rows=310)
    amplitude, frequency, phase = 1.2, 47.0, 0.7
    motion = rsv.Vibration([amplitude, 0.0], frequency, phase)
    bound = cramer_rao_bound(scene, timing, motion, noise=noise, frame_size=(300, width), method=method)

    def mean(values, starts):
        a, f, p, v = values
        exposure = timing.exposure_time
        middle = starts + 0.5 * exposure
        return a * np.sinc(f * exposure) * np.sin(2 * np.pi * f * middle + p) + v * middle

    def offset(values):
        starts = np.arange(300) * timing.row_time
        return mean(values, starts + timing.frame_period) - mean(values, starts)

    truth = np.array([amplitude, frequency, phase, 0.0])
    derivative = [(offset(truth + e) - offset(truth - e)) / 2e-5 for e in 1e-5 * np.eye(4)]
    information_ = (2 * np.pi * u * a / noise) ** 2 * width / 4 * (np.array(derivative) @ np.array(derivative).T)
    expected = np.sqrt(np.diag(np.linalg.inv(information_)))
    found = [bound.amplitude[0, 0], bound.frequency[0, 0], bound.phase[0, 0], bound.image_motion[0]]
    np.testing.assert_allclose([float(value) for value in found], expected, rtol=0.02)
    assert float(bound.period[0, 0]) == pytest.approx(expected[1] / frequency**2, rel=0.02)
    assert torch.isinf(bound.image_motion[1])


@pytest.mark.parametrize("method", ["projection", "gradients", "random"])
def test_bound_is_infinite_for_a_blind_tone_only(method):
    scene = torch.from_numpy(smooth_scene(332, 80))
    blind, options = 1 / TIMING.frame_period, {"noise": 0.01, "frame_size": (280, 32), "method": method}
    tones = (rsv.Vibration([[1.0, 0.0], [0.0, 0.0]], [[f, 0.0], [0.0, 0.0]]) for f in (blind, 1.05 * blind))
    bound, near = (cramer_rao_bound(scene, TIMING, motion, **options) for motion in tones)
    assert torch.isinf(bound.amplitude[0, 0])
    assert torch.isinf(bound.phase[0, 0])
    assert torch.isfinite(bound.image_motion).all()
    assert torch.isfinite(values_of(near)).all()
    assert (bound.amplitude[1] == 0).all()  # tones that do not exist


def test_random_scene_with_a_flat_spectrum():
    # information per frequency is S^2 / (N (2 S + N)) instead of S / (2 N), with constant S inside the disc
    highest, noise = 0.3, 0.3
    generator = np.random.default_rng(1)
    shape = (332, 256)
    spectrum = np.fft.rfft2(generator.standard_normal(shape))
    v, u = np.meshgrid(np.fft.fftfreq(shape[0]), np.fft.rfftfreq(shape[1]), indexing="ij")
    scene = np.fft.irfft2(spectrum * (np.hypot(u, v) < highest), s=shape)
    scene = torch.from_numpy(0.5 + 0.2 * scene / scene.std())
    motion = rsv.Vibration([1.3, 2.1], [50.0, 30.0], [0.4, 1.3])
    bounds = [
        values_of(cramer_rao_bound(scene, TIMING, motion, noise=noise, frame_size=(280, 200), method=method))
        for method in ("gradients", "random")
    ]
    power = 0.2**2 / (np.pi * highest**2)
    expected = np.sqrt((2 * power + noise**2) / (2 * power))
    assert expected > 1.14
    np.testing.assert_allclose((bounds[1] / bounds[0]).numpy(), expected, rtol=0.02)


def test_unknown_acceleration_increases_the_bound():
    scene = torch.from_numpy(smooth_scene(332, 80))
    motion = rsv.Vibration([1.3, 2.1], [50.0, 30.0], [0.4, 1.3], [20.0, -30.0], [100.0, 0.0])
    options = {"noise": 0.01, "frame_size": (280, 32)}
    known = cramer_rao_bound(scene, TIMING, motion, 3, **options)
    unknown = cramer_rao_bound(scene, TIMING, motion, 3, acceleration=True, **options)
    assert (known.image_acceleration == 0).all()
    assert (unknown.image_acceleration > 0).all()
    assert (values_of(unknown) > values_of(known)).all()
