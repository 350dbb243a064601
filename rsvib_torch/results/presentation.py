"""What all results have: a summary as text and HTML, a dictionary, files, a figure, and moves between devices.

A result is a dataclass of tensors, numbers, texts and other results. ``Result`` gives it the methods; the class writes
its own ``summary`` with the functions below.
"""

import html
import io
import itertools
import math
import os
import types
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, get_args, get_origin

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import check_fields, check_shapes, checked_methods, hints_of
from rsvib_torch.checks.values import check_number, check_single, described, members_of, needed_package, read_json
from rsvib_torch.files.atomic import write_json
from rsvib_torch.files.reading import Table
from rsvib_torch.results import IMPORTERS
from rsvib_torch.results.reason import Findings, read_findings, texts
from rsvib_torch.text import AXES, data_uri, quoted, text_table, wrapped

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

R = TypeVar("R")


def _decoded(kind: object, value: object, path: str, missing: float) -> object:
    """A value of an annotated type from what ``plain_values`` made of it; ``missing``: what None is in a tensor."""
    kind = next(iter(members_of(kind)))
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Tensor:
        return _tensor(value, path, missing)
    if isinstance(kind, type) and hasattr(kind, "__dataclass_fields__"):
        return decode(kind, value, path)
    if origin is tuple and hasattr(parts[0], "__dataclass_fields__") and isinstance(value, list):
        return tuple(decode(parts[0], entry, f"{path}[{number}]") for number, entry in enumerate(value))
    return _tuples(value)


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
        result = kind(**values)
        check_fields(result)
        return result
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}" if path else str(error)) from error


def _tensor(value: object, path: str, missing: float) -> Tensor:
    try:
        array = np.array(value)
        if array.dtype.kind in "Ou":  # with None, which becomes NaN, or beyond the integers of PyTorch
            array = np.array(value, dtype=np.float64)
            array[np.isnan(array)] = missing
        return torch.from_numpy(array)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected numbers in lists of equal lengths: {error}") from error


def _tuples(value: object) -> object:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def figure_png(figure: "Figure", dpi: int) -> bytes:
    """A figure as PNG image."""
    picture = io.BytesIO()
    figure.savefig(picture, dpi=dpi, facecolor="white", format="png")
    return picture.getvalue()


# The function that draws a result of this type, which is not a batch.
FIGURES: "dict[type, Callable[..., Figure]]" = {}

# Text


AXIS_NAMES = AXES
AXIS_UNITS = ("px", "px", "rad", "of the scale")


def axis_rows(batch_shape: Sequence[int], axes: int = 2) -> list[tuple[tuple[int, ...], list[str]]]:
    """Index (..., axis) of each axis of each result of a batch, and the first cells of its row in a table."""
    indices = itertools.product(*map(range, batch_shape), range(axes))
    return [(at, [", ".join(map(str, at[:-1]))] * bool(batch_shape) + [AXIS_NAMES[at[-1]]]) for at in indices]


def axis_head(batch_shape: Sequence[int]) -> list[str]:
    """First cells of the head of a table with ``axis_rows``."""
    return ["index"] * bool(batch_shape) + ["axis"]


def verdict_table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    batch_shape: Sequence[int],
    reliable: Tensor,
    reasons: Sequence[Sequence[str]],
) -> list[str]:
    """A table with rows that begin as in ``axis_rows``, and the verdict: lines with reasons, or a column in a batch."""
    head = [*axis_head(batch_shape), *head]
    if not batch_shape:
        lines = [text_table(head, rows)]
        for name, good, why in zip(AXIS_NAMES, reliable, reasons, strict=False):
            lines.append(f"{name}: reliable" if bool(good) else f"{name}: not reliable:")
            lines += [wrapped(f" - {reason}") for reason in why]
        return lines
    good = {tuple(labels): bool(reliable[at]) for at, labels in axis_rows(batch_shape, reliable.shape[-1])}
    verdicts = ["reliable" if good[tuple(row[:2])] else "not reliable" for row in rows]
    return [text_table([*head, "verdict"], [[*row, text] for row, text in zip(rows, verdicts, strict=True)])]


# Dictionaries


def plain_values(value: object) -> Any:
    """A value as JSON can store it: tensors as nested lists, results as tables, None for NaN and infinity."""
    if isinstance(value, Tensor):
        return plain_values(value.detach().cpu().tolist())
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if is_dataclass(value):
        return {field.name: plain_values(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain_values(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_values(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# Tables


def joined_columns(lines: Sequence[Mapping[str, object]]) -> dict[str, list[object]]:
    """Columns of a table from its lines; a cell that a line does not have is None."""
    names = dict.fromkeys(name for line in lines for name in line)
    return {name: [line.get(name) for line in lines] for name in names}


def physical_tone(amplitude: float, frequency: float, pixel_size: float) -> dict[str, float]:
    """Amplitude A in px, and of velocity and acceleration, with units in the names; a pixel has a size in m."""
    angular, metres = 2 * math.pi * frequency, amplitude * pixel_size
    return {
        "amplitude_um": 1e6 * metres,
        "velocity_um_per_s": 1e6 * angular * metres,
        "acceleration_m_per_s2": angular**2 * metres,
    }


PHYSICAL_HEAD = ("amplitude (µm)", "velocity (µm/s)", "acceleration (m/s²)")  # of ``physical_tone``


def check_pixel_size(pixel_size: float | None) -> float | None:
    """The size of a pixel in m, which a number in another unit is not."""
    if pixel_size is None:
        return None
    # a pixel of 1 km shows the Earth in 12,742 px; 1 nm is a tenth of the smallest structures of light microscopes
    return check_number("pixel_size (in m)", pixel_size, at_least=1e-9, at_most=1e3)


# Results


class Summarised:
    """A class whose objects print as their summary, in the terminal and in notebooks."""

    def summary(self) -> str:
        """The result in a few lines: here the shapes of its tensors and its other values."""
        shown = {n: f"tensor {tuple(v.shape)}" if isinstance(v, Tensor) else str(v) for n, v in vars(self).items()}
        return "\n".join([type(self).__name__, *(f"  {name}: {text}" for name, text in shown.items())])

    def __str__(self) -> str:
        return self.summary()

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        """HTML for notebooks: the summary, and the figure if there is one."""
        return f'<pre style="white-space: pre-wrap">{html.escape(self.summary())}</pre>'


@checked_methods
class Result(Summarised):
    """Methods of a dataclass of tensors, numbers, texts and other results.

    The decorator of the class needs ``repr=False``, so that objects print as their summary. Arguments of the class:
    ``units``, the units of its fields, which are written into files; ``shapes``, the axes of its tensors as in
    ``check_shapes``, where ``"..."`` alone marks a tuple with one entry for each result of a batch; and
    ``file_format``, the first entry of its files, by default the name of the class.
    """

    units: ClassVar[Mapping[str, str]] = {}
    shapes: ClassVar[Mapping[str, str]] = {}
    file_format: ClassVar[str] = ""

    def __init_subclass__(
        cls,
        *,
        units: Mapping[str, str] | None = None,
        shapes: Mapping[str, str] | None = None,
        file_format: str | None = None,
    ) -> None:
        super().__init_subclass__()
        cls.units = cls.units if units is None else units
        cls.shapes = cls.shapes if shapes is None else shapes
        cls.file_format = f"rsvib {cls.__name__}" if file_format is None else file_format

    def __post_init__(self) -> None:
        check_fields(self)
        check_shapes(vars(self), self.shapes)
        reliable = getattr(self, "reliable", None)
        if isinstance(reliable, Tensor) and reliable.dtype != torch.bool:
            raise TypeError(f"reliable must be a tensor of booleans, got {reliable.dtype}")
        for name in self.units:  # quantities with a unit
            value = getattr(self, name, None)
            if isinstance(value, Tensor) and not value.is_floating_point():
                raise TypeError(f"{name} must be a floating-point tensor, got {value.dtype}")

    def _changed(self, **values: object) -> Self:
        """The result with some values replaced, without checks."""
        result = copy(self)
        vars(result).update(values)
        return result

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions: empty for one result, (B,) for a batch of stacks."""
        for name, stated in self.shapes.items():
            value = getattr(self, name)
            if stated.startswith("... ") and isinstance(value, Tensor):
                return value.shape[: value.ndim + 1 - len(stated.split())]
        return torch.Size()

    def _fields_of_batch(self) -> Table:
        """Fields that have one entry for each result of a batch, by the leading dimensions that their shapes state."""
        return {
            name: value
            for name, value in vars(self).items()
            if isinstance(value, Result)
            or (value is not None and self.shapes.get(name, "").split(" ")[0] in ("...", "[...]"))
        }

    def __getitem__(self, index: int) -> Self:
        """One result of a batch."""
        if not self.batch_shape:
            raise IndexError(f"this {type(self).__name__} is not a batch")
        selected: Table = {}
        for name, value in self._fields_of_batch().items():
            if not isinstance(value, Tensor) or value.ndim >= len(self.shapes[name].split()):  # others are common
                selected[name] = value[index]
        return self._changed(**selected)

    @classmethod
    def stacked(cls, results: Sequence[Self]) -> Self:
        """Results of the same shape as a batch; the new dimension is the first. Other values are those of the first."""
        if not isinstance(results, (list, tuple)) or not results or not all(isinstance(one, cls) for one in results):
            raise TypeError(f"results must be a list of {cls.__name__}, at least one, got {described(results)}")

        def joined(values: Sequence[Any]) -> object:
            first = values[0]
            if isinstance(first, Tensor):
                return torch.stack(values)  # type: ignore[arg-type]
            return type(first).stacked(values) if isinstance(first, Result) else tuple(values)

        members = cls._of_equal_shapes(results)
        names = members[0]._fields_of_batch()
        return members[0]._changed(**{name: joined([getattr(one, name) for one in members]) for name in names})

    @classmethod
    def _of_equal_shapes(cls, results: Sequence[Self]) -> Sequence[Self]:
        """The results with tensors of equal shapes, if their type can be extended."""
        return results

    def to_dict(self) -> Table:
        """All values as nested lists, numbers and texts, which JSON can store; None for numbers that are not finite."""
        return {field.name: plain_values(getattr(self, field.name)) for field in fields(self)}  # type: ignore[arg-type]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as JSON, which ``load`` reads; an existing file is replaced."""
        write_json(path, {"format": self.file_format, "version": 1, **self.to_dict(), "units": dict(self.units)})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that ``save`` wrote."""
        data = read_json(Path(path), f"file of {cls.__name__}.save")
        if (data.get("format"), data.get("version")) != (cls.file_format, 1):
            got = f"{quoted(data.get('format'))} of version {quoted(data.get('version'))}"
            expected = f"format {cls.file_format!r} of version 1, as {cls.__name__}.save writes it"
            raise ValueError(f"{path}: expected {expected}, got {got}")
        try:
            return decode(cls, data, "")
        except (ValueError, RuntimeError, OverflowError) as error:  # of PyTorch and of conversions of impossible values
            raise ValueError(f"{path}: {str(error).partition(chr(10))[0]}") from error

    def table(self, *, pixel_size: float | None = None) -> dict[str, list[object]]:
        """The result as columns by name, with the unit in each name; None for unknown values.

        ``to_pandas`` makes a frame of them, and ``write_table`` a CSV file. With the size of a pixel in m, in the plane
        in which the motion is wanted (sensor or object), columns in um, um/s and m/s^2 are added.
        """
        raise TypeError(f"{type(self).__name__} has no table: use to_dict(), which all results have")

    def to_pandas(self, *, pixel_size: float | None = None) -> "pandas.DataFrame":
        """``table`` as a ``pandas.DataFrame``; missing values are NaN."""
        package = needed_package("pandas", "to_pandas", "tables")
        frame: pandas.DataFrame = package.DataFrame(self.table(pixel_size=pixel_size))
        return frame

    def mapped(self, function: Callable[[Tensor], Tensor]) -> Self:
        """The same result with ``function``, which must preserve values, applied to every tensor.

        Values are not checked again, so that no device is synchronised.
        """
        values: dict[str, object] = {}
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                values[name] = function(value)
            elif isinstance(value, Result):
                values[name] = value.mapped(function)
        return self._changed(**values)

    def to(self, device: torch.device | str) -> Self:
        """The same result with its tensors on another device."""
        return self.mapped(lambda values: values.to(device))

    def plot(self, path: str | os.PathLike[str] | None = None) -> "Figure":
        """Draw the result, and write the picture (PNG, SVG, PDF) if a path is given; notebooks show the figure."""
        figures = IMPORTERS["figures"]()  # adds to the table
        if type(self) not in FIGURES:
            drawn = ", ".join(sorted(kind.__name__ for kind in FIGURES))
            raise TypeError(f"{type(self).__name__} has no figure; these have one: {drawn}")
        check_single("result", self.batch_shape)
        figure = FIGURES[type(self)](self.mapped(lambda values: values.detach().cpu()))
        if path is not None:
            figures.save_figure(figure, path)
        return figure

    def _repr_html_(self) -> str:
        text = super()._repr_html_()
        IMPORTERS["figures"]()
        if type(self) not in FIGURES or self.batch_shape:
            return text
        return f'{text}<img src="{data_uri(figure_png(self.plot(), dpi=70), "image/png")}">'


class JudgedResult(Result):
    """A result with a verdict. Its field ``findings`` has the ``Reason`` objects against it, or against each axis."""

    findings: Findings

    @property
    def reasons(self) -> tuple[Any, ...]:
        """Texts of ``findings``."""
        return texts(self.findings)

    def codes(self, place: Sequence[int]) -> str:
        """Codes of the reasons at an index (..., axis) of ``reliable``, separated by spaces."""
        against = self.findings
        for index in place:
            against = against[index]
        return " ".join(reason.code for reason in against)
