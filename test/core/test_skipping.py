"""Claims about work that is left out: what stays the same without it, how to have it all done, and what is counted."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from estimator_fakes import BENCH, CALIBRATION, magnitudes, ramp, record

from finforce.health import ALL, IDLE, RULES, STILL, Idling, SkippingError, Skips
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.observation import OUT_OF_REACH, Contact, ObjectOutline, is_out_of_reach
from finforce_ifea.settings import EstimatorSettings

RADIUS, HEIGHT = 0.0125, 0.040
DEPTHS = ramp(2, 0)
FAR, NEAR = 0.020, 60  # m of gap; the frame from which the object stands at the jaw: the press begins
TENTH = 100_000_000  # ns


class TestRules:
    def test_only_rules_that_exist_can_be_off(self):
        with pytest.raises(SkippingError, match="no rule 'no object'; expected .*nothing moved"):
            Skips(("no object",))
        assert Skips(("",)).allows(STILL)

    def test_one_rule_or_all_can_be_off(self):
        one, everything = Skips((STILL,)), Skips((ALL,))
        assert not one.allows(STILL) and one.allows(IDLE)
        assert not any(everything.allows(rule) for rule in RULES)

    def test_the_diagnostics_say_how_often_each_was_applied(self):
        skips = Skips((IDLE,))
        skips.count(STILL)
        skips.count(STILL, 2)
        said = skips.describe()
        assert (said["skipped: nothing moved"], said["skipped: idle image"]) == ("3", "off")

    def test_the_page_lists_exactly_the_rules_that_nodes_count(self):
        page = (Path(__file__).parents[2] / "docs" / "evidence.md").read_text(encoding="utf-8")
        table = page.partition("\n## Skipped work")[2].partition("\n## ")[0]
        listed = re.findall(r"^\| `([^`]+)` \|", table, flags=re.MULTILINE)
        assert sorted(listed) == sorted(RULES)


class TestIdling:
    def test_of_every_tenth_of_a_second_one_image_is_answered(self):
        idling, answered = Idling(), []
        for stamp in range(0, 10 * TENTH, TENTH // 3):
            if not idling.passes(stamp):
                idling.note(stamp, True)
                answered.append(stamp)
        assert len(answered) == 10
        assert max(np.diff(answered)) < 1.4 * TENTH

    def test_two_nodes_answer_the_same_images_wherever_they_began(self):
        def answered(first):
            idling, chosen = Idling(), set()
            for stamp in range(first, 40 * TENTH, TENTH // 3):
                if not idling.passes(stamp):
                    idling.note(stamp, True)
                    chosen.add(stamp)
            return {stamp for stamp in chosen if stamp > 10 * TENTH}

        assert answered(0) == answered(7 * (TENTH // 3)) != set()

    def test_nothing_is_passed_over_once_something_happens(self):
        idling = Idling()
        idling.note(0, True)
        assert idling.passes(TENTH // 3)
        idling.note(TENTH // 2, False)
        assert not idling.passes(TENTH // 2 + 1)
        idling.note(TENTH, True)
        idling.end()
        assert not idling.passes(TENTH + 1)


def circle(gap):
    """The contact of a cylinder along y with a gap [m] before the jaw."""
    angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    outline = ObjectOutline(
        polygons=(RADIUS * np.stack([np.cos(angles), np.sin(angles)], axis=1),),
        origin=np.array([BENCH.inner_face_x + RADIUS + gap, HEIGHT]),
        tilt=0.0,
        stddev=np.array([0.5e-3, 0.5e-3, 5e-3]),
    )
    place = np.array([[BENCH.inner_face_x, 0.0, HEIGHT]])
    return Contact(points=place, weights=np.ones(1), touching=gap < 0.0, outline=outline)


@cache
def watched(*, far=True, near=NEAR):
    """Solutions of a press whose object is known to be far away at first, and in which images the jaw was idle."""
    settings = EstimatorSettings(solver="frame", friction=0.0, friction_stddev=0.03)
    recording = record(DEPTHS)
    estimator = ForceEstimator(BENCH, settings=settings, calibration=CALIBRATION)
    away, solutions, idle = circle(FAR if far else 1e-3), [], []
    for frame, (observation, depth) in enumerate(zip(recording.observations, DEPTHS, strict=True)):
        contact = away if frame < near else circle(-depth if depth > 0.0 else 1e-3)
        solutions.append(estimator.update(observation, contact))
        idle.append(estimator.is_idle)
    return solutions, np.array(idle)


class TestAnObjectOutOfReach:
    @pytest.mark.parametrize(
        ("change", "away"),
        [
            ({}, True),
            ({"touching": True}, False),
            ({"touching": None}, False),
            ({"outline": None}, False),
        ],
    )
    def test_only_an_outline_in_front_of_the_jaw_that_touches_nothing_is_away(self, change, away):
        contact = circle(FAR)
        for name, value in change.items():
            object.__setattr__(contact, name, value)
        assert is_out_of_reach(contact, BENCH.inner_face_x) is away

    @pytest.mark.parametrize(
        ("gap", "away"), [(OUT_OF_REACH + 1.6e-3, True), (OUT_OF_REACH + 1.4e-3, False), (-FAR, False)]
    )
    def test_what_the_place_may_err_counts_as_near(self, gap, away):
        contact = circle(gap)
        object.__setattr__(contact, "touching", False)
        assert is_out_of_reach(contact, BENCH.inner_face_x) is away

    def test_the_jaw_at_rest_is_idle_and_says_so(self):
        solutions, idle = watched()
        assert idle[46:NEAR].all() and not idle[NEAR:].any()
        first = solutions[50]
        assert (first.status, first.trusted, first.converged) == ("unloaded", True, True)
        assert "out of reach" in first.message and not first.force.any()

    def test_the_force_is_that_of_an_object_within_reach(self):
        idle, solved = (magnitudes(watched(far=far)[0]) for far in (True, False))
        known = np.isfinite(idle) & np.isfinite(solved)
        assert known[46:].mean() > 0.98
        difference = np.abs(idle - solved)
        # unloaded: what noise alone makes of the mechanics; pressed: how long a filter remembers where it began
        assert difference[46:NEAR].max() < 0.02
        assert np.nanmax(difference[NEAR:]) < 0.05
        assert np.nanmax(solved) > 0.5

    def test_a_jaw_that_something_else_bends_is_not_idle(self):
        solutions, idle = watched(near=10**6)
        pressed = DEPTHS > 0.5e-3
        assert not idle[pressed].any()
        assert np.nanmax(magnitudes(solutions)[pressed]) > 0.5

    def test_before_the_tare_nothing_is_idle(self):
        assert not watched()[1][:44].any()
