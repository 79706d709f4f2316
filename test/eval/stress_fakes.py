"""Families of trials with known outcomes."""

from finforce_eval.stress.stress import Family, Trial, attempt
from finforce_ifea.errors import ContactError


def answers(count, *, error=0.01, stddev=0.01, **fields):
    """Sure, converged answers with the same error and the same stated standard deviation [N]."""
    usual = {"converged": True, "sure": True, "force_error": error, "stddev": stddev, "step_time": 1e-3}
    return [Trial(seed=i, **{**usual, **fields}) for i in range(count)]


def family_of(trials, **fields):
    return Family(name="made", what="made up", run=lambda plan: iter(trials), **fields)


def refuse():
    raise ContactError("not on the jaw")


def divide():
    return 1 / 0


def fail_with(work, **options):
    """The trial of a step that does not return."""
    return attempt(7, work, lambda got: Trial(converged=True), level="made", **options)
