"""What can go wrong in the twin; a jaw that touches nothing is a result and none of these."""

from finforce.errors import FinforceError


class ScenarioError(FinforceError, ValueError):
    """A scenario is not known, or its numbers fit no gripper."""


class BalanceError(FinforceError, RuntimeError):
    """Jaws and object find no equilibrium: a jaw buckles, or the object slips or falls."""
