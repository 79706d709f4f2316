"""Work that a scene does not need: the rules by name, and how often each was applied."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

from finforce.errors import FinforceError

ALL = "all"

# of every node
UNHEARD = "nobody subscribes"
EVERYWHERE = (UNHEARD,)
# of a solver
IDLE = "idle image"
SOLVER = (IDLE,)
# of a contact estimator, which has IDLE, too
STILL = "nothing moved"
CONTACT = (IDLE, STILL)


class SkippingError(FinforceError):
    """A rule that is to be switched off does not exist."""


class Skips:
    """The rules of one node: which may be applied, and how often each was.

    Args:
        rules: names of the rules that the node has beside those that every node has.
        off: names of rules that are not to be applied; "all" for none of them.

    Raises:
        SkippingError: a name in `off` is no rule of the node.
    """

    def __init__(self, rules: Sequence[str], off: Collection[str] = ()) -> None:
        rules = tuple(dict.fromkeys((*EVERYWHERE, *rules)))
        unknown = sorted(set(off) - {*rules, ALL, ""})
        if unknown:
            raise SkippingError(f"skip_off: there is no rule {unknown[0]!r}; expected {', '.join(rules)} or {ALL}")
        self._rules = rules
        self._off = frozenset(rules if ALL in off else off)
        self._counts: Counter[str] = Counter()

    def allows(self, rule: str) -> bool:
        """Say whether a rule may be applied."""
        return rule not in self._off

    def count(self, rule: str, times: int = 1) -> None:
        """Note that a rule has saved its work."""
        self._counts[rule] += times

    def describe(self) -> dict[str, str]:
        """Return, for the diagnostics, how often each rule saved its work, or that it is off."""
        return {f"skipped: {rule}": str(self._counts[rule]) if self.allows(rule) else "off" for rule in self._rules}
