"""The rows of the table that compares finforce with the paper and with SOFA: figures in, words out.

What is quoted stands here beside the footnote that says where it is from; what was not measured says so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from peer_measure import DEFAULT, FULL, HEIGHTS, OUTLINE

from finforce_eval.bench.solvers import SOFA

# Table I of the paper, RMSE [N] on 15, 25, 35 mm.
TABLE_I = {"upper": (0.22, 0.52, 0.57), "middle": (0.24, 0.28, 0.24), "lower": (0.69, 0.62, 1.21)}
# SOFA's RMSE [N] at each height after the best factor for it.
SOFA_BY_HEIGHT = {"lower": 1.28, "middle": 0.02, "upper": 0.08}
SOFA_IN_YARDSTICKS = SOFA["step_ms"] / SOFA["yardstick_ms"]
WRONG_POINTS = ("gross", "clusters", "noise", "jumps")
MISSING = "not measured"
NOT_ITS_FINGER = "another, real finger"
HEAD = ("", "finforce", "the paper", "SOFA + SoftRobots.Inverse, 522 vertices")


@dataclass(frozen=True, kw_only=True)
class Figures:
    """What the rows are made of.

    Attributes:
        own: what `peer_measure.measure_all` returned.
        bench: the JSON of `finforce bench`; empty without.
        stress: that of `finforce stress`; empty without.
    """

    own: Mapping[str, Any]
    bench: Mapping[str, Any]
    stress: Mapping[str, Any]

    def tier(self, name: str) -> Mapping[str, Any]:
        """Returns the measured figures of a tier."""
        return next(tier for tier in self.own["tiers"] if tier["name"] == name)

    def rate(self, name: str) -> float:
        """Returns how many steps of a tier go into one of SOFA's, both in SuperLU factorisations."""
        return SOFA_IN_YARDSTICKS / self.tier(name)["in_yardsticks"]

    def error_share(self, name: str, of: str = "rmse") -> float:
        """Returns the error of a tier over the least that is quoted of SOFA."""
        return self.tier(name)["shapes"][of] / SOFA["factor_per_height_N"]


def list_rows(figures: Figures) -> list[tuple[str, ...]]:
    """Returns the rows: what is compared, then a cell for each column of `HEAD`."""
    return [*_speed(figures), *_errors(figures), *_behaviour(figures), *_costs(figures), *_terms()]


def _speed(figures: Figures) -> list[tuple[str, ...]]:
    rows = [
        (
            f"{title}: p50 / p95 / p99, ms",
            f"{_step(figures.tier(name))}[^own]",
            "at least 25 (up to 40 Hz)[^paper-rate]" if name == DEFAULT else "",
            f"{SOFA['step_ms']:g} / 4.1[^sofa]" if name == DEFAULT else "",
        )
        for title, name in (
            ("A step of the default solver", DEFAULT),
            ("… with the object's outline", OUTLINE),
            ("… of the full solid on the same 522 vertices", FULL),
        )
    ]
    ratios = " / ".join(f"{figures.tier(name)['in_yardsticks']:.3f}" for name in (DEFAULT, OUTLINE, FULL))
    beside = " / ".join(f"{figures.tier(name)['yardstick']['p50']:.1f}" for name in (DEFAULT, OUTLINE, FULL))
    quoted = f"{SOFA_IN_YARDSTICKS:.2f} ({SOFA['step_ms']:g} ms beside {SOFA['yardstick_ms']:g} ms)[^sofa]"
    rates = " / ".join(f"{figures.rate(name):.1f}" for name in (DEFAULT, OUTLINE, FULL))
    return [
        *rows,
        ("The same three in SuperLU factorisations", f"{ratios} (beside {beside} ms)[^own]", MISSING, quoted),
        ("**Rate, in SOFA's, by the yardstick**", f"**{rates}**", MISSING, "1"),
        (
            "Steps until an answer",
            "1, with its covariance (jumps: below)",
            "not stated",
            "1; 5 to 6 after a jump[^sofa]",
        ),
        (
            "Whole chain, from images",
            _chain(figures.bench.get("chain", {})),
            "30 Hz in contact, 10 Hz before; force 0.25 s after its onset[^paper-rate]",
            "mechanics alone",
        ),
    ]


def _step(tier: Mapping[str, Any]) -> str:
    return " / ".join(f"{tier['cpu'][name]:.2f}" for name in ("p50", "p95", "p99"))


def _chain(part: Mapping[str, Any]) -> str:
    """Returns latency and error of the chain from images at each rate."""
    rows = [row for row in part.get("rows", ()) if row["source"] == "images"]
    if not rows:
        return MISSING
    cells = [
        f"{row['rate']} Hz: {100 * row['answered'] / row['images']:.0f} % answered, {row['latency']['p50']:.0f} / "
        f"{row['latency']['p99']:.0f} ms p50 / p99, {row['error_N']:.3f} N"
        for row in rows
    ]
    return "; ".join(cells) + "[^bench]"


def _errors(figures: Figures) -> list[tuple[str, ...]]:
    tiers = [figures.tier(name) for name in (DEFAULT, OUTLINE, FULL)]
    fitted = [" / ".join(f"{tier['fitted_by_height'][name]:.3f}" for name in HEIGHTS) for tier in tiers]
    by_height = " / ".join(f"{SOFA_BY_HEIGHT[name]:g}" for name in HEIGHTS)
    rows = [
        ("45 noise-free shapes answered", "solved", "45[^sofa]", "{:d}"),
        ("RMSE there, true modulus, nothing fitted, N", "rmse", f"{SOFA['rmse_N']:g}[^sofa]", "{:.3f}"),
        ("… after the best factor for all", "one_factor", f"{SOFA['one_factor_N']:g}[^sofa]", "{:.3f}"),
        (
            "… after the best factor per height",
            "factor_per_height",
            f"{SOFA['factor_per_height_N']:g}[^sofa]",
            "{:.3f}",
        ),
    ]
    return [
        ("*Errors: default / with outline / full solid, 522 vertices*", "", "", ""),
        *(
            (title, " / ".join(form.format(tier["shapes"][key]) for tier in tiers) + "[^own]", NOT_ITS_FINGER, quoted)
            for title, key, quoted, form in rows
        ),
        ("… of which lower / middle / upper", "; ".join(fitted) + "[^own]", NOT_ITS_FINGER, f"{by_height}[^sofa]"),
        _recordings(figures.bench.get("solvers", {}).get("recorded", ())),
        _noise(figures.tier(DEFAULT)["noise"]),
    ]


def _noise(noise: Mapping[str, Mapping[str, float]]) -> tuple[str, ...]:
    """Returns the row of errors under white noise of 0.2 mm."""
    along, whole, lost = (
        " / ".join(f"{100 * noise[name][key]:.{digits}f}" for name in HEIGHTS)
        for key, digits in (("along_x", 1), ("in_3d", 1), ("lost", 0))
    )
    return (
        "0.2 mm of noise, 15 key points, mean error of F_x; of F in 3D (lower / middle / upper)",
        f"{along} %; {whole} %; unanswered {lost} %[^own]",
        MISSING,
        "13 / 3.2 / 2.1 %; 92 / 20 / 33 %[^sofa]",
    )


def _recordings(recorded: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Returns the row of the nine recordings beside the paper's Table I."""
    kept = {row["tier"]: row for row in recorded if row["tier"] in (DEFAULT, OUTLINE)}
    words = {DEFAULT: "place given", OUTLINE: "place estimated"}
    cells = [f"{words[name]}: {_nine(kept[name])}" for name in (DEFAULT, OUTLINE) if name in kept]
    paper = "; ".join(f"{name} {' / '.join(f'{value:.2f}' for value in row)}" for name, row in TABLE_I.items())
    mean = np.mean(list(TABLE_I.values()))
    return (
        "Nine bench recordings, RMSE on Ø15 / 25 / 35, N",
        "; ".join(cells) + "[^bench]" if cells else MISSING,
        f"{NOT_ITS_FINGER}, place given: {paper}; mean {mean:.2f}[^paper-error]",
        MISSING,
    )


def _nine(row: Mapping[str, Any]) -> str:
    """Returns the errors of a tier over the recordings by height and diameter, their mean, and what is unanswered."""
    errors, parts = row["by_recording"], []
    for height in TABLE_I:
        values = [value for name, value in sorted(errors.items()) if name.endswith(height)]
        parts.append(f"{height} {' / '.join(f'{value:.2f}' for value in values)}")
    return f"{', '.join(parts)}; mean {np.mean(list(errors.values())):.3f}, unanswered {100 * row['lost']:.1f} %"


def _behaviour(figures: Figures) -> list[tuple[str, ...]]:
    families = figures.stress.get("families", {})
    found = [name for name in WRONG_POINTS if name in families]
    return [
        (
            "Key points that are wrong, noisy or jump",
            "; ".join(_family(name, families[name]) for name in found) + "[^stress]" if found else MISSING,
            "filtered by likelihood and a box around the workspace[^paper-filter]",
            MISSING,
        ),
        (
            "Targets that no force reaches, held for seconds",
            "; ".join(_unreachable(row) for row in figures.own["unreachable"]) + "[^own]",
            "not stated",
            "oscillates by up to 526 N, one effector near the base and a free 3D force by 7,100 N; says nothing[^sofa]",
        ),
        (
            "Uncertainty",
            "a standard deviation with every force, or none and the reason; " + _coverage(families),
            "not stated",
            "none",
        ),
        (
            "Contact",
            "any height, or the object's outline: place and force together, hidden or not[^contact]",
            "nearest of 14 candidates, hidden or not, from meshes that intersect[^paper-contact]",
            "given: a vertex",
        ),
    ]


def _family(name: str, family: Mapping[str, Any]) -> str:
    """Returns what came of a stress family."""
    share, within = 100 * family["sure"], 100 * family["within"]
    return f"{name}: {share:.0f} % answered, wrong by {family['worst_error']:.2g} N at most, {within:.1f} % within 3 σ"


def _unreachable(row: Mapping[str, float]) -> str:
    """Returns what came of key points scattered about their places."""
    shown = f"{row['scatter_mm']:g} mm off: {100 * row['answered']:.0f} % answered"
    return shown + (f", jumps of {row['largest_jump_N']:.2g} N at most" if row["answered"] else "")


def _coverage(families: Mapping[str, Mapping[str, Any]]) -> str:
    """Returns how many families of the stress keep the rule that they are held to."""
    if not families:
        return f"coverage {MISSING}"
    broken = [name for name, family in families.items() if family["broken"]]
    kept = f"{len(families) - len(broken)} of {len(families)} stress families keep the rule"
    return kept + (f", not {join_names(broken)}" if broken else "") + "[^stress]"


def _costs(figures: Figures) -> list[tuple[str, ...]]:
    starts = {start["cached"]: start for start in figures.own["starts"]}
    order = ("all", "code", "nothing")
    memory = " / ".join(f"{starts[name]['memory']:.0f}" for name in order)
    seconds = " / ".join(f"{starts[name]['seconds']:.1f}" for name in order)
    core, full = figures.own["core"], figures.own["full"]
    caches = f"caches after the first start {starts['all']['caches']:.0f} MB"
    sizes = f"{1e-6 * core['size']:.0f} MB ({core['packages']} packages) / {1e-6 * full['size']:.0f} MB"
    return [
        (
            "From starting a process to 200 answered images, s: all cached / compiled code cached / nothing",
            f"{seconds}[^own]",
            "not stated",
            MISSING,
        ),
        ("Memory of that process, MB", f"{memory}[^own]", "not stated", MISSING),
        (
            "Installed, with all it needs: core / with every extra",
            f"{sizes} ({full['packages']} packages); {caches}[^own]",
            "not stated",
            "SOFA's libraries alone, packed, without Python and plugins: 22.5 MB[^sofa-size]",
        ),
    ]


def _terms() -> list[tuple[str, ...]]:
    return [
        (
            "Licence",
            "Apache-2.0[^licence]",
            "no code named; builds on SoftRobots.Inverse and on FoundationPose, for research or evaluation "
            "only[^foundationpose]",
            "SoftRobots.Inverse: AGPL-3.0, a patented method[^inverse]",
        ),
        (
            "GPU",
            "none used",
            "not stated; the makers of SAM 3D Objects, which makes its meshes, ask for 32 GB[^sam]",
            "none used[^sofa]",
        ),
        (
            "Training data",
            "rendered pictures, no photograph, no force[^card]",
            "300 annotated frames on top of a trained network[^paper-training]",
            "none: mechanics alone",
        ),
    ]


def join_names(names: Sequence[str]) -> str:
    """Returns names one after the other, or that there are none."""
    return ", ".join(names) or "none"
