"""Fills the tables of docs/speed.md from the JSON of `finforce bench`.

    python benchmarks/speed_page.py [--json report/bench.json] [--page docs/speed.md]

A table stands between `<!-- begin NAME -->` and `<!-- end NAME -->`; NAME is a part of the benchmark, or one of its
tables, as `solvers.tiers`. What the JSON does not hold is left as it was, and said.
"""

import argparse
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
_BLOCK = re.compile(r"(<!-- begin (?P<name>\S+) -->\n).*?(<!-- end (?P=name) -->)", re.DOTALL)


def list_blocks(content: Mapping[str, Any]) -> dict[str, str]:
    """Returns the tables by the names under which a page asks for them."""
    blocks = {"machine": _describe(content.get("machine", {}))}
    for name, part in content.items():
        if name == "machine":
            continue
        if "not_measured" in part:
            blocks[name] = f"Not measured: {part['not_measured']}"
            continue
        blocks[name] = part["table"]
        blocks |= {f"{name}.{table}": text for table, text in part.get("tables", {}).items()}
        blocks |= {
            f"{name}.{number}": growth["table"] for number, growth in enumerate(part.get("growths", []), start=1)
        }
    if "tiers" in content.get("solvers", {}):
        blocks["solvers.fronts"] = _describe_fronts(content["solvers"])
    return blocks


def fill_page(page: str, blocks: Mapping[str, str]) -> str:
    """Returns a page with the blocks that are known in their places."""

    def fill(match: re.Match) -> str:
        text = blocks.get(match["name"])
        return match[0] if text is None else f"{match[1]}{_separate(text)}\n{match[3]}"

    return _BLOCK.sub(fill, page)


def name_places(page: str) -> list[str]:
    """Returns the names that a page asks for."""
    return [match["name"] for match in _BLOCK.finditer(page)]


def _separate(text: str) -> str:
    """Returns text with an empty line between a table and what follows, which would else be a row of it."""
    lines = text.splitlines()
    pairs = zip(lines, [*lines[1:], ""], strict=True)
    parts = [f"{line}\n" if line.startswith("|") and after and not after.startswith("|") else line
             for line, after in pairs]  # fmt: skip
    return "\n".join(parts)


def _describe(machine: Mapping[str, Any]) -> str:
    """Returns what the figures were measured on, in one sentence."""
    if not machine:
        return "Machine unknown."
    versions = ", ".join(f"{name} {machine[name]}" for name in ("numpy", "scipy", "numba") if name in machine)
    return (
        f"Measured at commit {machine['commit']} on {machine['processor']}, {machine['cores']} cores, Python "
        f"{machine['python']}, {versions}."
    )


def _describe_fronts(solvers: Mapping[str, Any]) -> str:
    """Returns which tiers are on the fronts."""
    names = {"exact": "noise-free", "noisy": "noisy"}
    lines = [f"- {names[kind]} key points: {', then '.join(front)}" for kind, front in solvers["fronts"].items()]
    return "\n".join(lines)


def main() -> None:
    """Reads, fills, writes and says what is missing."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", default=str(ROOT / "report" / "bench.json"), metavar="FILE")
    parser.add_argument("--page", default=str(ROOT / "docs" / "speed.md"), metavar="FILE")
    options = parser.parse_args()
    page = Path(options.page).read_text(encoding="utf-8")
    blocks = list_blocks(json.loads(Path(options.json).read_text(encoding="utf-8")))
    Path(options.page).write_text(fill_page(page, blocks), encoding="utf-8")
    missing = [name for name in name_places(page) if name not in blocks]
    print(f"{options.page}: filled from {options.json}")
    if missing:
        print(f"not in the figures, left as it was: {', '.join(missing)}")


if __name__ == "__main__":
    main()
