"""Comparison of the output that a page or notebook shows with that of a run."""

import re

NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def differing_lines(expected, found, relative=0.1, absolute=0.05):
    """Lines of a page and of a run that differ by more than spaces and the last digits of numbers.

    Digits of standard deviations differ between processors.
    """
    pairs = [page.splitlines() for page in (expected, found)]
    if len(pairs[0]) != len(pairs[1]):
        return [line for line in pairs[1] if line not in pairs[0]] or ["the output has fewer lines"]
    differing = []
    for lines in zip(*pairs, strict=True):
        first, second = (" ".join(line.split()) for line in lines)
        # computing times depend on the machine, and the sign of a small number on its rounding
        for changing, fixed in ((r"[\d.]+ s per frame", "s per frame"), (r"[-+](0\.0+)\b", r"\1")):
            first, second = (re.sub(changing, fixed, line) for line in (first, second))
        numbers = [[float(number) for number in NUMBER.findall(line)] for line in (first, second)]
        same = NUMBER.sub("0", first) == NUMBER.sub("0", second) and all(
            abs(b - a) <= absolute + relative * abs(a) for a, b in zip(*numbers, strict=True)
        )
        if not same:
            differing.append(f"{lines[0]}\n{lines[1]}")
    return differing


def notebook_text(cells):
    """What the code of a notebook prints, as text."""
    outputs = [output for cell in cells.cells if cell.cell_type == "code" for output in cell.outputs]
    return "\n".join(output.text if "text" in output else output.data.get("text/plain", "") for output in outputs)
