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
    state["depth"], state["depth_variance"] = depth, stddev**2
    reason = find_rejection_reason(state, largest_residual=1e-3, largest_stddev=1.0)
    assert ("as if that pulled" in reason) == rejected == bool(reason)


@pytest.mark.parametrize(
    ("magnitude", "stddev", "largest", "rejected"),
    [
        (2.0, 0.9, 1.0, False),
        (2.0, 1.1, 1.0, True),
        (2.0, 1.1, 2.0, False),
        (6.0, 1.4, 1.0, False),
        (1.0, 0.4, 0.3, True),
    ],
)
def test_a_force_is_told_with_the_deviation_that_the_user_can_do_with(magnitude, stddev, largest, rejected):
    state = blank_contact_state()
    state["magnitude"], state["stddev"] = magnitude, stddev
    reason = find_rejection_reason(state, largest_residual=1e-3, largest_stddev=largest)
    assert bool(reason) == rejected
    assert not reason or f"only within {stddev:.2g} N, expected {max(largest, 0.25 * magnitude):.2g} N" in reason
