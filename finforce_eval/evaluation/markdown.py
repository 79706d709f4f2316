"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Sequence


def markdown_rows(head: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> list[str]:
    """Return the lines of a table whose first `texts` columns are words, the others numbers, to the right."""
    rule = "|---" * texts + "|---:" * (len(head) - texts) + "|"
    first, *rest = ("| " + " | ".join(row) + " |" for row in (head, *rows))
    return [first, rule, *rest]


def align_rows(head: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> str:
    """Returns a table whose columns are as wide as their widest cell; the first `texts` columns are words."""
    cells = [list(head), *(list(row) for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(head))]
    padded = [
        [cell.ljust(width) if column < texts else cell.rjust(width)
         for column, (cell, width) in enumerate(zip(row, widths, strict=True))]
        for row in cells
    ]  # fmt: skip
    return "\n".join(markdown_rows(padded[0], padded[1:], texts))
