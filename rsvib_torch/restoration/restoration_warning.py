"""The warning of restoration."""

import sys
import warnings


class RestorationWarning(UserWarning):
    """A restored frame may be worse than the raw one, or a part of the vibration was not undone.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, _ = example_frames()
        >>> import warnings
        >>> wrong = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[3.6, 4.1])  # opposite phase
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     restored = rsv.restore(frames, timing, wrong)
        >>> caught[0].category.__name__
        'RestorationWarning'
    """


def warn_of_restoration(message: str) -> None:
    """Raise a ``RestorationWarning`` that refers to the line of the caller of the package."""
    package = __name__.partition(".")[0]
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, RestorationWarning, stacklevel=level)
