import ast
from dataclasses import fields, replace
from pathlib import Path

import pytest

import finforce_contact
from finforce_contact.parameters import MODES, ContactSettings
from finforce_ifea.errors import ContactError

NAMES = [item.name for item in fields(ContactSettings)]
NUMBERS = [item for item in fields(ContactSettings) if item.metadata["min"] is not None]


def test_every_setting_says_what_it_is():
    for item in fields(ContactSettings):
        assert item.metadata["description"], item.name
        assert "unit" in item.metadata, item.name


def test_every_setting_is_read():
    read = set()
    for path in Path(finforce_contact.__file__).parent.rglob("*.py"):
        tree = ast.parse(path.read_text())
        read |= {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert set(NAMES) <= read, set(NAMES) - read


@pytest.mark.parametrize("item", NUMBERS, ids=lambda item: item.name)
def test_defaults_lie_within_their_bounds_and_values_beyond_are_refused_by_name(item):
    assert item.metadata["min"] <= item.default <= item.metadata["max"]
    for value in (item.metadata["min"] - 1.0, 2.0 * item.metadata["max"] + 1.0, float("nan")):
        with pytest.raises(ContactError, match=item.name):
            replace(ContactSettings(), **{item.name: value})


def test_every_mode_is_accepted_and_another_one_refused():
    assert [ContactSettings(mode=mode).mode for mode in MODES] == list(MODES)
    with pytest.raises(ContactError, match="estimate, paper, closest"):
        ContactSettings(mode="fixed")
    with pytest.raises(ContactError, match="coarse, default, fine"):
        ContactSettings(mesh="dense")
