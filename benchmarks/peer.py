"""Measures what the comparison with the peer needs and fills the table of docs/peer.md.

    python benchmarks/peer.py [--bench report/bench.json] [--stress report/stress.json] [--json report/peer.json]
                              [--measured report/peer.json] [--page docs/peer.md]

It measures steps beside a SuperLU factorisation, errors, starts, memory and what is installed in the environment that
it runs in (two minutes), and takes the chain, recordings and stress from the JSON of `finforce bench` and `finforce
stress`. With --measured it measures nothing and fills the page from an earlier run.
"""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from peer_measure import DEFAULT, FULL, OUTLINE, measure_all
from peer_rows import HEAD, Figures, join_names, list_rows
from speed_page import fill_page, name_places

from finforce_eval.bench.solvers import SOFA
from finforce_eval.evaluation.machine import describe_machine, write_figures
from finforce_eval.evaluation.markdown import markdown_rows

ROOT = Path(__file__).resolve().parents[1]
RATE_AIM, ERROR_AIM = 80.0, 0.1
_SOURCES = {"own": "`benchmarks/peer.py`", "bench": "`finforce bench`", "stress": "`finforce stress`"}


def read_figures(path: Path | str) -> dict[str, Any]:
    """Returns the figures of a JSON file; none when there is no such file."""
    path = Path(path)
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def list_blocks(figures: Figures) -> dict[str, str]:
    """Returns what stands between the marks of the page, by name."""
    return {
        "peer.aim": describe_aim(figures),
        "peer.table": "\n".join(markdown_rows(HEAD, list_rows(figures), texts=len(HEAD))),
        "peer.sources": "\n".join(_describe_sources(figures)),
    }


def describe_aim(figures: Figures) -> str:
    """Returns whether the aim is met, and by how much not, as a list in Markdown."""
    default, outline = figures.tier(DEFAULT), figures.tier(OUTLINE)
    return "\n".join(
        [
            f"- **{RATE_AIM:g} times SOFA's rate: {_judge_rate(figures.rate(DEFAULT))}.** With the object's outline: "
            f"{figures.rate(OUTLINE):.0f} times; the full solid, 522 vertices: {figures.rate(FULL):.1f} times.",
            f"- **A tenth of its error ({ERROR_AIM * SOFA['factor_per_height_N']:.3f} N): "
            f"{_judge_error(figures.error_share(DEFAULT))}**, nothing fitted against SOFA's best after a factor per "
            f"height, over the {default['shapes']['solved']} of {default['shapes']['n']} shapes that were answered. "
            f"With the object's outline ({outline['shapes']['solved']} answered): "
            f"{_judge_error(figures.error_share(OUTLINE))}.",
            f"- SOFA answers all 45. Not answered here: {join_names(default['unanswered'])}; with the outline: "
            f"{join_names(outline['unanswered'])}. SOFA is worst at the lower height, too: 1.28 N; Ø35: 1.86 N.[^sofa]",
        ]
    )


def _judge_rate(rate: float) -> str:
    met = "met" if rate >= RATE_AIM else f"missed by a factor of {RATE_AIM / rate:.1f}"
    return f"{met}, {rate:.0f} times"


def _judge_error(share: float) -> str:
    met = "met" if share <= ERROR_AIM else f"missed by a factor of {share / ERROR_AIM:.1f}"
    return f"{met}, {100 * share:.0f} % of it"


def _describe_sources(figures: Figures) -> list[str]:
    """Returns the footnotes of what was measured: by what, at which commit, on which machine."""
    contents = {"own": figures.own, "bench": figures.bench, "stress": figures.stress}
    return [f"[^{name}]: {_SOURCES[name]}, {_describe(content)}" for name, content in contents.items() if content]


def _describe(content: Mapping[str, Any]) -> str:
    machine = content["machine"]
    words = f"commit {machine['commit']}, {machine['processor']}, {machine['cores']} cores, Python {machine['python']}"
    if "tiers" in content:
        missing = sorted({*content["core"]["missing"], *content["full"]["missing"]})
        words += f"; not installed there and in no size: {', '.join(missing)}" if missing else ""
    if "plan" in content:
        words += f"; solver {content['plan']['solver']}, seed {content['plan']['seed']}"
    return words + "."


def main() -> None:
    """Measures or reads, fills the page and says what it asks for in vain."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bench", default=str(ROOT / "report" / "bench.json"), metavar="FILE")
    parser.add_argument("--stress", default=str(ROOT / "report" / "stress.json"), metavar="FILE")
    parser.add_argument("--json", default=str(ROOT / "report" / "peer.json"), metavar="OUT", help="what was measured")
    parser.add_argument("--measured", metavar="FILE", help="figures of an earlier run; nothing is measured")
    parser.add_argument("--page", default=str(ROOT / "docs" / "peer.md"), metavar="FILE")
    options = parser.parse_args()
    if options.measured:
        own = read_figures(options.measured)
    else:
        own = {"machine": describe_machine(), **measure_all()}
        write_figures(options.json, own)
    figures = Figures(own=own, bench=read_figures(options.bench), stress=read_figures(options.stress))
    page, blocks = Path(options.page), list_blocks(figures)
    text = page.read_text(encoding="utf-8")
    page.write_text(fill_page(text, blocks), encoding="utf-8")
    print(f"{page}: filled")
    for name in sorted(set(name_places(text)) - set(blocks)):
        print(f"nothing to fill in: {name}")
    for name in ("bench", "stress"):
        if not getattr(figures, name):
            print(f"no figures of finforce {name}: {getattr(options, name)} does not exist")


if __name__ == "__main__":
    main()
