"""Offsets between two clocks: those for which a recording covers the frames, and limits."""

from typing import Protocol

from rsvib_torch.checks.values import check_number
from rsvib_torch.results.reason import Reason


class _Recording(Protocol):
    @property
    def start(self) -> float: ...

    @property
    def end(self) -> float: ...


def offset_range(
    recorded: _Recording, first: float, last: float, limits: tuple[float, float] | None
) -> tuple[float, float]:
    """Range of offsets in s for which a recording covers the time from ``first`` to ``last``, within ``limits``."""
    low, high = recorded.start - first, recorded.end - last
    if high < low:
        raise ValueError(
            f"the recording of {recorded.end - recorded.start:.4g} s is shorter than the frames, {last - first:.4g} s; "
            "are its times in another unit?"
        )
    if limits is not None:
        bounds = (check_number("offsets", limits[0]), check_number("offsets", limits[1]))
        if bounds[1] < low or bounds[0] > high or bounds[1] < bounds[0]:
            raise ValueError(
                f"offsets {bounds[0]:g} to {bounds[1]:g} s: the recording covers the frames from {low:.6g} to "
                f"{high:.6g} s"
            )
        low, high = max(low, bounds[0]), min(high, bounds[1])
    return low, high


def outside(offset: float, std: float, limits: tuple[float, float] | None) -> list[Reason]:
    """The reason against an offset in s outside ``limits`` by more than 4 standard deviations."""
    if limits is None or limits[0] - 4 * std <= offset <= limits[1] + 4 * std:
        return []
    return [Reason("offset_outside", None, offset, limits[0] if offset < limits[0] else limits[1])]
