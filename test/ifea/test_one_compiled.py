"""What takes seconds to compile is compiled once, whatever jaw, solver and contact it is for."""

import pytest

from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.filter.image_update import finish, iterate, predict_image
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.reduced.model import linearize_reduced
from finforce_ifea.settings import EstimatorSettings


@pytest.mark.parametrize("held", ["no", "yes"])
def test_the_search_for_a_contact_is_compiled_once(held):
    for solver in ("frame", "reduced"):
        ForceEstimator(load_jaw("bench"), settings=EstimatorSettings(solver=solver, held=held)).warm_up()
    for kernel in (predict_image, iterate, finish, linearize_reduced):
        assert len(kernel.signatures) == 1
