#!/usr/bin/env python
"""Reproduce Tables 2, 3 and 4 and two claims of Liu et al. 2023 (Sensors 23, 5953).

The values of the paper are compared with those of its methods and of the default methods, over trials with random
phases and noise. Writes reproduction.md, reproduction.json and two figures.
"""

import argparse
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from reproduction.document import markdown, record
from reproduction.pictures import errors_figure, sampling_figure
from reproduction.trials import SPEEDS, Plan, run

from rsvib_torch.core.atomic import whole_folder
from rsvib_torch.report.plots import save_figure

PLANS = {
    "whole": Plan(size=(2048, 1024), seeds=10, noises=(0.005, 0.002, 0.0), edges=3, speeds=SPEEDS, processes=2),
    "quick": Plan(size=(2048, 512), seeds=2, noises=(0.005,), edges=2, speeds=SPEEDS[:2], processes=2),
    "tiny": Plan(size=(512, 384), seeds=1, noises=(0.005,), edges=1, speeds=SPEEDS[:1], processes=1),
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/reproduction"), help="folder to write to")
    parser.add_argument("--quick", dest="plan", action="store_const", const="quick", help="2 trials of narrower frames")
    parser.add_argument("--tiny", dest="plan", action="store_const", const="tiny", help="1 trial, for a test")
    parser.set_defaults(plan="whole")
    options = parser.parse_args(arguments)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(1)  # two processes run at the same time
    plan, begin = PLANS[options.plan], time.perf_counter()

    def report(what: str) -> None:
        print(f"{time.perf_counter() - begin:5.0f} s  {what}", flush=True)

    found = run(plan, report)
    with whole_folder(options.out) as folder:
        (folder / "reproduction.md").write_text(markdown(found, plan), encoding="utf-8")
        text = json.dumps(record(found, plan), indent=1, ensure_ascii=False, allow_nan=False)
        (folder / "reproduction.json").write_text(text + "\n", encoding="utf-8")
        save_figure(errors_figure(found, plan), folder / "detection_errors.png")
        save_figure(sampling_figure(found), folder / "global_shutter.png")
    report(f"{options.out}: reproduction.md, .json and figures")


if __name__ == "__main__":
    main()
