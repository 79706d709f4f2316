"""Run the `finforce` commands of a page one after the other in a new folder, as a reader would.

    python -m tools.run_page docs/your_finger.md

FINGER.stl on the page is the included finger `umi`, as a surface. Prints the seconds of each command; ends with the
status of the first that fails.
"""

import json
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
import trimesh
from shapely import Polygon

import finforce_ifea

FINGER, JAWS = "FINGER.stl", Path(finforce_ifea.__file__).parent / "jaw" / "jaws"


def list_commands(page: Path) -> list[str]:
    """Return the commands of a page, without comments."""
    lines = re.findall(r"^ {4}(finforce .*)$", page.read_text(encoding="utf-8"), re.M)
    return [re.sub(r"\s+#\s.*", "", line) for line in lines]


def main() -> None:
    """Run the commands of a page."""
    page = Path(sys.argv[1]).resolve()
    with TemporaryDirectory() as folder:
        section = json.loads((JAWS / "umi.section.json").read_text(encoding="utf-8"))
        outline, *holes = sorted((np.array(loop) for loop in section["loops"]), key=lambda loop: -np.ptp(loop[:, 1]))
        trimesh.creation.extrude_polygon(Polygon(outline, holes), 25.8).export(Path(folder) / FINGER)
        for command in list_commands(page):
            began = perf_counter()
            print(f"$ {command}", flush=True)
            done = subprocess.run([sys.executable, "-m", "finforce_eval.cli.main", *command.split()[1:]], cwd=folder)
            print(f"  {perf_counter() - began:.1f} s", flush=True)
            if done.returncode:
                sys.exit(done.returncode)


if __name__ == "__main__":
    main()
