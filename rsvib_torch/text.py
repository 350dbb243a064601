"""Numbers, tables and JSON as text, without torch."""

import base64
import json
import math
import shutil
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


AXES = ("x", "y", "roll", "zoom")  # components of a motion


def printable(text: str, *, lines: bool = False) -> str:
    r"""Text with escapes instead of control characters, direction marks and bytes that are not UTF-8 (``\udcff``).

    Names of files may contain them; a terminal would execute control characters.

    Example:
        >>> printable("a\x1b[31m\n\u202eb\udcff")
        'a\\x1b[31m\\n\\u202eb\\udcff'
    """
    return "".join(
        character if character.isprintable() or (lines and character == "\n") else ascii(character)[1:-1]
        for character in text
    )


def measured_text(
    value: "Tensor | float",
    std: "Tensor | float | None" = None,
    digits: int = 4,
    *,
    hidden: "Tensor | float | None" = None,
) -> str:
    """Format ``value ± std`` with two significant digits of the standard deviation.

    Infinity is written as ∞, and NaN as "unknown". The value has ``digits`` if its standard deviation is not given,
    zero, infinite or unknown. The standard deviation if a further tone is ``hidden`` is added in brackets if it is
    larger by a tenth.

    Example:
        >>> measured_text(60.0, 0.01234)
        '60.000 ± 0.012'
        >>> measured_text(12345.6, 789.0)
        '12350 ± 790'
        >>> measured_text(2.19372, 0.00071, hidden=0.02)
        '2.19372 ± 0.00071 (± 0.020)'
        >>> measured_text(0.123456)
        '0.1235'
    """
    value, deviation = float(value), 0.0 if std is None else float(std)
    known = math.isfinite(deviation) and deviation > 0
    leading = deviation if known else abs(value) if math.isfinite(value) and value else 1.0
    kept = (2 if known else digits) - 1 - int(f"{leading:.{1 if known else digits - 1}e}".partition("e")[2])
    decimals = min(9, kept)

    def shown(number: float) -> str:
        if not math.isfinite(number):
            return "unknown" if math.isnan(number) else "∞" if number > 0 else "-∞"
        return f"{round(number, decimals) + 0.0:.{max(0, decimals)}f}"

    if std is None:
        return shown(value)
    text = f"{shown(value)} ± {shown(deviation)}"
    return text if hidden is None or not float(hidden) > 1.1 * deviation else f"{text} (± {float(hidden):#.2g})"


def shortened(text: str, most: int = 1000) -> str:
    """A text without its middle if it is longer than ``most`` characters, as options and contents of files can be."""
    return text if len(text) <= most else f"{text[: most - most // 4]}…{text[-(most // 4) :]}"


def one_line(message: object, most: int = 400) -> str:
    """A message in one line of about ``most`` characters."""
    return shortened(" ".join(str(message).split()), most)


def quoted(value: object) -> str:
    """A value of the user in a message: as in Python, in at most 200 characters."""
    return one_line(repr(value), 200)


def text_table(head: Sequence[str], rows: Iterable[Sequence[str]], *, most: int = 20) -> str:
    """A table as text with aligned columns; of more than ``most`` rows the first and the last are kept."""
    rows = [tuple(row) for row in rows]
    if len(rows) > most:
        omitted = (f"… {len(rows) - most} more",) + ("",) * (len(head) - 1)
        rows = [*rows[: most // 2], omitted, *rows[-(most - most // 2) :]]
    aligned = [row for row in (tuple(head), *rows) if not row[0].startswith("…")]
    widths = [max(len(row[column]) for row in aligned) for column in range(len(head))]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows))
    return "\n".join(line.rstrip() for line in lines)


def number_of(count: int, noun: str) -> str:
    """A number and its noun."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def wrapped(text: str) -> str:
    """Text in lines of the width of the terminal, at most 100 characters; all but the first are indented."""
    width = min(100, shutil.get_terminal_size((100, 24)).columns) - 2  # an answer of the program is indented by 2
    return textwrap.fill(text, width, subsequent_indent="   ", break_long_words=False, break_on_hyphens=False)


def data_uri(content: bytes, kind: str) -> str:
    """Data URI of bytes of a MIME type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def json_text(content: Mapping[str, object]) -> str:
    """A table as JSON with one key per line."""
    lines = (f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in content.items())
    return "{\n" + ",\n".join(lines) + "\n}"
