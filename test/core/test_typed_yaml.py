"""Claims about YAML files of a fixed form: every key that is shipped is a field, every field is documented."""

from importlib import resources
from pathlib import Path
from typing import get_args

import pytest
import yaml
from pydantic import Field

from finforce.errors import FinforceError
from finforce.typed_yaml import FileModel, Length, parse_model, read_model
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw_file import JawEntry
from finforce_keypoints.networks.metadata import ModelMetadata, OwnSection

DOCS = Path(__file__).parents[2] / "docs"
FILES = resources.files("finforce_ifea.jaw")
SHIPPED = [
    *((path, JawEntry) for path in sorted(FILES.joinpath("jaws").glob("*.yaml"))),
    *((path, Calibration) for path in sorted(FILES.joinpath("calibrations").glob("*.yaml"))),
]


class FormError(FinforceError):
    pass


def models_in(annotation):
    """The models that a type is made of."""
    if isinstance(annotation, type) and issubclass(annotation, FileModel):
        return {annotation}
    return {model for part in get_args(annotation) for model in models_in(part)}


def all_models(kind):
    found, queue = set(), [kind]
    while queue:
        model = queue.pop()
        found.add(model)
        new = {part for field in model.model_fields.values() for part in models_in(field.annotation)}
        queue += new - found
    return found


def known_words(kind):
    return {name for model in all_models(kind) for name in model.model_fields}


def keys_of(content):
    """The keys of all mappings but those whose keys are names that a user gives."""
    for key, value in content.items() if isinstance(content, dict) else ():
        yield key
        if key not in ("uncertainty",) and not (key == "keypoints" and "rule" not in value):
            for part in value if isinstance(value, list) else [value]:
                yield from keys_of(part)


@pytest.mark.parametrize(("path", "kind"), SHIPPED, ids=lambda value: getattr(value, "stem", ""))
def test_every_key_of_a_shipped_file_is_a_field(path, kind):
    read_model(path, kind, FormError)
    assert set(keys_of(yaml.safe_load(path.read_text()))) <= known_words(kind)


def test_the_configuration_of_the_shipped_network_has_the_keys_that_are_read():
    path = resources.files("finforce_keypoints").joinpath("models", "plane", "pytorch_config.yaml")
    metadata = read_model(path, ModelMetadata, FormError)
    assert metadata.stride == 4.0 and len(metadata.bodyparts) == 16
    assert set(yaml.safe_load(path.read_text())["finforce"]) <= set(OwnSection.model_fields)


@pytest.mark.parametrize(
    ("kind", "page"), [(JawEntry, "your_finger"), (Calibration, "calibration"), (ModelMetadata, "keypoints")]
)
def test_every_key_is_described_and_stands_in_the_documentation(kind, page):
    text = (DOCS / f"{page}.md").read_text()
    for model in all_models(kind):
        for name, field in model.model_fields.items():
            assert field.description, (model, name)
            if kind is not ModelMetadata or model is OwnSection:
                assert f"`{name}`" in text or f"{name}:" in text, (model, name)


class Plate(FileModel):
    width: Length = Field(gt=0.0, description="Width [m]")
    holes: tuple[Length, ...] = Field((), description="Their places [m]")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"width": 0.1, "hole": [0.1]}, "unknown key 'hole'; did you mean 'holes'?"),
        ({"width": 0.1, "colour": 1}, "unknown key 'colour'; expected one of width, holes"),
        ({}, "width is missing"),
        ({"width": "wide"}, "width: got the text 'wide', expected a valid number"),
        ({"width": True}, "width: got the switch True, expected a number"),
        ({"width": -1}, "width: got -1, expected greater than 0"),
        ({"width": float("nan")}, "width: got nan, expected a finite number"),
        ({"width": 80}, "width: got 80, which looks like millimetres; expected metres, such as 0.08"),
        ({"width": 0.1, "holes": [0.1, None]}, "holes[1]: got nothing, expected a valid number"),
        ([1], "got a list [1], expected a mapping of width, holes"),
    ],
)
def test_what_is_wrong_is_told_in_one_sentence(content, words):
    with pytest.raises(FormError) as caught:
        parse_model(content, Plate, FormError)
    assert str(caught.value) == words


def test_numbers_may_be_written_as_texts_that_are_numbers():
    assert parse_model({"width": "1e-2"}, Plate, FormError).width == 0.01  # YAML takes 1e-2 for a text
