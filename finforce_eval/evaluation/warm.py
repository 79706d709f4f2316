"""What tasks of one process share: jaw, settings, and estimators that are built and compiled once."""

from __future__ import annotations

import argparse

from finforce_eval.evaluation.setup import EvaluationSetup, make_setup
from finforce_ifea.estimator import JawEstimator


class WarmSetup:
    """A setup and its estimators, which forget one recording before the next.

    Args:
        key: of all that the setup is made of, files included.
        setup: of the options with that key.
    """

    def __init__(self, key: str, setup: EvaluationSetup) -> None:
        self.key, self.setup = key, setup
        self._estimators: dict[tuple[str, bool], JawEstimator] = {}

    def estimator(self, side: str, held: bool) -> JawEstimator:
        """Return an estimator of a jaw that knows of no recording; `held` where both jaws hold an object."""
        known = self._estimators.get((side, held))
        if known is None:
            known = self._estimators[side, held] = self.setup.side(side).estimator(held)
        else:
            known.forget()
        return known


_last: list[WarmSetup] = []


def open_warm(key: str, options: argparse.Namespace) -> WarmSetup:
    """Return the setup of the last call where its key was the same, else a new one.

    Args:
        key: hash of the options and of the files that they name.
        options: of the command line.

    Raises:
        FinforceError: jaw, calibration or settings cannot be used.
    """
    if not _last or _last[0].key != key:
        _last[:] = [WarmSetup(key, make_setup(options))]
    return _last[0]


def close_warm() -> None:
    """Forget the setup of the last call."""
    _last.clear()
