"""Fill the tables of README and docs/ from the JSON of commands, and from the parameters that the nodes declare.

    python -m tools.fill_pages report/bench.json recordings=scores.json ...

A table stands between `<!-- begin NAME -->` and `<!-- end NAME -->`. NAME is a template of docs/figures.yaml, the place
of a finished table such as `solvers.tables.tiers`, `machine.SOURCE` for what a source was measured on, or
`parameters.NODE`. In a template, `{grasp.rows.By force.low.peak/N|.2f}` is the number at that place, rows chosen by
their texts; `{mean(recordings.cases.*.mean_rmse_N)|1000*.1f}` is what several numbers say together, times 1000.

The first name of a place is its source: a key of a file (`solvers`, `grasp`), or what stands before `=`. The numbers
that pages need are kept in docs/figures.json, and replaced source by source.
"""

import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from fnmatch import filter as matching
from pathlib import Path
from statistics import mean, median
from typing import Any

import yaml

from finforce.settings import TimeParameters, describe, is_parameter
from finforce_contact.parameters import ContactParameters
from finforce_ifea.parameters import NodeParameters
from finforce_keypoints.parameters import DetectorParameters

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = (DOCS.parent / "README.md", *sorted(DOCS.glob("*.md")))
TEMPLATES, FIGURES = DOCS / "figures.yaml", DOCS / "figures.json"
_BLOCK = re.compile(r"(<!-- begin (?P<name>\S+) -->\n).*?(<!-- end (?P=name) -->)", re.DOTALL)
_FIELD = re.compile(r"\{(?P<place>[^{}|]+)\|(?:(?P<factor>[\d.]+)\*)?(?P<form>[^{}]*)\}")
_REDUCED = re.compile(r"(mean|median|min|max|sum)\((.*)\)")
_REDUCE = {"mean": mean, "median": median, "min": min, "max": max, "sum": sum}


def find_values(node: Any, place: Sequence[str]) -> Iterator[Any]:
    """Yield what nested figures hold at a place: keys, which may have `*`, entries of lists, or texts of records.

    Raises:
        LookupError: a key is not there, or no record has the text.
    """
    if not place:
        yield node
    elif isinstance(node, Mapping):
        for name in matching(node, place[0]) if "*" in place[0] else [place[0]]:
            yield from find_values(node[name], place[1:])
    elif place[0] == "*":
        for entry in node:
            yield from find_values(entry, place[1:])
    elif place[0].isdigit() and not isinstance(node[0], Mapping):
        yield from find_values(node[int(place[0])], place[1:])
    elif chosen := [record for record in node if place[0] in map(str, record.values())]:
        yield from find_values(chosen[0] if len(chosen) == 1 else chosen, place[1:])
    else:
        raise KeyError(place[0])


def read_value(figures: Mapping[str, Any], place: str) -> Any:
    """Return the number or text at a place, or what several numbers say together; see `find_values`.

    Raises:
        LookupError: it is not there.
    """
    reduced = _REDUCED.fullmatch(place)
    values = list(find_values(figures, (reduced[2] if reduced else place).split(".")))
    return _REDUCE[reduced[1]](values) if reduced and values else values[0]


def source_of(place: str) -> str:
    """Return the source of a place."""
    return (_REDUCED.fullmatch(place) or ("", "", place))[2].split(".")[0]


def list_places(templates: Mapping[str, str]) -> list[str]:
    """Return the places of all numbers and finished tables that pages need."""
    named = [match["name"] for page in PAGES for match in _BLOCK.finditer(page.read_text(encoding="utf-8"))]
    whole = [name for name in named if name not in templates and not name.startswith(("machine.", "parameters."))]
    return [*whole, *(match["place"] for text in templates.values() for match in _FIELD.finditer(text))]


def take_figures(known: Mapping[str, Any], found: Mapping[str, Any], places: Sequence[str]) -> dict[str, Any]:
    """Return the kept figures with those sources replaced that a file has.

    Args:
        known: machine and `values`, numbers and texts by place, of every source.
        found: content of a file, by source, with its `machine`.
        places: that pages need.

    Raises:
        LookupError: the file lacks a number of one of its sources.
    """
    taken = dict(known)
    for source in found.keys() - {"machine"}:
        values = {place: _round(read_value(found, place)) for place in places if source_of(place) == source}
        if values:
            taken[source] = {"machine": describe_machine(found["machine"]), "values": values}
    return dict(sorted(taken.items()))


def _round(value: Any) -> Any:
    return float(f"{value:.6g}") if isinstance(value, float) else value


def write_texts(known: Mapping[str, Any], templates: Mapping[str, str]) -> dict[str, str]:
    """Return the text of every block that the kept figures fill."""
    values = {place: value for source in known.values() for place, value in source["values"].items()}
    filled = {
        name: _FIELD.sub(lambda match: _format(values[match["place"]], match["factor"], match["form"]), text).rstrip()
        for name, text in templates.items()
        if all(match["place"] in values for match in _FIELD.finditer(text))
    }
    machines = {f"machine.{name}": source["machine"] for name, source in known.items()}
    return values | machines | filled


def _format(value: Any, factor: str | None, form: str) -> str:
    return "-" if value is None else format(value * float(factor) if factor else value, form)


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
        return ", ".join(
            f"{part:.4g}".replace("nan", "NaN") if isinstance(part, float) else f"`{part}`"
            for part in default
            if part != ""
        )
    return "NaN" if default != default else f"`{default}`" if default != "" else ""


def describe_machine(machine: Mapping[str, Any]) -> str:
    """Return what figures were measured on, in one sentence."""
    versions = ", ".join(f"{name} {machine[name]}" for name in ("numpy", "scipy", "numba") if name in machine)
    return (
        f"Measured at commit {machine['commit']} on {machine['processor']}, {machine['cores']} cores, "
        f"Python {machine['python']}, {versions}."
    )


def fill(page: str, texts: Mapping[str, str]) -> str:
    """Return a page with the texts that are known in their places; a table keeps the columns that the page shows.

    Of what is not known, only the head of a table stays.
    """
    return _BLOCK.sub(
        lambda match: f"{match[1]}{select_columns(texts[match['name']], match[0])}\n{match[3]}"
        if match["name"] in texts else f"{match[1]}{_empty(match[0])}{match[3]}", page
    )  # fmt: skip


def _empty(block: str) -> str:
    """Return a block's lines without figures."""
    lines = block.splitlines(keepends=True)[1:-1]
    return "".join(lines[:2]) if len(lines) > 1 and lines[1].startswith("|---") else ""


def select_columns(text: str, block: str) -> str:
    """Return a finished table with those columns that a block of a page shows, all if it shows none; else the text."""
    if ".tables." not in block.splitlines()[0]:
        return text
    rows = [row.split("|") for row in text.splitlines()]
    shown = [name.strip() for name in block.splitlines()[1].split("|")]
    kept = [place for place, name in enumerate(rows[0]) if name.strip() in shown]
    known = len(kept) > 2  # besides the ends of a row, which are empty
    return "\n".join("|".join(row[place] for place in kept) if known and row[1:] else "|".join(row) for row in rows)


def main() -> None:
    """Read the figures of files, keep them, fill the pages, say which tables stayed as they were."""
    templates = yaml.safe_load(TEMPLATES.read_text(encoding="utf-8"))
    known, places = json.loads(FIGURES.read_text(encoding="utf-8")), list_places(templates)
    for word in sys.argv[1:]:
        name, _, file = word.rpartition("=")
        found = json.loads(Path(file).read_text(encoding="utf-8"))
        try:
            known = take_figures(known, {name: found, "machine": found["machine"]} if name else found, places)
        except LookupError as missing:
            sys.exit(f"{file}: no {missing} in it; expected the output of a whole run of the command on the page")
    fill_pages(known)


def fill_pages(known: Mapping[str, Any]) -> None:
    """Keep the figures of all sources, and fill the pages with them; say which tables stay empty."""
    FIGURES.write_text(json.dumps(known, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    texts = list_parameters() | write_texts(known, yaml.safe_load(TEMPLATES.read_text(encoding="utf-8")))
    for path in PAGES:
        page = path.read_text(encoding="utf-8")
        path.write_text(fill(page, texts), encoding="utf-8")
        for match in _BLOCK.finditer(page):
            if match["name"] not in texts:
                print(f"{path.name}: {match['name']} is not in the figures, left empty")


if __name__ == "__main__":
    main()
