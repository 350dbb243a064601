"""Files of results: JSON, which ``Result.load`` reads again, and pictures of figures."""

import io
import math
import types
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_origin

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import check_fields, hints_of
from rsvib_torch.checks.values import members_of
from rsvib_torch.files.reading import Table
from rsvib_torch.results.reason import read_findings
from rsvib_torch.text import quoted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

R = TypeVar("R")


def result_of(kind: type[R], data: Table, path: Path) -> R:
    """A result of a class from the content of a file that ``Result.save`` wrote, see ``Result.load``."""
    file_format, found = getattr(kind, "file_format", ""), str(data.get("format"))
    if found != file_format or data.get("version") != 1:
        content = {"rsvib vibration": "DetectionResult", "rsvib stack": "StackManifest"}.get(found, found[6:])
        reader = f", which {content}.load reads" if content[:1].isupper() and found != file_format else ""
        raise ValueError(
            f"{path}: expected format {file_format!r} of version 1, as {kind.__name__}.save writes it, got "
            f"{quoted(found)} of version {quoted(data.get('version'))}{reader}"
        )
    try:
        return decode(kind, data, "")
    except (ValueError, RuntimeError, OverflowError) as error:  # of PyTorch and of conversions, for impossible values
        raise ValueError(f"{path}: {str(error).partition(chr(10))[0]}") from error


def _decoded(kind: object, value: object, path: str, missing: float) -> object:
    """A value of an annotated type from what ``plain_values`` made of it; ``missing``: what None is in a tensor."""
    kind = next(iter(members_of(kind)))
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Tensor:
        return _tensor(value, path, missing)
    if isinstance(kind, type) and hasattr(kind, "__dataclass_fields__"):
        return decode(kind, value, path)
    if origin is dict and isinstance(value, dict):
        return {key: _decoded(parts[1], entry, f"{path}.{key}", missing) for key, entry in value.items()}
    if origin is tuple and hasattr(parts[0], "__dataclass_fields__") and isinstance(value, list):
        return tuple(decode(parts[0], entry, f"{path}[{number}]") for number, entry in enumerate(value))
    return value if kind is Any else _tuples(value)


def decode(kind: type[R], value: object, path: str) -> R:
    """A dataclass from what ``plain_values`` made of it; ``path`` is its place in the file, for messages."""
    if not (isinstance(value, dict) and is_dataclass(kind)):
        raise ValueError(f"{path}: expected a table, got {quoted(value)}")
    hints, start, missing = hints_of(kind), f"{path}." if path else "", getattr(kind, "_MISSING", math.nan)
    values: Table = {}
    for field in fields(kind):
        name, hint = field.name, hints[field.name]
        if name not in value:
            if field.default is MISSING and field.default_factory is MISSING:
                raise ValueError(f"{start}{name}: missing key")
        elif name in ("findings", "left_alone"):
            values[name] = read_findings(value[name])
        else:
            is_none = value[name] is None and types.NoneType in get_args(hint)
            values[name] = None if is_none else _decoded(hint, value[name], start + name, missing)
    try:
        made = kind(**values)
        check_fields(made)
        return made
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}" if path else str(error)) from error


def _tensor(value: object, path: str, missing: float) -> Tensor:
    def filled(entry: object) -> object:
        return [filled(part) for part in entry] if isinstance(entry, list) else missing if entry is None else entry

    values = filled(value)
    try:
        tensor = torch.tensor(values, device="cpu")
        if tensor.is_floating_point() or not tensor.numel():
            tensor = torch.tensor(values, dtype=torch.float64, device="cpu")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected numbers in lists of equal lengths: {error}") from error
    return tensor


def _tuples(value: object) -> object:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def figure_png(figure: "Figure", dpi: int) -> bytes:
    """A figure as PNG image."""
    picture = io.BytesIO()
    figure.savefig(picture, dpi=dpi, facecolor="white", format="png")
    return picture.getvalue()
