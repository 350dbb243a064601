"""Pages from templates: everything put into them is escaped."""

import os
from typing import Any

import jinja2

from rsvib_torch.io import whole_file

__all__ = ["environment", "write_page"]


def environment(*folders: str | os.PathLike[str]) -> jinja2.Environment:
    """The templates of the package, and those of other folders."""
    loader = jinja2.ChoiceLoader(
        [jinja2.PackageLoader("rsvib_torch.report.html"), *(jinja2.FileSystemLoader(folder) for folder in folders)]
    )
    return jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )


def write_page(
    path: str | os.PathLike[str], template: str, content: dict[str, Any], *folders: str | os.PathLike[str]
) -> None:
    """Write a page; it appears whole or not at all.

    Args:
        path: The file to write.
        template: Name of the template.
        content: What it shows; text is escaped.
        folders: Where templates are looked for, besides the package's own.

    Raises:
        OSError: If the file cannot be written.
    """
    text = environment(*folders).get_template(template).render(**content)
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
