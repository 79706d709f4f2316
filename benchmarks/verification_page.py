"""The page docs/verification.md: results in, Markdown out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SHOWN_DEPTHS = (2, 5, 10)
FORCE_AIM, FRAME_AIM, KEYPOINT_AIM = 0.03, 0.06, 0.15e-3
DEFAULT, COARSE, FINE, FRAME = "solid, default mesh", "solid, 522 vertices", "solid, fine mesh", "frame"
TETRAHEDRA = "linear tetrahedra, 522 vertices"
CALIBRATED = "solid, default mesh, with thicknesses and clamp of the calibration"
PAPER = "--solver paper"

HEAD = """# Verification of the mechanics

Written by `.venv/bin/python benchmarks/verify.py`; every figure on this page comes from one run of it.

The bench finger is pressed on rigid cylinders (diameter 15, 25, 35 mm) at three heights (lower, middle, upper: 20, 40,
60 mm above the clamp) by 1 to 10 mm, without friction. The truth is that of an independent program (CalculiX: 20-node
hexahedra, large displacements, surface contact), of which `test/data` holds an extract. It shares no line of code with
this package.

## Forward: pressed to a depth, force and shape compared

St. Venant-Kirchhoff truth, E = 30 MPa, ν = 0.45, which the models get as they are; nothing is fitted. Force: |F| of the
model over |F| of the truth, minus one; "worst" over the depths 1, 2, … 10 mm. Key points: the largest distance, in
three dimensions, of any of the 15 key points from where the truth has it, over all depths and at 5 mm.
"""

LOWER = """### The difference at the lower height

Near the clamp the two programs do not quite agree, and refining our mesh makes the difference smaller without removing
it. At the greatest depth the line from the first inner key point above the contact to the tip has turned towards the
object by these angles:
"""

LOWER_END = """
The independent program's finger turns a little more; the missing turn, times the length above the contact, is the key
points' error at the lower height, and grows towards the tip. At 2 mm depth that finger is also stiffer there, by what
the column "at 2 mm" shows: it behaves as one that is stiffer next to the clamp. More than that was not found out, nor
which of the two is nearer to a printed finger. The last block above shows what another clamp height and other band
thicknesses do, those of the shipped calibration: it belongs to another material and modulus, so that its shapes count
here and not its forces. A calibration takes such differences up.
"""

INVERSE_HEAD = """
## Inverse: noise-free shapes, force recovered

Mooney-Rivlin truth, the material of the recordings. The key points of each case are made from the truth alone: two
seconds unloaded, then ramps at 2 mm/s to 2, 4, 6, 8, 10 mm (as far as the finger goes before it buckles), each held
for 45 frames; all 15 key points, no noise. Calibration `bench`, made for the solid at the default mesh, with its
relaxation switched off; contact `fixed` at the height of first touch. The force is read at the end of each level.
"""


@dataclass(frozen=True, kw_only=True)
class ForwardCase:
    """One case of one model, depth by depth.

    Attributes:
        case: its name.
        height: "lower", "middle" or "upper".
        depth_mm: depths that the model reached [mm].
        force: relative errors of the force.
        keypoints: largest errors of a key point [m].
        turn: of the finger above the contact towards the object at the last depth [rad], model's and truth's.
    """

    case: str
    height: str
    depth_mm: tuple[float, ...]
    force: tuple[float, ...]
    keypoints: tuple[float, ...]
    turn: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class InverseCase:
    """True and estimated forces [N] of one case, level by level."""

    case: str
    height: str
    true: tuple[float, ...]
    estimated: tuple[float, ...]


def format_page(forward: Mapping[str, Sequence[ForwardCase]], inverse: Mapping[str, Sequence[InverseCase]]) -> str:
    """Returns the page."""
    lines = [HEAD, *_summary(forward), "", *_claims(forward)]
    for title, cases in forward.items():
        lines += ["", f"### {title[0].upper()}{title[1:]}", "", *_forward_table(cases)]
    lines += ["", LOWER, *_turn_table(forward), LOWER_END.rstrip(), INVERSE_HEAD, *_inverse_table(inverse), ""]
    return "\n".join([*lines, *_inverse_words(inverse)]) + "\n"


def largest(cases: Sequence[ForwardCase], heights: Sequence[str] = ("lower", "middle", "upper")) -> tuple[float, float]:
    """Returns the largest force error [-] and key point error [m] at some heights."""
    kept = [case for case in cases if case.height in heights]
    return max(max(map(abs, case.force)) for case in kept), max(max(case.keypoints) for case in kept)


def _summary(forward: Mapping[str, Sequence[ForwardCase]]) -> list[str]:
    lines = [
        "| model | force, worst of all | lower | middle | upper | key points, worst of all | lower | middle | upper |",
        "|---" + "|---:" * 8 + "|",
    ]
    for title, cases in forward.items():
        pairs = [largest(cases), *(largest(cases, (height,)) for height in ("lower", "middle", "upper"))]
        cells = [f"{100 * force:.1f} %" for force, _ in pairs] + [f"{1e3 * miss:.2f} mm" for _, miss in pairs]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return lines


def _claims(forward: Mapping[str, Sequence[ForwardCase]]) -> list[str]:
    """Returns which aims are met and which are missed, and by how much."""
    lines = []
    for title, aim in ((DEFAULT, FORCE_AIM), (FINE, FORCE_AIM), (FRAME, FRAME_AIM)):
        force, _ = largest(forward[title])
        lines.append(f"- **{title}, force within {100 * aim:.0f} %: {_judge(100 * force, 100 * aim, '%')}.**")
    for title in (DEFAULT, FINE):
        _, above = largest(forward[title], ("middle", "upper"))
        _, lower = largest(forward[title], ("lower",))
        aim = 1e3 * KEYPOINT_AIM
        parts = f"middle and upper {_judge(1e3 * above, aim, 'mm')}; lower {_judge(1e3 * lower, aim, 'mm')}"
        held = f"up to {_depth_within(forward[title]):g} mm of depth it holds everywhere"
        lines.append(f"- **{title}, key points within {aim:.2f} mm**: {parts}; {held}.")
    return lines


def _judge(value: float, aim: float, unit: str) -> str:
    word = "met" if value <= aim else f"missed by {value - aim:.2f} {unit if unit == 'mm' else 'points'}"
    return f"{word} (worst {value:.2f} {unit})"


def _depth_within(cases: Sequence[ForwardCase]) -> float:
    """Returns the depth [mm] up to which all key points are within the aim."""
    depths = [
        next((d for d, miss in zip(case.depth_mm, case.keypoints, strict=True) if miss > KEYPOINT_AIM), 99.0)
        for case in cases
    ]
    return min(max(case.depth_mm[-1] for case in cases), min(depths) - 1)


def _forward_table(cases: Sequence[ForwardCase]) -> list[str]:
    heads = ["case", "force, worst", *(f"at {d} mm" for d in SHOWN_DEPTHS), "key points, worst", "at 5 mm"]
    lines = ["| " + " | ".join(heads) + " |", "|---" + "|---:" * (len(heads) - 1) + "|"]
    for case in cases:
        force = dict(zip(case.depth_mm, case.force, strict=True))
        points = dict(zip(case.depth_mm, case.keypoints, strict=True))
        shown = [f"{100 * force[d]:+.1f} %" if d in force else "buckled" for d in SHOWN_DEPTHS]
        cells = [f"{100 * max(case.force, key=abs):+.1f} %", *shown]
        cells += [f"{1e3 * max(case.keypoints):.3f} mm", f"{1e3 * points[5]:.3f} mm" if 5 in points else "buckled"]
        lines.append(f"| {case.case} | " + " | ".join(cells) + " |")
    return lines


def _turn_table(forward: Mapping[str, Sequence[ForwardCase]]) -> list[str]:
    titles = (DEFAULT, FINE, FRAME, CALIBRATED)
    lines = ["| case | truth | " + " | ".join(titles) + " |", "|---" + "|---:" * (len(titles) + 1) + "|"]
    for rows in zip(*(forward[title] for title in titles), strict=True):
        if rows[0].height == "lower":
            truth = rows[0].turn[1]
            cells = [f"{1e3 * row.turn[0]:.1f} ({100 * (row.turn[0] / truth - 1):+.0f} %)" for row in rows]
            lines.append(f"| {rows[0].case} | {1e3 * truth:.1f} mrad | " + " | ".join(cells) + " |")
    return lines


def _factors(inverse: Mapping[str, Sequence[InverseCase]]) -> dict[str, float]:
    """Returns the best factor for the paper's program, which locks, and 1 for the others."""
    return {title: _best_factor(cases) if title == PAPER else 1.0 for title, cases in inverse.items()}


def _best_factor(cases: Sequence[InverseCase]) -> float:
    true, estimated = _stack(cases)
    return float(true @ estimated / (estimated @ estimated))


def _rms(cases: Sequence[InverseCase], factor: float = 1.0) -> float:
    true, estimated = _stack(cases)
    return float(np.sqrt(np.mean((factor * estimated - true) ** 2)))


def _stack(cases: Sequence[InverseCase]) -> tuple[NDArray, NDArray]:
    return np.concatenate([case.true for case in cases]), np.concatenate([case.estimated for case in cases])


def _inverse_table(inverse: Mapping[str, Sequence[InverseCase]]) -> list[str]:
    factors = _factors(inverse)
    heads = [f"{title}{', one factor' if title == PAPER else ''}: RMSE | worst" for title in inverse]
    lines = ["| case | true force | " + " | ".join(heads) + " |", "|---" + "|---:" * (2 * len(inverse) + 1) + "|"]
    for rows in zip(*inverse.values(), strict=True):
        cells = [f"{rows[0].true[0]:.2f} to {rows[0].true[-1]:.2f} N"]
        for title, case in zip(inverse, rows, strict=True):
            errors = factors[title] * np.array(case.estimated) - np.array(case.true)
            cells += [f"{np.sqrt((errors**2).mean()):.3f} N", f"{errors[np.abs(errors).argmax()]:+.3f} N"]
        lines.append(f"| {rows[0].case} | " + " | ".join(cells) + " |")
    totals = [f"{_rms(cases, factors[title]):.3f} N | " for title, cases in inverse.items()]
    return [*lines, "| all | | " + " | ".join(totals) + "|"]


def _inverse_words(inverse: Mapping[str, Sequence[InverseCase]]) -> list[str]:
    """Returns what the table's columns leave out."""
    cases = inverse[PAPER]
    split = [[case for case in cases if case.height == height] for height in ("lower", "middle", "upper")]
    factors = [_best_factor(part) for part in split]
    squares = [_rms(part, factor) ** 2 * len(_stack(part)[0]) for part, factor in zip(split, factors, strict=True)]
    by_height = np.sqrt(sum(squares) / len(_stack(cases)[0]))
    shown = ", ".join(f"{factor:.3f}" for factor in factors)
    return [
        f"`{PAPER}` (linear tetrahedra on the coarse mesh, energy weight 1e-3 scaled as SOFA does, one point force on",
        "the nearest candidate) answers with forces that are far too large, since the elements lock: RMSE",
        f"{_rms(cases):.1f} N. The column has them times {_best_factor(cases):.3f}, the one factor that is best for",
        f"all nine cases. With one factor per height ({shown}), which is what an energy weight",
        f"per candidate amounts to, {by_height:.2f} N remain.",
    ]
