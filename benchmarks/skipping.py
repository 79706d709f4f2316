"""CPU time of each node on three scenes, with the rules of what need not be done and without; table, JSON, picture.

    python benchmarks/skipping.py [--json OUT] [--picture OUT.png] [--seconds 10] [--solver NAME]

It renders one grasp (two minutes, kept in the user's cache) and runs all nodes twice for half a minute. Nothing else
should run meanwhile; the table says what did.
"""

import argparse

from finforce_eval.bench import write_figures
from finforce_eval.bench_skipping import as_json, draw, format_table, measure


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument("--picture", metavar="OUT", help="draw them")
    parser.add_argument("--seconds", type=float, default=10.0, help="of idling and of holding that are measured (10)")
    parser.add_argument("--solver", default="", help="tier of the solvers (their default)")
    options = parser.parse_args()
    figures = measure(seconds=options.seconds, solver=options.solver)
    print(format_table(figures))
    if options.json:
        write_figures(options.json, as_json(figures))
    if options.picture:
        draw(figures, options.picture)


if __name__ == "__main__":
    main()
