"""CPU time of each node on three scenes, with the rules of what need not be done and without; table, JSON, picture.

    python -m lab.benchmarks.skipping [--json OUT] [--picture PNG] [--seconds 10] [--each] [--composed]

It renders one grasp (two minutes, kept in the user's cache) and runs all nodes twice for half a minute. Nothing else
should run meanwhile; the table says what did.
"""

import argparse

from finforce_eval.machine import write_figures
from lab.bench.skipping import EACH, SETTINGS, as_json, draw, format_each, format_table, measure


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument("--picture", metavar="OUT", help="draw them")
    parser.add_argument("--seconds", type=float, default=10.0, help="of idling and of holding that are measured (10)")
    parser.add_argument("--solver", default="", help="tier of the solvers (their default)")
    parser.add_argument("--each", action="store_true", help="switch off one rule after the other, not all at once")
    parser.add_argument("--composed", action="store_true", help="all nodes in one process")
    options = parser.parse_args()
    settings = EACH if options.each else SETTINGS
    figures = measure(seconds=options.seconds, solver=options.solver, settings=settings, composed=options.composed)
    print(format_each(figures) if options.each else format_table(figures))
    if options.json:
        write_figures(options.json, as_json(figures))
    if options.picture and not options.each:
        draw(figures, options.picture)


if __name__ == "__main__":
    main()
