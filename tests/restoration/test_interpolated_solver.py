"""Systems that change smoothly with frequency: few factors for all of them."""

import numpy as np
import pytest
import torch
from scipy.linalg import solveh_banded

import rsvib_torch.restoration.exact.exact as exact_module
import rsvib_torch.restoration.exact.partition as partition_module
from rsvib_torch import SensorNoise, SensorTiming, Vibration, psnr, restore, simulate_frames
from rsvib_torch.core.banded_solver import BandedMemory, skew_band
from rsvib_torch.evaluation.scenes import city_and_fields
from rsvib_torch.restoration import in_order, interpolated_solver
from rsvib_torch.restoration.exact.interpolated_solver import NodeFactors, SubstitutionMemory, chosen_nodes
from rsvib_torch.restoration.scene_model.row_sums import RowSums
from rsvib_torch.restoration.scene_model.row_system import RowKernels, smooth_kernels
from rsvib_torch.restoration.scene_model.segments import Segments


def smooth_systems(count, width, frequencies, dtype=torch.complex128, seed=0):
    """Lower bands (K, b + 1, U) that turn once over all frequencies, and right sides (K, 2, U)."""
    generator = torch.Generator().manual_seed(seed)
    turns = torch.linspace(0, 2 * torch.pi, frequencies, dtype=torch.float64)
    first, second = torch.randn(2, count, width + 1, 1, dtype=torch.complex128, generator=generator)
    band = first * torch.exp(1j * turns) + second
    band[:, 0] = band[:, 0].real + 4.0 * (width + 1)
    return band.to(dtype), torch.randn(count, 2, frequencies, dtype=dtype, generator=generator)


def solved_between(band, right_side, nodes, memory=None, segments=None):
    count, width, frequencies = band.shape[0], band.shape[1] - 1, band.shape[2]
    factoring = BandedMemory(count, width, 0, len(nodes), right_side)
    factoring.full[:] = skew_band(band[..., nodes])
    factors = NodeFactors.of(nodes, factoring.factor(count), Segments(count))
    segments = segments or Segments(count)
    windows = len(segments.windows)
    memory = memory or SubstitutionMemory(segments.size, width, 2, windows, frequencies, right_side)
    memory.right_side[: segments.size] = segments.split(right_side).flatten(-2)
    solved = memory.solve(factors.in_segments(segments), factors.between(0, frequencies))
    return segments.join(solved.conj().unflatten(-1, (-1, frequencies))).resolve_conj()


def by_scipy(band, right_side, index):
    return solveh_banded(band[..., index].numpy().T.copy(), right_side[..., index].numpy(), lower=True)


@pytest.mark.parametrize(("count", "width"), [(7, 1), (40, 1), (40, 4), (250, 7)])
def test_agrees_with_scipy_where_factors_are_known_and_nearly_between(count, width):
    band, right_side = smooth_systems(count, width, 65)
    expected = np.stack([by_scipy(band, right_side, index) for index in range(65)], -1)
    errors = []
    for step in (4, 2):
        found = solved_between(band, right_side, torch.arange(0, 65, step)).numpy()
        np.testing.assert_allclose(found[..., ::step], expected[..., ::step], rtol=1e-9, atol=1e-11)
        errors.append(np.abs(found - expected).max())
    assert errors[0] < 0.05 * np.abs(expected).max()
    assert 1e-9 < errors[1] < 0.35 * errors[0]  # of second order


def test_memory_serves_smaller_systems_too_and_windows():
    band, right_side = smooth_systems(250, 4, 21)
    nodes = chosen_nodes(21, 3.0, torch.device("cpu"))
    memory = SubstitutionMemory(250, 4, 2, 1, 21, right_side)
    whole = solved_between(band, right_side, nodes)
    for count in (250, 97, 250, 13):  # what a larger system left does not matter
        again = solved_between(band[:count], right_side[:count], nodes, memory)
        torch.testing.assert_close(again, solved_between(band[:count], right_side[:count], nodes))
    assert memory.holds(97, 4, 2, 1, 21)
    for sizes in ((251, 4, 2, 1, 21), (97, 5, 2, 1, 21), (97, 4, 1, 1, 21), (97, 4, 2, 2, 21), (97, 4, 2, 1, 20)):
        assert not memory.holds(*sizes)
    split = solved_between(band, right_side, nodes, segments=Segments(250, 3, 40))
    torch.testing.assert_close(split, whole, rtol=0, atol=1e-9)


@pytest.mark.parametrize("keeps_order", [True, False])
def test_products_are_subtracted_one_after_the_other(keeps_order, monkeypatch):
    monkeypatch.setattr(in_order, "_keeps_order", lambda: keeps_order)
    rows = torch.ones(400, 3, dtype=torch.complex64)
    in_order.subtract_products(rows[1:].unbind(), torch.full((399, 1), 1j).unbind(), rows[:-1].unbind())
    expected = [1.0]
    for _ in range(399):
        expected.append(1 - 1j * expected[-1])
    torch.testing.assert_close(rows[:, 1], torch.tensor(expected, dtype=torch.complex64))


def test_this_version_keeps_the_order():
    assert in_order._keeps_order()


def kernels_of(first):
    generator = torch.Generator().manual_seed(3)
    rows = len(first)
    taps = torch.randn(1, rows, 6, 2, dtype=torch.float64, generator=generator)
    along = 0.3 * torch.randn(1, rows, 2, dtype=torch.float64, generator=generator)
    weight = torch.rand(1, rows, dtype=torch.float64, generator=generator)
    weight[0, ::7] = 0
    return RowKernels(first[None], taps, torch.zeros(1, rows, dtype=torch.float64), along, weight)


NEAR, HEAPED = torch.arange(90) // 2 * 2, torch.arange(90).clamp(min=85) * 4 - 340


@pytest.mark.parametrize("first", [NEAR, HEAPED], ids=["near", "heaped"])
def test_rows_looked_up_are_rows_added(first):
    kernels = kernels_of(first)
    count = int(first.max()) + 6
    sums = RowSums(kernels, smooth_kernels(kernels, torch.float64), 0, count)
    assert (sums._places is None) == (first is HEAPED)
    u = torch.linspace(0, 0.5, 11, dtype=torch.float64)
    data = torch.randn(90, 2, 11, dtype=torch.complex128, generator=torch.Generator().manual_seed(4))
    expected = torch.zeros(count, 2, 11, dtype=torch.complex128)
    seen = kernels.at(u)[0]
    for row in range(90):
        for tap in range(6):
            expected[first[row] + tap] += kernels.weight[0, row] * seen[row, tap].conj() * data[row]
    for out in (None, torch.full_like(expected, torch.nan)):
        torch.testing.assert_close(sums.of(data, u, out), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("frequencies", [5, 97, 1081])
def test_blocks_are_all_systems_once_and_smaller_where_nodes_lie_close(frequencies):
    nodes = chosen_nodes(frequencies, 33.0, torch.device("cpu"))
    above = torch.searchsorted(nodes, torch.arange(frequencies)).clamp(min=1).tolist()
    blocks = list(interpolated_solver._blocks(above))
    assert [system for start, stop in blocks for system in range(start, stop)] == list(range(frequencies))
    sizes = [stop - start for start, stop in blocks[:-1]]
    assert sizes == sorted(sizes)
    assert all(above[stop - 1] - above[start] <= 6 for start, stop in blocks[1:])


@pytest.mark.parametrize(("exposure", "noise", "limit"), [(20, 0.005, 0.02), (90, 0.02, 0.02), (20, 0.0, 0.0)])
@pytest.mark.parametrize("options", [{}, {"joint": True}, {"prior": "edges"}, {"segments": 2}])
def test_frames_are_as_good_as_with_all_factors(exposure, noise, limit, options, monkeypatch):
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=exposure, frame_rows=2048)
    vibration = Vibration([3.1, 5.2], [50.0, 30.0], [0.7, 2.1])
    scene = city_and_fields(220 + 96, 900 + 96, seed=4)
    sensor, generator = SensorNoise(read_noise=noise), torch.Generator().manual_seed(5)
    frames = simulate_frames(scene, timing, vibration, 2, frame_size=(220, 900), noise=sensor, generator=generator)
    nodes = []
    of = partition_module.Partition.of

    def noted(*arguments, **named):
        shares = of(*arguments, **named)
        nodes.append(shares.nodes is not None)
        return shares

    monkeypatch.setattr(partition_module.Partition, "of", noted)
    monkeypatch.setattr(exact_module, "prior_strength", lambda *_, **__: 1.0)  # without noise, rounding decides
    found = restore(frames, timing, vibration, check=False, **options)
    assert any(nodes)
    with monkeypatch.context() as patched:
        patched.setattr(partition_module, "_COARSEST", 1 / 3)
        patched.setattr(partition_module, "_OF_BLUR", 2.0)
        patched.setattr(interpolated_solver, "_FINER", 1.0)
        careless = restore(frames, timing, vibration, check=False, **options)
    monkeypatch.setattr(partition_module, "_FEW", 1e9)
    nodes.clear()
    whole = restore(frames, timing, vibration, check=False, **options)
    assert not any(nodes)
    inner = (slice(None), slice(24, -24), slice(24, -24))
    error, wrong = (float((image - whole)[inner].square().mean().sqrt()) for image in (found, careless))
    assert error < limit * noise + 5e-5
    assert wrong > 3.5 * error
    still = scene[48:-48, 48:-48]
    first = inner[1:]
    assert abs(psnr(found[0][first], still[first], 1.0) - psnr(whole[0][first], still[first], 1.0)) < 0.02
