"""Claims about the scores of the contact, against numbers counted by hand."""

import numpy as np
import pytest
from test_scoring import make_result

from finforce_eval.evaluation.scoring import distances, loaded_distance, onset_delays, onset_stats


def contact_result(truth, *, touching=None, given=None, place=None, cycle=None, pressure=0.040):
    frames = len(truth)
    nothing = np.full(frames, np.nan)
    places = np.full((frames, 3), np.nan)
    places[:, 2] = nothing if place is None else place
    cycles = np.zeros(frames, int) if cycle is None else np.asarray(cycle)
    return make_result(
        truth=truth,
        force=truth,
        contact_source="estimate",
        contact_height=nothing if given is None else np.asarray(given, float),
        true_height=np.full(frames, pressure),
        touching=None if touching is None else np.asarray(touching, bool),
        contact_location=places,
        cycle=cycles,
    )


def given_distance(result):
    return loaded_distance(result, result.column("contact_height"))


def solved_distance(result):
    return loaded_distance(result, result.column("contact_location")[:, 2])


def test_places_are_compared_where_something_presses():
    result = contact_result(
        [0.0, 0.1, 0.3, 1.0, 1.0], given=[0.0, 0.0, 0.041, 0.037, np.nan], place=[0.0, 0.0, 0.04, 0.042, 0.04]
    )
    np.testing.assert_allclose(given_distance(result), [np.nan, np.nan, 1e-3, 3e-3, np.nan])
    stats = distances([given_distance(result)])
    assert (stats["n"], stats["median_mm"], stats["max_mm"]) == (2, pytest.approx(2.0), pytest.approx(3.0))
    assert stats["p95_mm"] == pytest.approx(2.9)
    assert distances([solved_distance(result)])["median_mm"] == pytest.approx(0.0)
    assert distances([solved_distance(result)])["n"] == 3


def test_result_without_contact_has_no_place_and_no_onset():
    result = make_result(truth=[1.0], force=[1.0])
    assert distances([given_distance(result)])["n"] == 0
    assert distances([solved_distance(result)])["median_mm"] is None
    assert onset_delays(result) == []
    assert onset_stats([result])["median_frames"] is None


FORCE = [0, 0, 0, 0.01, 0.03, 1, 1, 0, 0]


@pytest.mark.parametrize(
    ("touching", "delay"),
    [
        ([0, 0, 0, 0, 1, 1, 1, 0, 0], 0),
        ([0, 0, 0, 0, 0, 0, 1, 1, 0], 2),
        ([0, 0, 0, 1, 1, 1, 1, 0, 0], -1),
        ([0, 1, 0, 0, 0, 1, 1, 0, 0], 1),
        ([0, 0, 0, 0, 1, 0, 1, 0, 0], 2),
        ([1, 1, 1, 1, 1, 1, 1, 1, 1], -4),
        ([0, 0, 0, 0, 0, 0, 0, 0, 0], None),
        ([1, 1, 1, 1, 0, 0, 0, 1, 1], None),
    ],
    ids=["at once", "late", "early", "false alarm before", "flicker after", "always", "never", "beside it"],
)
def test_delay_is_from_the_first_true_force_to_the_touch_that_stays(touching, delay):
    assert onset_delays(contact_result(FORCE, touching=touching)) == [delay]


def test_cycles_are_counted_apart_and_what_lingers_from_the_last_one_is_no_touch():
    touching = [0, 0, 0, 0, 0, 1, 1, 1, 1] + [1, 1, 0, 0, 0, 0, 1, 1, 1]
    result = contact_result(FORCE * 2, touching=touching, cycle=[0] * 9 + [1] * 9)
    assert onset_delays(result) == [1, 2]
    stats = onset_stats([result, contact_result(FORCE, touching=[0] * 9)])
    assert (stats["n"], stats["missed"]) == (2, 1)
    assert (stats["median_frames"], stats["earliest_frames"], stats["max_frames"]) == (1.5, 1, 2)


def test_touches_without_true_force_are_false():
    result = contact_result(FORCE, touching=[1, 0, 0, 0, 0, 1, 1, 1, 0])
    assert onset_stats([result])["false_pct"] == pytest.approx(100 * 2 / 6)


def test_touch_that_is_never_let_go_is_early_by_the_whole_pause():
    touching = [0, 0, 0, 0, 1] + [1] * 13
    result = contact_result(FORCE * 2, touching=touching, cycle=[0] * 9 + [1] * 9)
    # the force ends after frame 6; the next true contact is at frame 13
    assert onset_delays(result) == [0, -6]


def test_cycle_that_begins_under_load_has_no_onset():
    assert onset_delays(contact_result([1, 1, 0, 0], touching=[1, 1, 0, 0])) == []


def test_contact_that_does_not_say_whether_it_touches_has_no_onset():
    assert onset_delays(contact_result(FORCE)) == []
