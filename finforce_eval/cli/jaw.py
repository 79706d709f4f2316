"""`finforce jaw`: from the file of a printed finger to a jaw file."""

from __future__ import annotations

import argparse
import time
from dataclasses import fields
from pathlib import Path

from finforce_eval.cli.parser import CommandResult, length_mm, picture_file
from finforce_eval.errors import OptionError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    from finforce_ifea.jaw.jaw_file import MATERIALS
    from finforce_ifea.jaw.section import UNITS

    parser.add_argument("file", type=Path, help="finger: .stl or another surface, .step, .dxf, .svg, .json, or a photo")
    parser.add_argument("-o", "--output", type=Path, help="jaw file to write (FILE.yaml)")
    parser.add_argument("--name", help="name of the finger (that of the file)")
    parser.add_argument("--unit", choices=tuple(UNITS), help="unit of the file (from the size of the finger)")
    text = "scale of a photo: two marks of the ruler [px] and the millimetres between them, or millimetres per pixel"
    parser.add_argument("--scale", dest="unit", metavar="X1,Y1,X2,Y2=MM", help=text)
    parser.add_argument("--body", type=int, metavar="N", help="number of the body, from 1")
    parser.add_argument("--width", type=length_mm, metavar="MM", help="width along y [mm], for drawings, photos")
    parser.add_argument("--material", default="tpu95a", choices=tuple(MATERIALS), help="material (tpu95a)")
    parser.add_argument(
        "--clamp",
        dest="clamp_z",
        type=length_mm,
        metavar="MM",
        help="height of the clamp at the inner face, parallel to a tilted base [mm]",
    )
    parser.add_argument("--face-x", type=length_mm, metavar="MM", help="x of the inner face in the jaw frame [mm]")
    parser.add_argument(
        "--flip", action=argparse.BooleanOptionalAction, help="the wider end is, or is not, the tip; if about as wide"
    )
    parser.add_argument("--other-face", action="store_true", help="take the other side as the inner face")
    parser.add_argument(
        "--solid", action="store_true", help="take a closed solid as it is, whatever its shape, in layers of its width"
    )
    text = "picture to draw (next to the jaw file, .png)"
    parser.add_argument("--picture", type=lambda name: Path(picture_file(name)), help=text)


def run(options: argparse.Namespace) -> CommandResult:
    """Read a finger, say what was found, and write jaw file, section and picture."""
    from finforce_ifea.jaw.cad.make_jaw import make_jaw
    from finforce_ifea.jaw.cad.recognition import Overrides
    from finforce_ifea.jaw.jaw import Jaw

    def measure_warping(jaw: Jaw) -> float:
        from finforce_ifea import mechanics  # half a second, asked of layers only

        return mechanics.measure_warping(jaw)

    if options.file.suffix in (".yaml", ".yml"):
        raise OptionError(f"{options.file}: is a jaw file already, for --jaw; expected a finger to make one of")
    started = time.monotonic()
    output = options.output or Path(f"{options.file.stem}.yaml")
    files, notes = make_jaw(
        options.file,
        output,
        Overrides(**{entry.name: getattr(options, entry.name) for entry in fields(Overrides)}),
        material=options.material,
        picture=options.picture,
        measure_warping=measure_warping,
    )
    for note in notes:
        print(f"  {note}")
    print(f"{', '.join(str(path) for path in files)}, {time.monotonic() - started:.1f} s")
    return CommandResult({"files": [str(path) for path in files], "notes": notes})
