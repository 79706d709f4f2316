"""Which contact an offline run is given: `--contact`, `--object` and `case.json` into a choice."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from finforce_eval.errors import OptionError
from finforce_eval.recordings.objects import find_mesh, has_object
from finforce_eval.recordings.tracks import Recording

ESTIMATED = ("estimate", "closest", "paper")
AUTOMATIC, FIXED = "automatic", "fixed"
FROM_CASE = "case"
EXPECTED = f"expected {', '.join(ESTIMATED)}, fixed:Z_MM (millimetres), fixed:case or NAME=Z_MM"


@dataclass(frozen=True, kw_only=True)
class ContactChoice:
    """Where the contact of a recording comes from.

    Attributes:
        mode: "estimate", "closest" or "paper" by the contact estimator; "fixed" at a height; "automatic" is "estimate"
            for a recording with an object mesh and poses, else "fixed".
        height_mm: height for every recording [mm]; None takes it from each recording's `case.json`.
        by_name: recording name -> height [mm], before everything else.
        object_file: mesh for every recording; None takes it from each recording's `case.json`.
        object_unit: unit of the mesh.
    """

    mode: str = AUTOMATIC
    height_mm: float | None = None
    by_name: Mapping[str, float] = field(default_factory=dict)
    object_file: str | None = None
    object_unit: str = "m"

    def mode_for(self, recording: Recording, side: str) -> str:
        """Return "estimate", "closest", "paper" or "fixed" for one jaw of a recording."""
        if recording.name in self.by_name:
            return FIXED
        if self.mode != AUTOMATIC:
            return self.mode
        is_known = has_object(recording, side) and find_mesh(recording, self.object_file) is not None
        return ESTIMATED[0] if is_known else FIXED

    def height(self, recording: Recording) -> float:
        """Return the height of first touch above the clamped base for a recording [m].

        Raises:
            OptionError: an estimator was asked for, or no height was given and the `case.json` holds none.
        """
        if recording.name in self.by_name:
            return self.by_name[recording.name] * 1e-3
        if self.mode in ESTIMATED:
            raise OptionError(f"--contact {self.mode} has no fixed height; here give fixed:Z_MM or fixed:case")
        if self.height_mm is not None:
            return self.height_mm * 1e-3
        case_object = recording.case.get("object")
        z = case_object.get("z") if isinstance(case_object, Mapping) else None
        if isinstance(z, bool) or not isinstance(z, int | float) or not math.isfinite(z):
            raise OptionError(
                f"{recording.name}: no contact height: no object.z in a case.json beside it; give --contact fixed:Z_MM"
            )
        return float(z) * 1e-3


def parse_contacts(texts: Sequence[str], *, object_file: str | None = None, object_unit: str = "m") -> ContactChoice:
    """Read `--contact` values: an estimator, `fixed:Z_MM`, `fixed:case`, or `NAME=Z_MM`, the last repeatable.

    Args:
        texts: the values; of those for every recording the last one counts.
        object_file: object mesh for every recording.
        object_unit: its unit.

    Raises:
        OptionError: another value.
    """
    by_name: dict[str, float] = {}
    mode, height = AUTOMATIC, None
    for text in texts:
        name, separator, value = text.rpartition("=")
        if separator:
            by_name[name] = _height(value, text)
        elif text.startswith("fixed:"):
            value = text.removeprefix("fixed:")
            mode, height = FIXED, None if value == FROM_CASE else _height(value, text)
        elif text in ESTIMATED:
            mode = text
        else:
            raise OptionError(f"--contact {text}: {EXPECTED}")
    return ContactChoice(mode=mode, height_mm=height, by_name=by_name, object_file=object_file, object_unit=object_unit)


def _height(value: str, text: str) -> float:
    """Read a height [mm]."""
    try:
        height = float(value)
    except ValueError:
        height = math.nan
    if not math.isfinite(height):
        raise OptionError(f"--contact {text}: '{value}' is no height in millimetres")
    return height
