"""Griffe extension: doctests under the heading ``Example`` are code, and functions have their options as arguments."""

import importlib
import inspect
from typing import Any

import griffe

__all__ = ["DoctestsAsCode"]


class DoctestsAsCode(griffe.Extension):
    """Turns the heading of every docstring's example into the one that Griffe reads as doctests.

    Functions that receive ``options`` get the arguments and the docstring that they have at run time.
    """

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Look at one function as it is loaded."""
        if "options" not in func.parameters:
            return
        thing: Any = importlib.import_module(func.module.path)
        for name in func.path.removeprefix(f"{func.module.path}.").split("."):
            thing = getattr(thing, name, None)
        if not hasattr(thing, "__signature__"):
            return
        func.parameters._params = [parameter for parameter in func.parameters if parameter.name != "options"] + [
            griffe.Parameter(
                name,
                annotation=inspect.formatannotation(parameter.annotation).replace("typing.", ""),
                kind=griffe.ParameterKind.keyword_only,
                default=repr(parameter.default) if parameter.default is not parameter.empty else None,
            )
            for name, parameter in inspect.signature(thing).parameters.items()
            if parameter.kind is parameter.KEYWORD_ONLY
        ]
        if func.docstring is not None:
            func.docstring.value = inspect.getdoc(thing) or ""
            self.on_object(obj=func)

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Look at one object as it is loaded."""
        if obj.docstring is not None:
            lines = obj.docstring.value.splitlines()
            obj.docstring.value = "\n".join("Examples:" if line == "Example:" else line for line in lines)
