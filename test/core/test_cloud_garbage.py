"""A claim about point clouds from anywhere: whatever their descriptions say, they are decoded or refused."""

import random
from types import SimpleNamespace

import numpy as np
import pytest

from finforce.errors import ObservationError
from finforce.messages import decode_columns, decode_keypoints

POINTS, STEP = 15, 16
FIELDS = (("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("likelihood", 12, 7, 1))
LIMITS = (-1, 0, 1, 3, 12, 17, 2**31 - 1, 2**31, 2**32 - 1)


def cloud(fields=FIELDS, **changes):
    described = [
        SimpleNamespace(name=name, offset=offset, datatype=kind, count=count) for name, offset, kind, count in fields
    ]
    own = {"height": 1, "width": POINTS, "point_step": STEP, "row_step": STEP * POINTS, "is_bigendian": False}
    data = changes.pop("data", np.zeros(STEP * POINTS, np.uint8))
    return SimpleNamespace(fields=described, data=data, **(own | changes))


def test_twenty_thousand_descriptions_are_decoded_or_refused():
    dice, decoded = random.Random(0), 0
    for _ in range(20_000):
        fields = [list(field) for field in FIELDS]
        for _ in range(dice.randint(0, 2)):
            field = dice.choice(fields)
            place = dice.randrange(4)
            field[place] = dice.choice(("", "x", "valid", "stddev_x", "\0")) if place == 0 else dice.choice(LIMITS)
        sizes = {
            name: dice.choice(LIMITS) for name in ("height", "width", "point_step", "row_step") if dice.random() < 0.15
        }
        data = np.zeros(dice.choice((STEP * POINTS,) * 4 + (0, 1, STEP * POINTS - 1)), np.uint8)
        try:
            found = decode_keypoints(cloud(fields, data=data, is_bigendian=dice.random() < 0.3, **sizes))
        except ObservationError:
            continue
        decoded += 1
        assert found.points.shape == (len(found.likelihood), 3)
    assert 1000 < decoded < 19_000


@pytest.mark.parametrize("name", [name for name, *_ in FIELDS] + ["valid"])
def test_a_field_of_several_numbers_is_named(name):
    fields = [field for field in FIELDS if field[0] != name] + [(name, 0, 2, 2)]
    with pytest.raises(ObservationError, match=f"field '{name}' has 2 numbers a point; expected count 1"):
        decode_columns(cloud(fields), ("x", "y", "z"), ("likelihood", "valid"))
