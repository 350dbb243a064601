"""Which frames of a stack are restored together."""

from rsvib_torch.core.checks import check_whole_number

__all__ = ["joint_groups"]


def joint_groups(count: int, joint: bool | int) -> list[tuple[list[int], int]]:
    """Frames restored together, and the frame whose coordinates the result has, for every result.

    Args:
        count: Frames of the stack.
        joint: ``True``: all together, in the coordinates of the middle one; a number K: every frame with its
            neighbours, K in all; ``False``: every frame alone.

    Example:
        >>> joint_groups(3, True)
        [([0, 1, 2], 1)]
        >>> joint_groups(3, 2)
        [([0, 1], 0), ([1, 2], 1), ([1, 2], 2)]
    """
    if joint is True:
        return [(list(range(count)), count // 2)]
    size = 1 if joint is False else min(check_whole_number("joint", joint, at_least=1), count)
    starts = [min(max(frame - (size - 1) // 2, 0), count - size) for frame in range(count)]
    return [(list(range(first, first + size)), frame) for frame, first in enumerate(starts)]
