"""Jaw files of random fingers, to judge a network on grasps: `python -m lab.training.jaw_files FOLDER --count 10`.

The fingers are those of the validation's seeds. Each is written as a section alone, and its jaw file is made of that as
a user's would be: what `finforce jaw` refuses is left out, and named. Grasps of them, from images to forces:

    finforce bench RECORDINGS --parts images --quick --jaw FOLDER/a.yaml,FOLDER/b.yaml
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import numpy as np

from finforce_eval.cli.parser import whole_number
from finforce_ifea.errors import JawFileError
from finforce_ifea.jaw.cad.make_jaw import make_jaw
from finforce_ifea.jaw.cad.recognition import Overrides
from finforce_ifea.jaw.section import order_rings
from lab.training.commands import one_line_errors
from lab.training.fingers import FIRST_VALIDATION, SEED, Finger, draw_finger

LEAST_CLAMP = 4e-3  # m of a finger that a holder keeps; those that stand on it are none of a gripper's
LONGEST = 0.1  # m of a finger that the camera on the twin's wrist sees as a whole


def main(arguments: Sequence[str] | None = None) -> None:
    """Write jaw files until there are enough."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.jaw_files", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the jaw files")
    parser.add_argument("--count", type=whole_number(1, 10**6), default=10, help="jaw files (10)")
    parser.add_argument(
        "--first", type=whole_number(0, 10**9), default=30000, help="number of the first finger, as of `scenes` (30000)"
    )
    options = parser.parse_args(arguments)
    with one_line_errors():
        write_jaws(options.folder, options.count, options.first)


def write_jaws(folder: Path, wanted: int, first: int) -> list[Path]:
    """Write jaw files of random fingers of one width, held at their base and not too long; return their paths.

    Args:
        folder: of the files.
        wanted: how many.
        first: number of the first finger among those of the validation.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for number in count(first):
        if len(written) == wanted:
            return written
        finger = draw_finger(np.random.default_rng((SEED, FIRST_VALIDATION + number)))
        path = folder / f"random_{number}.yaml"
        if finger.has_hinges or finger.taper or finger.clamped_z < LEAST_CLAMP or finger.length > LONGEST:
            continue
        try:
            make_jaw(
                write_section(finger, folder / f"random_{number}.json"),
                path,
                name=path.stem,
                overrides=Overrides(clamp_z=finger.clamped_z),
            )
        except JawFileError as error:
            print(f"left out: {error}")
            continue
        written.append(path)
        print(path)
    return written


def write_section(finger: Finger, path: Path) -> Path:
    """Write a finger's section as `finforce jaw` reads it; return where."""
    loops = [(1e3 * ring).tolist() for ring in order_rings(finger.polygon)]
    path.write_text(json.dumps({"unit": "mm", "width": 1e3 * finger.width, "loops": loops}), encoding="utf-8")
    return path


if __name__ == "__main__":
    main()
