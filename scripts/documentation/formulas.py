"""Markdown extension: LaTeX formulas become MathML when the site is built, so that pages need no script.

Formulas are written as on code-hosting sites: ``$...$`` in a line, and blocks between the lines ```` ```math ```` and
```` ``` ````.
"""

import re

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor
from markdown.preprocessors import Preprocessor

__all__ = ["FormulaExtension", "makeExtension"]

# no space beside the inner side of a dollar sign, and no digit after the last one: "5 $ and 7 $" is not a formula
INLINE = r"(?<![\\$])\$(?![\s$])([^$\n]+?)(?<!\s)\$(?![\d$])"
BLOCK = re.compile(r"^```math\n(.*?)\n```$", flags=re.DOTALL | re.MULTILINE)


class _Inline(InlineProcessor):
    def handleMatch(  # type: ignore[override]  # noqa: N802
        self, m: re.Match[str], data: str
    ) -> tuple[str, int, int]:
        return self.md.htmlStash.store(convert(m[1])), m.start(0), m.end(0)


class _Blocks(Preprocessor):
    def run(self, lines: list[str]) -> list[str]:
        def stored(block: re.Match[str]) -> str:
            return self.md.htmlStash.store(f'<div class="formula">{convert(block[1], display="block")}</div>')

        return BLOCK.sub(stored, "\n".join(lines)).split("\n")


class FormulaExtension(Extension):
    """Formulas in Markdown become MathML."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802
        """Add the two processors."""
        md.preprocessors.register(_Blocks(md), "formula_blocks", 26)  # before fenced code (25)
        md.inlinePatterns.register(_Inline(INLINE, md), "formulas", 185)  # after code in backticks (190)


def makeExtension(**options: object) -> FormulaExtension:  # noqa: N802
    """The extension, by the name that Markdown requires."""
    return FormulaExtension(**options)
