"""Offsets between two clocks: those for which a recording covers the frames, and limits."""

from rsvib_torch.checks.values import check_number
from rsvib_torch.results.reason import Reason


def offset_range(
    start: float, end: float, first: float, last: float, limits: tuple[float, float] | None
) -> tuple[float, float]:
    """Range of offsets in s, within ``limits``, for which a recording covers the time from ``first`` to ``last``."""
    low, high = start - first, end - last
    if high < low:
        raise ValueError(
            f"the recording of {end - start:.7g} s is shorter than the frames, which take {last - first:.7g} s with "
            "their readout; use fewer frames, or check the unit of its times"
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
