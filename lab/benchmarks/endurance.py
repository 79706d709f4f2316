"""Grasps from images through all stages in one process for a time of your own; table, JSON, picture.

    python -m lab.benchmarks.endurance [--minutes 60] [--json OUT] [--picture OUT.png]

It is the part `endurance` of `finforce bench`. Nothing else should run meanwhile; the table says what did.
"""

import argparse

from finforce_eval.machine import write_figures
from lab.bench.endurance import MINUTES, as_json, draw, format_table, measure


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"of grasps on end ({MINUTES:g})")
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument("--picture", metavar="OUT", help="draw them")
    options = parser.parse_args()
    figures = measure(False, minutes=options.minutes)
    print(format_table(figures))
    if options.json:
        write_figures(options.json, as_json(figures))
    if options.picture:
        draw(figures, options.picture)


if __name__ == "__main__":
    main()
