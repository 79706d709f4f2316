"""The net force on the gripper is scored against the truth of both jaws."""

from dataclasses import replace

import numpy as np
import pytest
from test_scoring import make_result

from finforce_eval.evaluation.manipulation import format_manipulation, score_manipulation, score_pair


def jaws(count=10):
    """Results of both jaws that hold something of 0.5 N along y of the gripper, without an error."""
    force = np.tile([-3.0, 0.25, 0.0], (count, 1))
    other = np.tile([-3.0, -0.25, 0.0], (count, 1))
    stated = np.full((count, 3), 0.1)
    blank = make_result(truth=np.ones(count), force=np.ones(count), axis_stddev=stated)
    left = replace(blank, name="turn/left", force=force.copy(), truth=force.copy())
    return left, replace(blank, name="turn/right", side="right", force=other.copy(), truth=other.copy())


def test_jaws_that_are_right_make_a_net_force_that_is():
    score = score_pair(*jaws())
    assert score.vector_rmse_N == pytest.approx(0.0)
    assert score.within_3_sigma_pct == (100.0, 100.0, 100.0)
    assert score.answered_pct == 100.0


def test_errors_of_both_jaws_add_in_the_frame_of_the_gripper():
    left, right = jaws()
    left.force[:, 0] += 0.3  # x of the left jaw is that of the gripper, of the right jaw against it
    right.force[:, 0] += 0.1
    score = score_pair(left, right)
    assert score.axis_rmse_N == pytest.approx((0.2, 0.0, 0.0))
    assert score.vector_rmse_N == pytest.approx(0.2)


def test_images_without_one_of_the_jaws_count_as_unanswered():
    left, right = jaws()
    right.force[:4] = np.nan
    score = score_pair(left, right)
    assert (score.n, score.answered_pct) == (6, 60.0)
    right.force[:] = np.nan
    assert score_pair(left, right).vector_rmse_N is None


def test_recordings_of_one_jaw_have_no_score():
    left, right = jaws()
    assert score_manipulation({"a": replace(left, name="a")}) == {}
    both = score_manipulation({left.name: left, right.name: right})
    assert list(both) == ["turn"]
    assert "0.000 N" in format_manipulation(both)[0]
