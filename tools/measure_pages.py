"""Measure the figures of README and docs/ at one commit, part by part, and fill the pages: `make figures`.

A part whose JSON is of this commit is not repeated, so that a stopped run goes on. Tables of what no part has at this
commit are emptied: nothing is kept from an older one. With parts named, the others stay.
"""

import argparse
import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from finforce_eval.machine import commit
from tools.fill_pages import DOCS, FIGURES, TEMPLATES, fill_pages, list_places, take_figures

REPORT = DOCS.parent / "report"
BENCH, STEEL = "finforce_eval/data/bench_cyl25_middle", "finforce_eval/data/steel_r20"
GRAMS = "82,159,236,315,398,307,225,146,69"  # a scale's readings of the holds of BENCH, by its true forces
SCENES = {  # of the recordings of docs/results.md
    **{name: f"grasp_{name}" for name in ("cylinder", "cube", "asymmetric")},
    **{name: name for name in ("shifting", "fast_close")},
    **{"bench_middle": "bench_cylinder", "bench_lower": "bench_cylinder_lower"},
    **{"weight": "weight_turn", "weight_dim": "weight_turn_dim"},
    "bottle": "grasp_cylinder --object bottle --set scale=0.45 --set turn_x=1.5708",
}
CAMERAS = {"d405": "", "tips": "--camera front", "webcam": "--lens webcam", "fisheye": "--lens fisheye"}
FINGERS = ("ssg48_fin_ray_1", "ssg48_fin_ray_3", "xlerobot", "umi")


def _render(scenes: Mapping[str, str]) -> str:
    """Return the commands that render scenes by the names of their recordings."""
    return "; ".join(f"twin record {scene} -o {{report}}/bags/{name}" for name, scene in scenes.items())


def _list_bags(names: Iterable[str]) -> str:
    """Return recordings by their names, as arguments."""
    return " ".join(f"{{report}}/bags/{name}" for name in names)


def _list_finger_parts(jaw: str) -> dict[str, str]:
    """Return the parts of a finger: a grasp in images and with its true key points, calibrated by these."""
    bag, calibration = f"{{report}}/bags/{jaw}", f"{{report}}/bags/{jaw}.yaml"
    evaluate = f"evaluate {bag} --jaw {jaw} --calibration {calibration} --json {{json}}"
    scene = {jaw: f"grasp_cylinder --seed 101 --light bright --jaw {jaw}"}
    calibrate = f"calibrate {bag} --jaw {jaw} --from truth -o {calibration}"
    return {
        f"{jaw}_truth": f"{_render(scene)}; {calibrate}; {evaluate} --from truth",
        f"{jaw}_images": f"{evaluate} --from images",
    }


# Recordings of --recordings that a part takes, by patterns of their names.
GIVEN = {
    "cylinders": ("mooney_cyl*",),
    "small": ("mooney_cyl15*",),
    "realistic": ("friction03_*", "spatial_*", "mooney_box*"),
    "bounded": ("mooney_*", "friction*"),
}
PICTURE = "pareto.png"  # of solvers
# Commands of each part, one after the other; the last one writes the JSON. None changes a file of the repository, for
# what follows would be of another commit.
PARTS = {
    "solvers": f"bench --parts solvers --figure {{report}}/{PICTURE} --json {{json}}",
    "chain": "bench --parts chain --json {json}",
    "ablation": "ablation --json {json}",
    "stress": "stress --count 12 --json {json}",
    **{name: f"experiment {name} --report {{report}}" for name in ("grasp", "friction", "manipulation", "chip")},
    "places": "experiment places --on {small} --calibration bench --report {report}",
    "network": "experiment network --network {network} --report {report}",
    "bound": "bound {bounded} --calibration bench --json {json}",
    **{
        f"contact_{mode}": f"evaluate {BENCH} --calibration bench --contact {mode} --json {{json}}"
        for mode in ("estimate", "closest", "paper")
    },
    "datasheet": f"evaluate {BENCH} --contact fixed:case --json {{json}}",
    "sensor": f"evaluate {BENCH} --contact fixed:case --calibration bench --json {{json}}",
    "steel": f"evaluate {STEEL} --jaw steel --stills --json {{json}}",
    "weighed": f"weigh {BENCH} --contact fixed:case --grams {GRAMS} -o {{report}}/weighed.yaml; "
    f"evaluate {BENCH} --contact fixed:case --calibration {{report}}/weighed.yaml --json {{json}}",
    "scenes_images": f"{_render({name: f'{scene} --seed 101' for name, scene in SCENES.items()})}; "
    f"evaluate {_list_bags(SCENES)} --calibration twin --from images --json {{json}}",
    "scenes_truth": f"evaluate {_list_bags(SCENES)} --calibration twin --from truth --json {{json}}",
    "camera": f"{_render({name: f'grasp_cylinder --seed 7 {camera}' for name, camera in CAMERAS.items()})}; "
    f"evaluate {_list_bags(('d405', 'tips'))} --calibration twin --from images --json {{json}}",
    "camera_plain": f"evaluate {_list_bags(('d405', 'webcam', 'fisheye'))} --calibration twin --from images "
    "--detector depth=none --json {json}",
    **{part: commands for jaw in FINGERS for part, commands in _list_finger_parts(jaw).items()},
    **{
        name: f"evaluate {{{given}}} --contact estimate --calibration bench --json {{json}}"
        for name, given in (("recordings", "cylinders"), ("realistic", "realistic"))
    },
}


def read_measured(part: str) -> dict[str, Any] | None:
    """Return the JSON of a part where it is of this commit, as sources with their machine; else None."""
    path = _find_json(part)
    found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if found.get("machine", {}).get("commit") != commit():
        return None
    return found if part in found else {part: found, "machine": found["machine"]}


def _find_json(part: str) -> Path:
    return REPORT / part / f"{part}.json" if PARTS[part].startswith("experiment") else REPORT / f"{part}.json"


def measure(part: str, given: Mapping[str, str]) -> None:
    """Run the commands of a part, until one fails; scenes are rendered anew."""
    for command in PARTS[part].format(json=_find_json(part), report=REPORT, **given).split("; "):
        if command.startswith("twin record"):
            shutil.rmtree(shlex.split(command)[-1], ignore_errors=True)
        print(f"finforce {command}", flush=True)
        if subprocess.run([sys.executable, "-m", "finforce_eval.cli.main", *shlex.split(command)]).returncode:
            return


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the parts that are not of this commit, and fill the pages with those that are."""
    parser = argparse.ArgumentParser(prog="python -m tools.measure_pages", description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], metavar="PART", help=f"of {', '.join(PARTS)} (all)")
    parser.add_argument("--recordings", default="", help="folder of bench recordings (none: without their tables)")
    parser.add_argument("--network", default="", help="checkpoint of lab.training.baseline (none: without its table)")
    options = parser.parse_args(arguments)
    given = {"network": options.network and shlex.quote(options.network)}
    for name, patterns in GIVEN.items():
        bags = [bag for pattern in patterns for bag in sorted(Path(options.recordings).glob(f"{pattern}/"))]
        given[name] = shlex.join(map(str, bags)) if options.recordings else ""
    kept = json.loads(FIGURES.read_text(encoding="utf-8")) if options.parts else {}
    places = list_places(yaml.safe_load(TEMPLATES.read_text(encoding="utf-8")))
    REPORT.mkdir(exist_ok=True)
    for part in options.parts or PARTS:
        lacks = [name for name, value in given.items() if f"{{{name}}}" in PARTS[part] and not value]
        if read_measured(part) is None and not lacks:
            measure(part, given)
        if found := read_measured(part):
            kept = take_figures(kept, found, places)
        else:
            print(f"{part}: not measured at this commit, its tables are left empty", file=sys.stderr)
            kept.pop(part, None)
    fill_pages(kept)
    if read_measured("solvers") and (REPORT / PICTURE).exists():
        shutil.copy(REPORT / PICTURE, DOCS / "images" / PICTURE)


if __name__ == "__main__":
    main()
