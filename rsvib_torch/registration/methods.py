"""The methods of band registration, the contract that they meet, and their options."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from rsvib_torch.core.checks import check_choice, check_whole_number
from rsvib_torch.core.option_types import Registration
from rsvib_torch.registration.bands import BandTask
from rsvib_torch.registration.ncc import register_ncc
from rsvib_torch.registration.phase import register_phase
from rsvib_torch.registration.projection import register_projection

__all__ = ["BAND_METHODS", "Registration", "RegistrationOptions"]

# Contract of a band registration method. To add one, write ``register_<name>`` in a file of its own, add it to this
# table, and its name to ``Registration`` in core/option_types.py, from which configuration files take the valid names.
#
#   register(task: BandTask) -> (offsets, quality)
#
# task.first, task.second  (L, H, W) grey images of L frame pairs in row order, smoothed by a Gaussian of 1 px, without
#                          the slow course of the row means. Band n consists of the rows task.tops[n] to
#                          task.tops[n] + task.height - 1 of ``first``.
# offsets                  (L, N, 2) px, axes (x, y): position of the band's content in ``second`` less that in
#                          ``first``, the whole-frame offset ``task.coarse`` included; within ``task.search`` px of it.
# quality                  (L, N) in 0 ... 1: correlation of the matched bands. Detection weights a band by about
#                          1 / (1 - quality); ``register.py`` discards bands of quality 0.1 or less.
# A band without detail, or whose match lies at the edge of the search range or outside the frame, has offset NaN and
# quality 0; a method does not raise for it. Pairs share only the width of the templates (``BandTask.width``).
BAND_METHODS: dict[str, Callable[[BandTask], tuple[Tensor, Tensor]]] = {
    "projection": register_projection,
    "ncc": register_ncc,
    "phase": register_phase,
}


@dataclass(frozen=True)
class RegistrationOptions:
    """How the offsets of row bands between frames are measured.

    Args:
        method: ``"projection"`` (gray projection), ``"ncc"`` or ``"phase"``: a name of ``BAND_METHODS``.
        band_rows: Rows of a band, at least 4.
        band_step: Rows from one band to the next, at least 1.
        search: Search range in px around the whole-frame offset, at least 2.

    Raises:
        TypeError: If a number is not a whole number.
        ValueError: If the method is unknown or a number is too small.
    """

    method: Registration = "ncc"
    band_rows: int = 32
    band_step: int = 16
    search: int = 16

    def __post_init__(self) -> None:
        check_choice("registration", self.method, tuple(BAND_METHODS))
        for name, least in (("band_rows", 4), ("band_step", 1), ("search", 2)):
            check_whole_number(name, getattr(self, name), at_least=least)
