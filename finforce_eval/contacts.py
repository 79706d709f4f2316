"""Which contact an offline run is given: `--contact` and `case.json` into heights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from finforce_eval.errors import OptionError
from finforce_eval.tracks import Recording

NEEDS_ESTIMATOR = ("estimate", "closest", "paper")
FROM_CASE = "case"


@dataclass(frozen=True, kw_only=True)
class ContactChoice:
    """Contact heights to be used.

    Attributes:
        height_mm: height for every recording [mm]; None takes it from each recording's `case.json`.
        by_name: recording name -> height [mm], before everything else.
    """

    height_mm: float | None = None
    by_name: Mapping[str, float] = field(default_factory=dict)

    def height(self, recording: Recording) -> float:
        """Return the height of first touch above the clamped base for a recording [m].

        Raises:
            OptionError: no height was given and the recording's `case.json` holds none.
        """
        if recording.name in self.by_name:
            return self.by_name[recording.name] * 1e-3
        if self.height_mm is not None:
            return self.height_mm * 1e-3
        case_object = recording.case.get("object")
        z = case_object.get("z") if isinstance(case_object, Mapping) else None
        if isinstance(z, bool) or not isinstance(z, int | float) or not math.isfinite(z):
            raise OptionError(
                f"{recording.name}: no contact height: no object.z in a case.json beside it; give --contact fixed:Z_MM"
            )
        return float(z) * 1e-3


def parse_contacts(texts: Sequence[str]) -> ContactChoice:
    """Read `--contact` values: `fixed:Z_MM`, `fixed:case` or `NAME=Z_MM`, the last repeatable.

    Raises:
        OptionError: another value, or one that needs the contact estimator.
    """
    by_name: dict[str, float] = {}
    height: float | None = None
    for text in texts:
        name, separator, value = text.rpartition("=")
        if separator:
            by_name[name] = _height(value, text)
        elif text.startswith("fixed:"):
            value = text.removeprefix("fixed:")
            height = None if value == FROM_CASE else _height(value, text)
        elif text in NEEDS_ESTIMATOR:
            raise OptionError(
                f"--contact {text} needs the contact estimator, which this version does not have; "
                "give fixed:Z_MM or fixed:case"
            )
        else:
            raise OptionError(f"--contact {text}: expected fixed:Z_MM (millimetres), fixed:case or NAME=Z_MM")
    return ContactChoice(height_mm=height, by_name=by_name)


def _height(value: str, text: str) -> float:
    """Read a height [mm]."""
    try:
        height = float(value)
    except ValueError:
        height = math.nan
    if not math.isfinite(height):
        raise OptionError(f"--contact {text}: '{value}' is no height in millimetres")
    return height
