"""Tables in Markdown; knows no scores."""

from __future__ import annotations

from collections.abc import Sequence


def markdown_rows(head: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> list[str]:
    """Return the lines of a table whose first `texts` columns are words, the others numbers, to the right."""
    rule = "|---" * texts + "|---:" * (len(head) - texts) + "|"
    first, *rest = ("| " + " | ".join(row) + " |" for row in (head, *rows))
    return [first, rule, *rest]
