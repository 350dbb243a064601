#!/usr/bin/env python
"""Simulate frames of a vibrating camera of two drawn scenes, detect, restore, and compare with the truth.

The camera is that of Liu et al. 2023 (Sensors 23, 5953), with 12-bit counts and noise; the vibration has its
amplitudes and frequencies, and random phases.
"""

import argparse
import json
import math
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from benchmarks.resolution_chart import SCENES
from rich.console import Console

import rsvib_torch as rsv
from rsvib_torch.commands.answers import write_detection
from rsvib_torch.commands.terminal import warnings_in_one_line, working
from rsvib_torch.files.atomic import whole
from rsvib_torch.report import Report, write_report_page
from rsvib_torch.text import text_table

TIMING = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
AMPLITUDE, FREQUENCY = (3.1, 5.2), (50.0, 30.0)
FULL_SCALE, NOISE = 4095, 0.003
MARGIN = 32  # px of scene around the frame, on every side
RIM = 32  # px at the border that are not evaluated, because they are partly outside the frame
QUALITY = {"psnr_before": 2, "psnr_after": 2, "ssim_before": 4, "ssim_after": 4}  # with the digits that are shown


def compare(truth: rsv.Vibration, detected: rsv.Vibration) -> list[dict[str, Any]]:
    """True and detected values of each axis, with the relative error, or the error of the phase in π."""
    lines = []
    for axis, name in enumerate("xy"):
        for quantity, unit, scale in (("period", "ms", 1e3), ("amplitude", "px", 1.0), ("phase", "π", 1 / math.pi)):
            true, found = (scale * float(getattr(v, quantity)[axis, 0]) for v in (truth, detected))
            is_phase = quantity == "phase"
            error = math.remainder(found - true, 2) if is_phase else 100 * (found / true - 1)
            line = {"axis": name, "quantity": quantity, "unit": unit, "true": true, "detected": found}
            lines.append(line | {"error": round(error, 4), "error_unit": "π" if is_phase else "%"})
    return lines


def show(console: Console, name: str, lines: list[dict[str, Any]], quality: dict[str, Any]) -> None:
    """Print both tables of a scene."""
    heads = ("axis", "quantity", "true", "detected", "error")
    cells = []
    for line in lines:
        digits = 4 if line["unit"] == "px" else 3
        values = (f"{line[value]:.{digits}f}" for value in ("true", "detected"))
        error = f"{line['error']:+.4f} {line['error_unit']}"
        cells.append([line["axis"], f"{line['quantity']} ({line['unit']})", *values, error])
    console.print(f"{name}: vibration\n{text_table(heads, cells)}\n")
    heads = ("frame", "PSNR before (dB)", "PSNR after", "SSIM before", "SSIM after")
    columns = [[f"{value:.{digits}f}" for value in quality[key]] for key, digits in QUALITY.items()]
    cells = [[str(frame), *values] for frame, values in enumerate(zip(*columns, strict=True))]
    console.print(f"{name}: frames\n{text_table(heads, cells)}\n")


def run(name: str, options: argparse.Namespace, arguments: Sequence[str], console: Console) -> None:
    """Simulate, detect, restore and evaluate one scene, and write all results to a folder of its name."""
    size, out = (2048, 320 if options.quick else 2048), options.out / name
    generator = torch.Generator().manual_seed(options.seed)
    phase = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * math.pi
    truth = rsv.Vibration(AMPLITUDE, FREQUENCY, phase)
    with working(f"{name}: simulating two frames"):
        scene = SCENES[name](size[0] + 2 * MARGIN, size[1] + 2 * MARGIN, options.seed)
        noise = rsv.SensorNoise(read_noise=NOISE, bits=12)
        frames = rsv.simulate_frames(scene, TIMING, truth, 2, frame_size=size, noise=noise, generator=generator)
    with working(f"{name}: detecting the vibration"):
        detection = rsv.detect_vibration(frames, TIMING)
    with working(f"{name}: restoring both frames"):
        restored = rsv.restore(frames, TIMING, detection.vibration)
        verdict = rsv.judge_restoration(frames, restored, TIMING, detection.vibration)
    still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
    quality = {
        f"{what}_{when}": [round(value, 4) for value in measure(images, still, 1.0, rim=RIM).tolist()]
        for what, measure in (("psnr", rsv.psnr), ("ssim", rsv.ssim))
        for when, images in (("before", frames), ("after", restored))
    }
    lines = compare(truth, detection.vibration)
    show(console, name, lines, quality)
    with working(f"{name}: writing files and figures"), whole(out, "folder") as folder:
        rsv.write_stack(folder / "frames.tif", frames, dtype="uint16", full_scale=FULL_SCALE)
        rsv.write_stack(folder / "restored.tif", restored, dtype="uint16", full_scale=FULL_SCALE)
        write_detection(folder, detection, TIMING)
        rsv.save_figure(rsv.comparison_figure(frames[0], restored[0]), folder / "before_after.png", dpi=80)
        (folder / "report").mkdir()
        report = Report(
            title=f"Demonstration: {name}",
            subtitle=f"2 simulated frames of {size[0]} x {size[1]} px with the camera of Liu et al. 2023",
            frames=frames,
            restored=restored,
            timing=TIMING,
            detection=detection,
            outcome=verdict.overall,
            texts={"Detected vibration": detection.summary(), "Restoration": verdict.summary()},
            made_with=f"rsvib_torch {rsv.__version__}: {shlex.join(['python', 'scripts/demo.py', *arguments])}",
        )
        write_report_page(folder / "report", report)
        summary = {"scene": name, "seed": options.seed, "frame_size": size, "rim": RIM, "vibration": lines}
        summary |= {"reliable": detection.reliable.tolist(), **quality}
        (folder / "summary.json").write_text(json.dumps(summary, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    console.print(f"report with all figures: {out / 'report' / 'report.html'}\n")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="folder to write to (default: out/demo)")
    parser.add_argument("--seed", type=int, default=2023, help="seed of scene, phases and noise (default: 2023)")
    parser.add_argument("--quick", action="store_true", help="narrow frames: 2048 rows of 320 px")
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parser.parse_args(arguments)
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 100)
    begin = time.perf_counter()
    for name in SCENES:
        with warnings_in_one_line():
            run(name, options, arguments, console)
    console.print(f"{time.perf_counter() - begin:.0f} s; results are in {options.out}")


if __name__ == "__main__":
    main()
