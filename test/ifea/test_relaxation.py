"""Claims about the finger's relaxation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finforce_ifea.relaxation import Relaxation, RelaxationTerm, apply_relaxation, invert_relaxation

TERMS = (RelaxationTerm(share=0.3, time_constant=0.5), RelaxationTerm(share=0.15, time_constant=8.0))
ALONG = np.array([-0.6, 0.0, 0.8])


def follow(elastic, stamps, terms=TERMS, direction=ALONG):
    """Magnitudes with sign of the filter's forces for elastic forces along one direction."""
    filter_, forces, last = Relaxation(terms), [], stamps[0]
    for size, stamp in zip(elastic, stamps, strict=True):
        forces.append(filter_.update(size * direction, stamp - last) @ direction)
        last = stamp
    return np.array(forces)


def ramp_and_hold(times, rise, level):
    """Elastic force that rises for `rise` seconds to a level and stays, and what a Maxwell branch adds to it."""
    elastic = level * np.clip(times / rise, 0.0, 1.0)
    over = np.zeros_like(times)
    for term in TERMS:
        tau, rate = term.time_constant, term.share * level / rise
        during = rate * tau * (1.0 - np.exp(-times / tau))
        after = rate * tau * (1.0 - np.exp(-rise / tau)) * np.exp(-(times - rise) / tau)
        over += np.where(times <= rise, during, after)
    return elastic, elastic + over


@pytest.mark.parametrize("steps", [11, 31, 301])
def test_ramp_and_hold_is_the_closed_form_at_any_time_step(steps):
    times = np.linspace(0.0, 10.0, 10 * (steps - 1) + 1)
    elastic, expected = ramp_and_hold(times, 1.0, 3.0)
    # exact for ramps, whatever the step: only rounding
    np.testing.assert_allclose(follow(elastic, times), expected, atol=1e-12)
    np.testing.assert_allclose(apply_relaxation(elastic, times, TERMS), expected, atol=1e-12)


def test_uneven_time_steps_give_the_same():
    random = np.random.default_rng(0)
    times = np.sort(np.r_[0.0, 1.0, 12.0, random.uniform(0, 12, 80)])
    elastic, expected = ramp_and_hold(times, 1.0, 2.0)
    np.testing.assert_allclose(follow(elastic, times), expected, atol=1e-12)


def test_sudden_load_is_magnified_by_the_gain_and_decays_to_the_elastic_force():
    filter_ = Relaxation(TERMS)
    filter_.update(np.zeros(3), 0.0)
    peak = filter_.update(2.0 * ALONG, 1e-9)
    np.testing.assert_allclose(peak, 2.0 * 1.45 * ALONG, rtol=1e-6)
    np.testing.assert_allclose(filter_.update(2.0 * ALONG, 200.0), 2.0 * ALONG, rtol=1e-9)


def test_without_branches_nothing_changes():
    filter_ = Relaxation(())
    for size in (0.0, 1.0, 0.3):
        np.testing.assert_array_equal(filter_.update(size * ALONG, 0.1), size * ALONG)


def test_released_force_is_gone_before_the_displacement():
    """Contact cannot pull: on the way back the overstress takes the force away, and never turns it round."""
    times = np.linspace(0.0, 12.0, 361)
    elastic = np.interp(times, [0, 1, 10, 11, 12], [0, 3, 3, 0, 0])
    for found in (follow(elastic, times), apply_relaxation(elastic, times, TERMS)):
        assert found.min() == 0.0
        late = (times > 10.5) & (times < 11.0)
        assert (found[late] < elastic[late]).all()
        assert (found[(times > 10.9) & (times < 11.0)] == 0.0).all()
        assert elastic[(times > 10.9) & (times < 11.0)].min() > 0.0


def test_overstress_keeps_its_own_direction():
    filter_ = Relaxation(TERMS)
    filter_.update(np.zeros(3), 0.0)
    filter_.update(np.array([-2.0, 0.0, 0.0]), 0.01)
    turned = filter_.update(np.array([-1.5, 0.0, -1.0]), 0.01)
    assert turned[2] < -1.0
    assert turned[1] == 0.0


def test_reset_forgets_the_past():
    filter_ = Relaxation(TERMS)
    filter_.update(5.0 * ALONG, 1.0)
    filter_.reset()
    first = filter_.update(1.0 * ALONG, 0.5)
    np.testing.assert_array_equal(first, Relaxation(TERMS).update(1.0 * ALONG, 0.5))


@pytest.mark.parametrize("terms", [(), TERMS[:1], TERMS])
def test_inversion_undoes_the_relaxation(terms):
    random = np.random.default_rng(3)
    stamps = np.cumsum(np.r_[0.0, random.uniform(0.005, 0.3, 400)])
    elastic = 3.0 + 2.0 * np.sin(0.7 * stamps) - 3.0 * np.exp(-stamps)
    elastic[0] = 0.0
    measured = apply_relaxation(elastic, stamps, terms)
    assert measured.min() >= 0.0 and (measured[1:] > 0.0).all()
    np.testing.assert_allclose(invert_relaxation(measured, stamps, terms), elastic, atol=1e-10)


@settings(max_examples=50)
@given(
    st.lists(st.floats(0.0, 2.0), min_size=1, max_size=3),
    st.lists(st.floats(0.01, 1e4), min_size=3, max_size=3),
    st.integers(0, 2**32 - 1),
)
def test_any_relaxation_is_inverted_while_the_contact_pushes(shares, times, seed):
    terms = [RelaxationTerm(share=share, time_constant=tau) for share, tau in zip(shares, times, strict=False)]
    random = np.random.default_rng(seed)
    stamps = np.cumsum(np.r_[0.0, random.uniform(0.01, 0.5, 50)])
    elastic = np.cumsum(np.r_[0.0, random.uniform(0.0, 0.2, 50)])
    found = invert_relaxation(apply_relaxation(elastic, stamps, terms), stamps, terms)
    np.testing.assert_allclose(found, elastic, atol=1e-8)


def test_filter_and_course_agree():
    random = np.random.default_rng(5)
    stamps = np.cumsum(np.r_[0.0, random.uniform(0.02, 0.05, 500)])
    elastic = np.interp(stamps, [0, 2, 6, 8, 20], [0, 4, 4, 1, 1])
    np.testing.assert_allclose(follow(elastic, stamps), apply_relaxation(elastic, stamps, TERMS), atol=1e-12)


@pytest.mark.parametrize("gap", [0.5, 5.0, 50.0, 600.0])
@pytest.mark.parametrize("rise", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("late", [0.0, 0.5, 1.0])
def test_a_force_that_came_in_a_gap_is_within_the_doubt_wherever_in_it(gap, rise, late):
    """Rises within a share of the gap, early in it or late, and the images begin again at its end."""
    begin = late * (1.0 - rise) * gap
    stamps = np.array([0.0, begin, begin + rise * gap, gap])
    true = follow(np.array([0.0, 0.0, 3.0, 3.0]), stamps)[-1]
    filter_, doubt = Relaxation(TERMS), Relaxation(TERMS)
    found = filter_.update(3.0 * ALONG, gap) @ ALONG
    doubt.doubt(3.0 * ALONG, gap)
    assert abs(found - true) < 2.0 * np.linalg.norm(doubt.overstress)


def test_doubt_of_a_gap_fades_and_hardly_grows_between_images():
    doubt = Relaxation(TERMS)
    for _ in range(30):  # a ramp of 3 N in a second
        doubt.update(np.zeros(3), 1.0 / 30.0)
        doubt.doubt(0.1 * ALONG, 1.0 / 30.0)
    assert np.linalg.norm(doubt.overstress) < 0.01
    doubt.doubt(3.0 * ALONG, 10.0)
    before = np.linalg.norm(doubt.overstress)
    doubt.update(np.zeros(3), 40.0)
    assert np.linalg.norm(doubt.overstress) < 0.01 * before
