"""Names of body parts and of key points."""

import pytest
from keypoint_scene_fakes import small_jaws

from finforce_keypoints.errors import NamingError
from finforce_keypoints.networks.metadata import build_name_map, parse_mapping

JAWS = small_jaws()  # inner_7, tip, reference
NAMES = ["right_tip", "left_reference", "left_inner_7", "right_inner_7", "left_tip", "right_reference"]


def test_names_of_both_jaws_are_sorted_into_the_order_of_the_jaw_file():
    names = build_name_map(NAMES, JAWS)
    assert names.rows["left"].tolist() == [2, 4, 1] and names.rows["right"].tolist() == [3, 0, 5]
    assert not names.is_of_one_jaw


def test_a_network_of_one_jaw_serves_both():
    names = build_name_map(["tip", "reference", "inner_7"], JAWS)
    assert names.is_of_one_jaw
    assert names.rows["left"].tolist() == names.rows["right"].tolist() == [2, 0, 1]


def test_a_jaw_that_is_not_wanted_may_be_in_the_network():
    names = build_name_map(NAMES, small_jaws(("right",)))
    assert list(names.rows) == ["right"]


def test_a_mapping_gives_the_names():
    bodyparts = ["thumb", "cap", *NAMES[1:]]
    names = build_name_map(bodyparts, JAWS, parse_mapping(["thumb = right_tip", "cap=-"]))
    assert names.rows["right"].tolist() == [4, 0, 6]


@pytest.mark.parametrize(
    ("bodyparts", "mapping", "message"),
    [
        (NAMES[1:], {}, "missing right_tip"),
        ([*NAMES, "left_elbow"], {}, "unknown left_elbow"),
        ([*NAMES, "cap"], {}, "unknown cap"),
        (["tip", "reference"], {}, "missing inner_7"),
        (["tip", "reference", "inner_7", "elbow"], {}, "unknown elbow"),
        (NAMES, {"cap": "-"}, "no body part cap"),
        (NAMES, {"left_tip": "right_tip"}, "several body parts are right_tip"),
        (NAMES, {"left_tip": "-"}, "missing left_tip"),
    ],
)
def test_unknown_missing_and_doubled_names_are_refused(bodyparts, mapping, message):
    with pytest.raises(NamingError, match=message):
        build_name_map(bodyparts, JAWS, mapping)


@pytest.mark.parametrize("entries", [["tip"], ["=tip"], ["thumb="], ["thumb=tip", "thumb=inner_7"]])
def test_entries_of_another_form_are_refused(entries):
    with pytest.raises(NamingError):
        parse_mapping(entries)
