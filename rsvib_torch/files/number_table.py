"""Tables of numbers in text files, of bounded size."""

import csv
import math
from array import array
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.text import one_line, quoted

MAX_SAMPLES = 10**7  # rows of a table of numbers; 80 minutes of a gyroscope with 2 kHz


def rows_of_numbers(
    path: Path, lines: Iterable[str], header: list[str], columns: list[int], first_line: int
) -> NDArray[np.float64]:
    """Numbers (N, C) in some columns of comma-separated lines; empty lines are skipped.

    ``lines`` follow the ``header``, the names of all columns; C ``columns`` are read. ``first_line`` is the number of
    the first of the lines in the file, for errors.
    """
    repeated = next((header[column] for column in columns if header.count(header[column]) > 1), None)
    if repeated is not None:
        raise ValueError(f"{path}: column {quoted(repeated)} occurs twice; rename one of them")
    values = array("d")
    limit = MAX_SAMPLES * len(columns)
    reader = csv.reader(lines, skipinitialspace=True)
    for cells in reader:
        if not cells or cells == [""]:
            continue
        number = first_line + reader.line_num - 1
        if len(cells) > len(header) and any(cells[len(header) :]):
            problem = f"{len(cells)} values in {len(header)} columns"
            raise ValueError(f"{path}, line {number}: {problem}; write decimal points, not commas")
        for column in columns:
            text = cells[column] if column < len(cells) else ""
            try:
                value = float(text)
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                name = one_line(header[column], 60)
                raise ValueError(f"{path}, line {number}: {name} must be a number, got {quoted(text)}")
            values.append(value)
        if len(values) > limit:
            raise ValueError(f"{path}: more than {MAX_SAMPLES:,} samples; cut the recording to the time of the frames")
    return np.frombuffer(values, dtype=np.float64).reshape(-1, len(columns))
