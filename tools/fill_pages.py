"""Fill the tables of the pages in docs/ from the JSON of benchmarks, and from the parameters that the nodes declare.

    python -m tools.fill_pages report/*.json

A table stands between `<!-- begin NAME -->` and `<!-- end NAME -->`; NAME is its place in the figures, as
`solvers.tables.tiers`, `machine.NAME` for what the part NAME was measured on, or `parameters.NODE`. What is not known
stays as it was.
"""

import json
import re
import sys
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from finforce.settings import TimeParameters, describe, is_parameter
from finforce_contact.parameters import ContactParameters
from finforce_ifea.parameters import NodeParameters
from finforce_keypoints.parameters import DetectorParameters

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


def list_parameters() -> dict[str, str]:
    """Return a table of parameters for every node, without those of its parts and those that all nodes have."""
    records = {
        "all": TimeParameters,
        "ifea_solver": NodeParameters,
        "contact_estimator": ContactParameters,
        "keypoint_detector": DetectorParameters,
    }
    shared = {entry.name for entry in fields(TimeParameters)}
    return {
        f"parameters.{node}": "\n".join(
            [
                "| parameter | default | meaning |",
                "|---|---|---|",
                *(
                    f"| `{entry.name}` | {_show(entry.default)} | {describe(entry).replace('<', '&lt;')} |"
                    for entry in filter(is_parameter, fields(record))
                    if node == "all" or entry.name not in shared
                ),
            ]
        )
        for node, record in records.items()
    }


def _show(default: Any) -> str:
    """Return a default as a table shows it."""
    if isinstance(default, tuple):
        return ", ".join(f"{part:.4g}" if isinstance(part, float) else f"`{part}`" for part in default if part != "")
    return "NaN" if default != default else f"`{default}`" if default != "" else ""


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
    """Return a page with the texts that are known in their places; a table keeps the columns that the page shows."""
    return _BLOCK.sub(
        lambda match: f"{match[1]}{select_columns(texts[match['name']], match[0])}\n{match[3]}"
        if match["name"] in texts else match[0], page
    )  # fmt: skip


def select_columns(text: str, block: str) -> str:
    """Return a table with those of its columns that a block of a page shows; all of them if it shows none."""
    rows = [row.split("|") for row in text.splitlines()]
    shown = [name.strip() for name in block.splitlines()[1].split("|")]
    kept = [place for place, name in enumerate(rows[0]) if name.strip() in shown]
    known = len(kept) > 2  # besides the ends of a row, which are empty
    return "\n".join("|".join(row[place] for place in kept) if known and row[1:] else "|".join(row) for row in rows)


def main() -> None:
    """Read the figures, fill the pages, say which tables stayed as they were."""
    texts = list_parameters()
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
