"""The coefficient of friction of the objects that a finger was calibrated on, from loops of loading and unloading."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from finforce_ifea.estimator import JawEstimator
from finforce_ifea.identification.identification import CalibrationCase
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.friction import Coefficient

# A coefficient that is known no better than this is none; more loops do not tell the errors of the mechanics apart.
_VAGUE, _LEAST_STDDEV = 0.15, 0.03


def identify_friction(
    jaw: Jaw, calibration: Calibration, cases: Iterable[CalibrationCase], settings: EstimatorSettings
) -> Coefficient | None:
    """Returns the coefficient that the key points of all recordings show together; None where they tell too little.

    Recordings without an object's outline tell nothing, nor does the paper's solver.

    Args:
        jaw: as drawn.
        calibration: that was found for it.
        cases: the recordings.
        settings: of the estimator that the calibration is for.

    Raises:
        ObservationError: Key points that are none.
        ContactError: A contact that is not on the jaw.
    """
    known = [case for case in cases if case.contact.outline is not None]
    if not known or settings.solver == "paper":
        return None
    estimator = JawEstimator(jaw, calibration=calibration, settings=replace(settings, smooth_share=0.0))
    information, vector = 0.0, 0.0
    for case in known:
        estimator.forget()
        for observation in case.observations:
            estimator.update(observation, case.contact)
        seen = estimator.seen_friction
        if np.isfinite(seen.stddev):
            information += seen.stddev**-2
            vector += seen.mean * seen.stddev**-2
    if not information > _VAGUE**-2:
        return None
    return Coefficient(max(vector / information, 0.0), max(information**-0.5, _LEAST_STDDEV))
