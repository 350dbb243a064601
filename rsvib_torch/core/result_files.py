"""Files of results: JSON, which ``Result.load`` reads again, and pictures of figures; all replace a file as a whole."""

import math
import types
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin, get_type_hints

import torch
from torch import Tensor

from rsvib_torch.core.atomic import whole_file, write_json
from rsvib_torch.core.reason import read_findings
from rsvib_torch.core.text import quoted
from rsvib_torch.core.validation import read_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save_result(result: Any, path: Path) -> None:
    """Write a ``Result`` as JSON, see ``Result.save``."""
    write_json(path, {"format": result.file_format, "version": 1, **result.to_dict(), "units": dict(result.units)})


def load_result(kind: type[Any], path: Path) -> Any:
    """Read a result of a class from a file that ``save_result`` wrote, see ``Result.load``."""
    data = read_json(path, f"file of {kind.__name__}.save")
    if data.get("format") != kind.file_format or data.get("version") != 1:
        raise ValueError(
            f"{path}: expected format {kind.file_format!r} of version 1, as {kind.__name__}.save writes it, got "
            f"{quoted(data.get('format'))} of version {quoted(data.get('version'))}"
        )
    try:
        return decode(kind, data, "")
    except (ValueError, RuntimeError, OverflowError) as error:  # of PyTorch and of conversions, for impossible values
        raise ValueError(f"{path}: {str(error).partition(chr(10))[0]}") from error


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as a picture; the ending selects PNG, SVG or PDF."""
    with whole_file(path) as part:
        figure.savefig(part, dpi=150, facecolor="white")


def decode(kind: Any, value: Any, path: str, missing: float = math.nan) -> Any:
    """A value of an annotated type from what ``plain_values`` made of it.

    ``path`` is its place in the file, for messages; ``missing`` is what None stands for in a tensor.
    """
    if get_origin(kind) in (Union, types.UnionType):
        if value is None:
            return None
        kind = next(member for member in get_args(kind) if member is not types.NoneType)
    if kind is Tensor:
        return _tensor(value, path, missing)
    if is_dataclass(kind) and isinstance(kind, type):
        return _dataclass(kind, value, path)
    origin, parts = get_origin(kind), get_args(kind)
    if origin is dict:
        if not isinstance(value, dict):
            raise ValueError(f"{path}: expected a table, got {quoted(value)}")
        return {key: decode(parts[1], entry, f"{path}.{key}", missing) for key, entry in value.items()}
    if origin is tuple and is_dataclass(parts[0]):
        if not isinstance(value, list):
            raise ValueError(f"{path}: expected a list of tables, got {quoted(value)}")
        return tuple(decode(parts[0], entry, f"{path}[{number}]") for number, entry in enumerate(value))
    if origin is Literal and value not in parts:
        raise ValueError(f"{path}: expected {' or '.join(map(repr, parts))}, got {quoted(value)}")
    if kind in (float, int, str, bool) and not isinstance(value, (float, int) if kind is float else kind):
        raise ValueError(f"{path}: expected {kind.__name__}, got {quoted(value)}")
    return value if kind is Any else _tuples(value)


def _dataclass(kind: type[Any], value: Any, path: str) -> Any:
    if not isinstance(value, dict):
        raise ValueError(f"{path}: expected a table, got {quoted(value)}")
    # SensorTiming does not import torch, whose Tensor its annotations name
    hints, start = get_type_hints(kind, localns={"Tensor": torch.Tensor}), f"{path}." if path else ""
    missing = getattr(kind, "_MISSING", math.nan)
    values: dict[str, Any] = {}
    for field in fields(kind):
        if field.name in value:
            stated = value[field.name]
            if field.name in ("findings", "left_alone"):
                values[field.name] = read_findings(stated)
            else:
                values[field.name] = decode(hints[field.name], stated, start + field.name, missing)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"{start}{field.name}: missing key")
    try:
        return kind(**values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}" if path else str(error)) from error


def _tensor(value: Any, path: str, missing: float) -> Tensor:
    def filled(entry: Any) -> Any:
        return [filled(part) for part in entry] if isinstance(entry, list) else missing if entry is None else entry

    values = filled(value)
    try:
        tensor = torch.tensor(values, device="cpu")
        if tensor.is_floating_point() or not tensor.numel():
            tensor = torch.tensor(values, dtype=torch.float64, device="cpu")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected numbers in lists of equal lengths: {error}") from error
    return tensor


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
