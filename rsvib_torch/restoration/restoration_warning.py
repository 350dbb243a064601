"""The warning of restoration."""

__all__ = ["RestorationWarning"]


class RestorationWarning(UserWarning):
    """A restored frame may be worse than the raw one, or a part of the vibration was not undone.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=2)
        >>> import warnings
        >>> wrong = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[3.6, 4.1])  # opposite phase
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     restored = rsv.restore(frames, timing, wrong)
        >>> caught[0].category.__name__
        'RestorationWarning'
    """
