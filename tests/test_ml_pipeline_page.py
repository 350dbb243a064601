"""The code on the page about ML pipelines runs, top to bottom."""

import re
from pathlib import Path

import pytest
import torch

import rsvib_torch as rsv

PAGE = Path(__file__).parents[1] / "docs" / "ml_pipeline.md"


@pytest.fixture(scope="module")
def names():
    """What the code of the page leaves behind."""
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    assert len(blocks) >= 8
    torch.manual_seed(0)
    names = {"__name__": "page"}
    exec(compile("\n".join(blocks), str(PAGE), "exec"), names)
    return names


def test_page_does_what_it_says(names):
    assert names["features"].shape == (2, 8, *names["frames"].shape[-2:])
    assert names["vibration"].amplitude.shape == (4, 2, 1)
    assert names["moved_points"].shape == (4, 2, 2)
    assert not torch.equal(names["moved_boxes"], names["boxes"])
    assert names["taken"].shape == (4, 2, 3, 96, 64)


def test_model_on_the_page_restores(names):
    """Its detector finds the vibration, and its restorer brings the scene back."""
    frames, truth = names["frames"], names["truth"]
    found = names["model"].detector(frames).vibration[0]
    torch.testing.assert_close(found.amplitude, truth.amplitude, rtol=0, atol=0.2)
    height, width = frames.shape[-2:]
    top, left = (320 - height) // 2, (200 - width) // 2
    still = names["scene"][top : top + height, left : left + width]
    restored = names["model"].restorer(frames, found)[0, :, 0]
    assert (rsv.psnr(restored, still, 1.0, rim=16) > rsv.psnr(frames[0, :, 0], still, 1.0, rim=16) + 5).all()
