"""Links and long description of the package: README.md without links that are relative to the repository.

The variable REPOSITORY_URL (https://HOST/OWNER/NAME, set by the hosted CI) makes them absolute; without it they become
plain text, and pictures are left out. Everything else is in pyproject.toml.
"""

import os
import re
from pathlib import Path

from setuptools import setup

ARTICLE = "https://doi.org/10.3390/s23135953"


def long_description(text: str, base: str | None) -> str:
    """Markdown whose relative links start with ``base``; None removes them.

    Args:
        text: Markdown with links relative to the repository.
        base: Address of the files of the repository, without a slash at the end.
    """

    def absolute(link: re.Match[str]) -> str:
        picture, words, target = link.groups()
        if "://" in target or target.startswith("#"):
            return link[0]
        if base is None:
            return "" if picture else words
        return f"{picture}[{words}]({base}/{target}{'?raw=true' if picture else ''})"

    return re.sub(r"(!?)\[([^\]]+)\]\(([^)\s]+)\)", absolute, text)


def links(repository: str | None) -> dict[str, str]:
    """Addresses that package indexes show."""
    if repository is None:
        return {"Article": ARTICLE}
    return {
        "Repository": repository,
        "Documentation": f"{repository}/tree/main/docs",
        "Issues": f"{repository}/issues",
        "Changelog": f"{repository}/blob/main/CHANGELOG.md",
        "Article": ARTICLE,
    }


if __name__ == "__main__":
    address = os.environ.get("REPOSITORY_URL", "").rstrip("/") or None
    readme = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
    setup(
        long_description=long_description(readme, address and f"{address}/blob/main"),
        long_description_content_type="text/markdown",
        project_urls=links(address),
    )
