"""Claims about what makes a contact state one that tells no force."""

import pytest

from finforce_ifea.tracking.contact_state import blank_contact_state, find_rejection_reason

MM = 1e-3


@pytest.mark.parametrize(
    ("depth", "stddev", "rejected"),
    [
        (-0.3 * MM, 0.05 * MM, False),  # noise of key points
        (-0.6 * MM, 0.15 * MM, True),
        (-0.6 * MM, 0.25 * MM, False),
        (-3.4 * MM, 4.5 * MM, True),
        (3.0 * MM, 0.1 * MM, False),
    ],
)
def test_an_object_cannot_pull(depth, stddev, rejected):
    state = blank_contact_state()
    state["depth"], state["depth_variance"], state["converged"] = depth, stddev**2, True
    reason = find_rejection_reason(state, largest_residual=1e-3, settles=True)
    assert ("as if that pulled" in reason) == rejected == bool(reason)
