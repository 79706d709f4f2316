"""Measure the figures of README and docs/ at one commit, part by part, and fill the pages: `make figures`.

    python -m tools.measure_pages [PART ...] [--recordings FOLDER] [--network FILE]

A part whose JSON is of this commit is not repeated, so that a stopped run goes on. Tables of sources that none of the
parts has at this commit are emptied: nothing is kept from an older one. With parts named, the others stay.
"""

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from finforce_eval.machine import commit
from tools.fill_pages import DOCS, FIGURES, TEMPLATES, fill_pages, list_places, take_figures

REPORT = DOCS.parent / "report"
BENCH, STEEL = "finforce_eval/data/bench_cyl25_middle", "finforce_eval/data/steel_r20"
SCENES = {
    "cylinder": "grasp_cylinder",
    "cube": "grasp_cube",
    "asymmetric": "grasp_asymmetric",
    "shifting": "shifting",
    "fast_close": "fast_close",
    "bench_middle": "bench_cylinder",
    "bench_lower": "bench_cylinder_lower",
    "weight": "weight_turn",
    "weight_dim": "weight_turn_dim",
    "bottle": "grasp_cylinder --object bottle --set scale=0.45 --set turn_x=1.5708",
}
BAGS = " ".join(f"{{report}}/bags/{name}" for name in SCENES)
RENDERED = "; ".join(f"twin record {scene} --seed 101 -o {{report}}/bags/{name}" for name, scene in SCENES.items())
EXPERIMENTS = ("grasp", "friction", "pose", "manipulation", "chip", "places")
# Commands of each part, one after the other; the last one writes the JSON.
PARTS = {
    "solvers": "bench --parts solvers --figure docs/images/pareto.png --json {json}",
    "chain": "bench --parts chain --json {json}",
    "ablation": "ablation --json {json}",
    "stress": "stress --count 12 --json {json}",
    **{name: f"experiment {name} --report {{report}}" for name in EXPERIMENTS},
    "network": "experiment network --network {network} --report {report}",
    "bound": f"bound {BENCH} --calibration bench --json {{json}}",
    **{
        f"contact_{mode}": f"evaluate {BENCH} --calibration bench --contact {mode} --json {{json}}"
        for mode in ("estimate", "closest", "paper")
    },
    "datasheet": f"evaluate {BENCH} --contact fixed:case --json {{json}}",
    "sensor": f"evaluate {BENCH} --contact fixed:case --calibration bench --json {{json}}",
    "steel": f"evaluate {STEEL} --jaw steel --json {{json}}",
    "scenes_images": f"{RENDERED}; evaluate {BAGS} --calibration twin --from images --json {{json}}",
    "scenes_truth": f"evaluate {BAGS} --calibration twin --from truth --json {{json}}",
    "recordings": "evaluate {recordings} --contact estimate --calibration bench --json {json}",
}


def find_json(part: str, report: Path) -> Path:
    """Return the file that a part writes."""
    is_experiment = part == "network" or part in EXPERIMENTS
    return report / part / f"{part}.json" if is_experiment else report / f"{part}.json"


def read_measured(part: str, report: Path) -> dict[str, Any] | None:
    """Return the JSON of a part where it is of this commit, as sources with their machine; else None."""
    path = find_json(part, report)
    found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if found.get("machine", {}).get("commit") != commit():
        return None
    return found if part in found else {part: found, "machine": found["machine"]}


def measure(part: str, report: Path, given: Mapping[str, str]) -> bool:
    """Run the commands of a part and return whether they all succeeded."""
    words = {"json": str(find_json(part, report)), "report": str(report), **given}
    for command in PARTS[part].format(**words).split("; "):
        print(f"{part}: finforce {command}", flush=True)
        if subprocess.run([sys.executable, "-m", "finforce_eval.cli.main", *shlex.split(command)]).returncode:
            return False
    return True


def list_stale(known: Mapping[str, Any], repository: Path = DOCS.parent) -> list[str]:
    """Return the sources of kept figures that are not of the last release or later; none before the first release."""
    tag = _ask_git(repository, "describe", "--tags", "--abbrev=0")
    if not tag:
        return []
    words = {source: figures["machine"].partition("at commit ")[2].split() for source, figures in known.items()}
    commits = {source: word[0].partition("-dirty")[0] if word else "" for source, word in words.items()}
    return [
        source
        for source, name in commits.items()
        if not name or _ask_git(repository, "merge-base", "--is-ancestor", tag, name) is None
    ]


def _ask_git(repository: Path, *words: str) -> str | None:
    """Return what git says, None where it fails or is absent."""
    try:
        done = subprocess.run(["git", *words], cwd=repository, capture_output=True, check=True, text=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the parts that are not of this commit, and fill the pages with those that are."""
    parser = argparse.ArgumentParser(prog="python -m tools.measure_pages", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)} (all)")
    parser.add_argument("--recordings", default="", help="folder of bench recordings (none: without their tables)")
    parser.add_argument("--network", default="", help="checkpoint of lab.training.baseline (none: without its table)")
    options = parser.parse_args(arguments)
    if unknown := set(options.parts) - PARTS.keys():
        parser.error(f"unknown parts {', '.join(sorted(unknown))}; expected some of {', '.join(PARTS)}")
    bags = sorted(Path(options.recordings).glob("*")) if options.recordings else []
    given = {"recordings": shlex.join(map(str, bags)), "network": shlex.quote(options.network)}
    missing = {name for name in given if not getattr(options, name)}
    kept = json.loads(FIGURES.read_text(encoding="utf-8")) if options.parts else {}
    places = list_places(yaml.safe_load(TEMPLATES.read_text(encoding="utf-8")))
    for number, part in enumerate(options.parts or PARTS, 1):
        print(f"[{number}/{len(options.parts or PARTS)}] {part}", flush=True)
        if read_measured(part, REPORT) is None and not any(f"{{{name}}}" in PARTS[part] for name in missing):
            measure(part, REPORT, given)
        found = read_measured(part, REPORT)
        if found is None:
            print(f"{part}: not measured at this commit, its tables are left empty", file=sys.stderr)
            kept.pop(part, None)
        else:
            kept = take_figures(kept, found, places)
    fill_pages(kept)


if __name__ == "__main__":
    main()
