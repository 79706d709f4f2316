"""A hook of mkdocs: links from a page to files of the repository, which the site does not hold, become plain text."""

import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
_LINK = re.compile(r"\[([^\]\[]+)\]\(\.\./([^)#\s]+)\)")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return a page without its links out of docs/; one to a file that does not exist stays, and mkdocs refuses it."""
    return _LINK.sub(lambda match: match[1] if (ROOT / match[2]).exists() else match[0], markdown)
