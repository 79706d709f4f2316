"""Claims about what is drawn of key points and said of them."""

import json
from types import SimpleNamespace

import numpy as np
from keypoint_node_fakes import COUNT, JAW, FakeKeypoints

from finforce.health import Level
from finforce_keypoints.diagnostics import (
    COLORS,
    LINE,
    build_skeleton,
    describe_names,
    draw_keypoints,
    outcome_of_keypoints,
)

GREY = np.full((60, 80, 3), 128, dtype=np.uint8)


def keypoints(*pixels, reasons=None):
    """Key points at these pixels, the others at none."""
    places = np.full((COUNT, 2), np.nan)
    places[: len(pixels)] = pixels
    said = np.full(COUNT, "image", dtype=object)
    said[: len(pixels)] = reasons or ""
    return FakeKeypoints(pixels=places, reasons=said, valid=said == "")


def is_color(picture, pixel, color):
    column, row = pixel
    return (picture[row, column] == color).all()


def test_a_key_point_is_a_disc_at_its_column_and_row_with_a_free_centre():
    picture = draw_keypoints(GREY, [keypoints((50.0, 20.0))])
    assert is_color(picture, (52, 20), COLORS[""]) and is_color(picture, (50, 22), COLORS[""])
    assert is_color(picture, (50, 20), (128, 128, 128)) and is_color(picture, (20, 50), (128, 128, 128))
    assert (GREY == 128).all()


def test_the_colour_says_why_a_key_point_is_not_used():
    reasons = ["likelihood", "depth", "workspace"]
    picture = draw_keypoints(GREY, [keypoints((10, 10), (30, 10), (50, 10), reasons=reasons)], [[0, 1]])
    for column, reason in zip((12, 32, 52), reasons, strict=True):
        assert is_color(picture, (column, 10), COLORS[reason])
    assert not (picture == LINE).all(axis=2).any()


def test_used_neighbours_are_joined():
    picture = draw_keypoints(GREY, [keypoints((10.0, 10.0), (30.0, 30.0))], [[0, 1]])
    assert is_color(picture, (20, 20), LINE)


def test_what_lies_outside_the_picture_or_nowhere_is_not_drawn():
    far = keypoints((1e12, 5.0), (-20.0, 30.0), (np.nan, 5.0))
    assert (draw_keypoints(GREY, [far]) == GREY).all()
    edge = draw_keypoints(GREY, [keypoints((79.0, 59.0))])
    assert is_color(edge, (77, 59), COLORS[""])


def test_a_skeleton_joins_each_key_point_to_its_neighbours():
    pairs = {tuple(pair) for pair in build_skeleton(JAW.keypoint_names)}
    rows = {name: row for row, name in enumerate(JAW.keypoint_names)}
    # two bands of seven that end in the tip, and seven ribs
    assert len(pairs) == 7 + 7 + 7
    assert (rows["inner_7"], rows["tip"]) in pairs and (rows["inner_7"], rows["outer_1"]) not in pairs


def test_names_without_numbers_have_no_skeleton():
    said = json.loads(describe_names(["a", "b"], SimpleNamespace(name="dots", sha256="")))
    assert said == {"names": ["a", "b"], "skeleton": [], "model": "dots", "sha256": ""}


def test_three_visible_key_points_are_enough():
    assert outcome_of_keypoints(keypoints((1, 1), (2, 2), (3, 3)), "left").level == Level.OK
    assert outcome_of_keypoints(keypoints((1, 1), (2, 2)), "left").level == Level.WARN
    assert outcome_of_keypoints(None, "left").level == Level.WARN
