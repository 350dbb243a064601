"""Griffe extension: doctests under the heading ``Example`` are code, as those under ``Examples`` are."""

from typing import Any

import griffe

__all__ = ["DoctestsAsCode"]


class DoctestsAsCode(griffe.Extension):
    """Turns the heading of every docstring's example into the one that Griffe reads as doctests."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Look at one object as it is loaded."""
        if obj.docstring is not None:
            lines = obj.docstring.value.splitlines()
            obj.docstring.value = "\n".join("Examples:" if line == "Example:" else line for line in lines)
