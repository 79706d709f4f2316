"""What came out of runs with faults, added up, printed, and as JSON."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any


@dataclass(kw_only=True)
class FaultTally:
    """What came out of some runs."""

    faults: Counter[str] = field(default_factory=Counter)
    wrong: Counter[str] = field(default_factory=Counter)
    motion: Counter[str] = field(default_factory=Counter)
    crashes: Counter[str] = field(default_factory=Counter)
    hangs: int = 0
    unrecovered: int = 0
    states: int = 0
    orders: int = 0
    phases: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)
    worst: dict[str, float] = field(default_factory=dict)
    violations: Counter[str] = field(default_factory=Counter)

    def add(self, other: FaultTally) -> None:
        """Add another tally."""
        for name in ("faults", "wrong", "motion", "crashes", "phases", "outcomes", "violations"):
            getattr(self, name).update(getattr(other, name))
        for name in ("hangs", "unrecovered", "states", "orders"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name, value in other.worst.items():
            self.worst[name] = max(self.worst.get(name, 0.0), value)


def tally_json(value: Any) -> Any:
    """Return a count, or counts by what they count in words."""
    return {str(key): number for key, number in value.items()} if isinstance(value, dict) else value


def print_tally(tally: FaultTally) -> None:
    """Print what came out."""
    print(f"faults injected          {sum(tally.faults.values()):>8}  {dict(tally.faults.most_common())}")
    print(f"states compared          {tally.states:>8}  {dict(tally.phases)}")
    print(f"moves judged                       {dict(tally.outcomes)}")
    print(f"orders sent              {tally.orders:>8}")
    print(f"wrong states             {sum(tally.wrong.values()):>8}  {dict(tally.wrong)}")
    print(f"unintended orders        {sum(tally.motion.values()):>8}  {dict(tally.motion)}")
    print(f"hangs                    {tally.hangs:>8}")
    print(f"crashes                  {sum(tally.crashes.values()):>8}  {dict(tally.crashes)}")
    print(f"not back to work         {tally.unrecovered:>8}")
    print(f"largest differences                { ({name: round(value, 3) for name, value in tally.worst.items()}) }")
    print(f"against good practice              {dict(tally.violations)}")
