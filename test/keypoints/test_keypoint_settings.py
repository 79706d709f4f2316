import ast
from dataclasses import fields, replace
from pathlib import Path

import pytest

import finforce_keypoints
from finforce_keypoints.errors import DetectorSettingsError
from finforce_keypoints.parameters import DetectorParameters, DetectorSettings

NUMBERS = [item for item in fields(DetectorSettings) if item.metadata.get("min") is not None]


def test_every_setting_says_what_it_is():
    for item in fields(DetectorSettings):
        assert item.metadata["description"] and "unit" in item.metadata, item.name


def test_every_setting_is_read():
    read = set()
    for path in Path(finforce_keypoints.__file__).parent.rglob("*.py"):
        read |= {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
    unread = {item.name for item in fields(DetectorSettings)} - read
    assert not unread


@pytest.mark.parametrize("item", NUMBERS, ids=lambda item: item.name)
def test_defaults_lie_within_their_bounds_and_values_beyond_are_refused_by_name(item):
    assert item.metadata["min"] <= item.default <= item.metadata["max"]
    for value in (item.metadata["min"] - 1.0, 2.0 * item.metadata["max"] + 1.0, float("nan")):
        with pytest.raises(DetectorSettingsError, match=item.name):
            replace(DetectorSettings(), **{item.name: value})


def test_bounds_that_cross_are_refused():
    with pytest.raises(DetectorSettingsError, match="opening_max"):
        DetectorSettings(opening_min=0.05, opening_max=0.04)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("detection_method", "foo"),
        ("jaws", "middle"),
        ("threads", 0),
        ("depth_scale", float("nan")),
        ("sync_tolerance", 0.5),
        ("color_topics", ()),
        ("color_topics", ("",)),
    ],
)
def test_a_parameter_that_cannot_be_is_refused_by_name(name, value):
    with pytest.raises(DetectorSettingsError, match=f"^{name}: got .*expected"):
        DetectorParameters(**{name: value})
