"""Hooks of mkdocs: a link out of docs/ becomes text that names the file; equations become MathML."""

import re
from html import unescape
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

ROOT = Path(__file__).resolve().parents[1]
_LINK = re.compile(r"\[([^\]\[]+)\]\((?:\.\./)+([^)#\s]+)\)")
_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return a page without its links out of docs/; a link to a missing file stays, and mkdocs rejects it."""
    return _LINK.sub(_name_file, markdown)


def _name_file(link: re.Match[str]) -> str:
    """Return the text of a link, with the path of its file where the text does not name it."""
    text, path = link.groups()
    if not (ROOT / path).exists():
        return link[0]
    return text if path in text else f"{text} (`{path}`)"


def on_page_content(html: str, **_: Any) -> str:
    """Return a page with its LaTeX as MathML, which browsers show without a script."""
    return _EQUATION.sub(_write_equation, html)


def _write_equation(match: re.Match[str]) -> str:
    """Return one equation, in the line or as a block."""
    latex = unescape(match[2]).strip()
    return convert(latex) if match[1] == "span" else f"<p>{convert(latex, display='block')}</p>"
