"""Speed and accuracy beside what one would use instead: one run, ratios, a Markdown table and JSON.

Registration of all bands of a pair against a loop of scikit-image's phase correlation over the same bands, and banded
restoration of a frame against a loop over rows of scikit-image's Wiener filter on the same slabs. Needs the extra
``benchmark``. Timings are medians; the loops are timed on a sample of their bands or rows and scaled up, as the table
says.
"""

import argparse
import json
import math
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from skimage.registration import phase_cross_correlation
from skimage.restoration import wiener

import rsvib_torch as rsv
from rsvib_torch.evaluation.targets import city_and_fields

HALF_ROWS = 16


def median_time(action: Callable[[], object], repeats: int) -> float:
    """Median wall time of an action in seconds, after one call that does not count."""
    action()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        action()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def true_offsets(
    curve: rsv.OffsetCurve, vibration: rsv.Vibration, timing: rsv.SensorTiming, height: int
) -> torch.Tensor:
    """Mean offset of each band under the true vibration, with the coupling of the scan, (N, 2) px."""
    shift = torch.zeros_like(curve.times)
    for _ in range(8):  # content moved along the scan axis is exposed later: a fixed point
        shift = vibration.offset(curve.times, curve.later_times + shift * timing.row_time, timing.exposure_time)[..., 1]
    rows = (torch.arange(height, dtype=torch.float64) - 0.5 * (height - 1)) * timing.row_time
    moments = [curve.times[0, :, None] + rows, (curve.later_times[0] + shift[0] * timing.row_time)[:, None] + rows]
    return vibration.offset(moments[0], moments[1], timing.exposure_time).mean(1)


def rms(error: torch.Tensor) -> list[float]:
    """Root mean square of each axis, without failed bands, in px."""
    return error[torch.isfinite(error).all(-1)].square().mean(0).sqrt().tolist()


def benchmark_registration(
    frames: torch.Tensor, timing: rsv.SensorTiming, vibration: rsv.Vibration, repeats: int, sample: int
) -> list[dict[str, object]]:
    """Register all bands of a pair, by each method and by the peer."""
    height, step = 32, 16
    rows: list[dict[str, object]] = []
    for method in ("ncc", "phase", "projection"):
        curve = rsv.register_bands(frames, timing, method=method, band_rows=height, band_step=step)
        seconds = median_time(lambda m=method: rsv.register_bands(frames, timing, method=m), repeats)
        error = curve.offsets[0] - true_offsets(curve, vibration, timing, height)
        failed = int((~curve.good).sum())
        rows.append({"what": f"rsvib_torch {method}", "seconds": seconds, "rms_px": rms(error), "failed": failed})
    truth = true_offsets(curve, vibration, timing, height)
    pair = frames.numpy()
    tops = [int(centre - 0.5 * (height - 1)) for centre in curve.rows.tolist()]

    def peer(top: int) -> np.ndarray:
        shift, _, _ = phase_cross_correlation(
            pair[1, top : top + height], pair[0, top : top + height], upsample_factor=100
        )
        return shift[::-1].copy()

    measured = torch.from_numpy(np.stack([peer(top) for top in tops]))
    chosen = tops[:: max(1, len(tops) // sample)]
    seconds = median_time(lambda: [peer(top) for top in chosen], repeats) * len(tops) / len(chosen)
    name = f"scikit-image phase_cross_correlation x100, loop ({len(chosen)} of {len(tops)} bands timed)"
    rows.append({"what": name, "seconds": seconds, "rms_px": rms(measured - truth), "failed": 0})
    return rows


def benchmark_restoration(
    frames: torch.Tensor,
    timing: rsv.SensorTiming,
    vibration: rsv.Vibration,
    still: torch.Tensor,
    repeats: int,
    sample: int,
) -> list[dict[str, object]]:
    """Restore one frame by each method, and by a row loop of the peer on slabs of the same rows."""
    frame = frames[:1]
    rows: list[dict[str, object]] = []
    choices: list[tuple[str, dict[str, object]]] = [
        ("banded, a slab for every row", {"method": "banded", "stride": 1, "half_rows": HALF_ROWS}),
        ("banded, a slab for every two rows", {"method": "banded", "half_rows": HALF_ROWS}),
        ("exact", {"method": "exact"}),
        ("dewarp", {"method": "dewarp"}),
    ]
    for name, options in choices:
        restored = rsv.restore(frame, timing, vibration, **options)
        seconds = median_time(lambda o=options: rsv.restore(frame, timing, vibration, **o), repeats)
        quality = float(rsv.psnr(restored[0], still, 1.0, rim=32))
        rows.append({"what": f"rsvib_torch {name}", "seconds": seconds, "psnr_db": quality})

    num_rows = frame.shape[-2]
    kernels, _ = rsv.row_psf(vibration, timing.row_starts(1, num_rows), timing).dense()
    image = frame[0].numpy()
    step = max(1, (num_rows - 2 * HALF_ROWS) // sample)
    chosen = range(HALF_ROWS, num_rows - HALF_ROWS, step)

    def peer() -> None:
        for row in chosen:
            kernel = kernels[0, row].numpy().astype(np.float32)
            wiener(image[row - HALF_ROWS : row + HALF_ROWS + 1], kernel, 1e-3, clip=False)

    seconds = median_time(peer, repeats) * num_rows / len(chosen)
    rows.append(
        {"what": f"scikit-image wiener, loop over rows ({len(chosen)} of {num_rows} timed)", "seconds": seconds}
    )
    return rows


def as_table(title: str, rows: list[dict[str, object]]) -> str:
    """Markdown table; the last row is the peer the ratios refer to."""
    peer = float(rows[-1]["seconds"])  # type: ignore[arg-type]
    lines = [f"### {title}", "", "| | seconds | times faster than the peer | |", "|---|---|---|---|"]
    for row in rows:
        seconds = float(row["seconds"])  # type: ignore[arg-type]
        note = ""
        if "rms_px" in row:
            x, y = row["rms_px"]  # type: ignore[misc]
            note = f"rms error {x:.4f} px along x, {y:.4f} px along y; {row['failed']} bands failed"
        elif "psnr_db" in row:
            note = f"{row['psnr_db']:.1f} dB"
        lines.append(f"| {row['what']} | {seconds:.3f} | {peer / seconds:.1f} | {note} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=2048, help="rows and columns of the frames")
    parser.add_argument("--repeats", type=int, default=5, help="counted runs of everything")
    parser.add_argument("--sample", type=int, default=64, help="bands and rows the peers' loops are timed on")
    parser.add_argument("--out", type=Path, default=Path("out/benchmark"), help="folder for benchmark.md and .json")
    arguments = parser.parse_args()

    timing = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=max(2048, arguments.size))
    vibration = rsv.Vibration(amplitude=[3.1, 5.2], frequency=[50.0, 30.0], phase=[0.4, -2.0])
    size, noise = arguments.size, 0.003
    scene = city_and_fields(size + 80, size + 80, seed=7)
    frames = rsv.simulate_frames(scene, timing, vibration, frame_size=(size, size))
    frames = rsv.SensorNoise(read_noise=noise).apply(frames, torch.Generator().manual_seed(7))
    still = scene[40 : 40 + size, 40 : 40 + size]

    registration = benchmark_registration(frames, timing, vibration, arguments.repeats, arguments.sample)
    restoration = benchmark_restoration(frames, timing, vibration, still, arguments.repeats, arguments.sample)
    machine = {
        "processor": platform.machine(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "repeats": arguments.repeats,
        "frame": [size, size],
        "noise": noise,
        "raw_psnr_db": round(float(rsv.psnr(frames[0], still, 1.0, rim=32)), 2),
    }
    text = "\n\n".join(
        [
            f"Frames of {size} x {size}, {torch.get_num_threads()} threads, noise {noise:g} of full scale, raw "
            f"{machine['raw_psnr_db']} dB; medians of {arguments.repeats} runs.",
            as_table("All bands of a frame pair (32 rows, every 16)", registration),
            as_table(f"Restoration of one frame (slabs of {2 * HALF_ROWS + 1} rows)", restoration),
        ]
    )
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "benchmark.md").write_text(text + "\n")
    result = {"machine": machine, "registration": registration, "restoration": restoration}
    (arguments.out / "benchmark.json").write_text(json.dumps(result, indent=2, default=_plain) + "\n")
    print(text)


def _plain(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else str(value)


if __name__ == "__main__":
    main()
