"""Hooks of mkdocs: links to files outside docs/, which the site does not hold, become text; equations become MathML."""

import re
from html import unescape
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

ROOT = Path(__file__).resolve().parents[1]
_LINK = re.compile(r"\[([^\]\[]+)\]\(\.\./([^)#\s]+)\)")
_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return a page without its links out of docs/; one to a file that does not exist stays, and mkdocs refuses it."""
    return _LINK.sub(lambda match: match[1] if (ROOT / match[2]).exists() else match[0], markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Return a page with its LaTeX as MathML, which browsers show without a script."""
    return _EQUATION.sub(_write_equation, html)


def _write_equation(match: re.Match[str]) -> str:
    """Return one equation, in the line or as a block."""
    latex = unescape(match[2]).strip()
    return convert(latex) if match[1] == "span" else f"<p>{convert(latex, display='block')}</p>"
