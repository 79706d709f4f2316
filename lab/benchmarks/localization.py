"""Compares ways to find the contact place, in time and in error, on bench recordings with ground truth.

    python -m lab.benchmarks.localization [RECORDING...] [--json report/localization.json] [--figure PICTURE]

Without recordings the one that comes with the package is used, with cylinders of 1, 5 and 20 thousand triangles; of
other recordings the meshes are their own.
"""

import argparse

from finforce_eval.machine import write_figures
from lab.bench.localization import as_json, draw, format_table, measure, measure_methods


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="*", metavar="RECORDING")
    parser.add_argument("--json", default="", metavar="OUT")
    parser.add_argument("--figure", default="", metavar="PICTURE")
    options = parser.parse_args()
    figures = measure_methods(options.recordings) if options.recordings else measure(quick=False)
    print(format_table(figures))
    if options.json:
        write_figures(options.json, as_json(figures))
    if options.figure:
        draw(figures, options.figure)


if __name__ == "__main__":
    main()
