"""Fill the tables of the pages in docs/ from the JSON of benchmarks: `tools/fill_pages.py report/*.json`.

A table stands between `<!-- begin NAME -->` and `<!-- end NAME -->`; NAME is its place in the figures, as
`solvers.tables.tiers`, or `machine.NAME` for what the part NAME was measured on. What no file holds stays as it was.
"""

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1] / "docs"
_BLOCK = re.compile(r"(<!-- begin (?P<name>\S+) -->\n).*?(<!-- end (?P=name) -->)", re.DOTALL)


def list_texts(figures: Mapping[str, Any], path: str = "") -> dict[str, str]:
    """Return every text in nested figures by its place."""
    texts = {}
    for name, value in figures.items():
        if isinstance(value, Mapping):
            texts |= list_texts(value, f"{path}{name}.")
        elif isinstance(value, str):
            texts[f"{path}{name}"] = value
    return texts


def describe_machine(machine: Mapping[str, Any]) -> str:
    """Return what figures were measured on, in one sentence."""
    versions = ", ".join(f"{name} {machine[name]}" for name in ("numpy", "scipy", "numba") if name in machine)
    return (
        f"Measured at commit {machine['commit']} on {machine['processor']}, {machine['cores']} cores, "
        f"Python {machine['python']}, {versions}."
    )


def read_texts(path: Path) -> dict[str, str]:
    """Return the texts of one file, with a sentence on its machine for each part."""
    figures = json.loads(path.read_text(encoding="utf-8"))
    machine = figures.pop("machine", None)
    sentence = {f"machine.{name}": describe_machine(machine) for name in figures} if machine else {}
    return list_texts(figures) | sentence


def fill(page: str, texts: Mapping[str, str]) -> str:
    """Return a page with the texts that are known in their places."""
    return _BLOCK.sub(
        lambda match: f"{match[1]}{texts[match['name']]}\n{match[3]}" if match["name"] in texts else match[0], page
    )


def main() -> None:
    """Read the figures, fill the pages, say which tables stayed as they were."""
    texts: dict[str, str] = {}
    for name in sys.argv[1:]:
        texts |= read_texts(Path(name))
    for path in sorted(DOCS.glob("*.md")):
        page = path.read_text(encoding="utf-8")
        path.write_text(fill(page, texts), encoding="utf-8")
        for match in _BLOCK.finditer(page):
            if match["name"] not in texts:
                print(f"{path.name}: {match['name']} is not in the figures, left as it was")


if __name__ == "__main__":
    main()
