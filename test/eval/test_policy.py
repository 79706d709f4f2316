"""Claims about the rows of numbers that policies get of forces, from datasets and at run time."""

import sys
from enum import Enum
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from finforce.camera import ImageError
from finforce.errors import MissingDependencyError
from finforce_eval import policy
from finforce_eval.errors import OptionError
from finforce_eval.policy import ForceInput, PolicyForces
from finforce_eval.sensor import GripperForces
from finforce_eval.table import ForceSeries
from finforce_ifea.observation import blank_solution

NOTHING, UNKNOWN = np.full(3, np.nan), (np.nan, np.nan)


def test_a_row_repeats_the_last_answer_and_says_that_it_is_none():
    forces = PolicyForces(("left",))
    rows = [
        forces.update({"left": force}, {"left": np.ones(3)}, UNKNOWN)
        for force in (NOTHING, np.array([-1.0, 0.0, 0.5]), NOTHING)
    ]
    np.testing.assert_array_equal(rows, [[0, 0, 0, 0], [-1, 0, 0.5, 1], [-1, 0, 0.5, 0]])
    forces.reset()
    np.testing.assert_array_equal(forces.update({}, {}, UNKNOWN), np.zeros(4))


def test_every_group_has_its_own_flag():
    forces = PolicyForces(("left", "right"), ("force", "grasp"))
    row = dict(zip(forces.names, forces.update({"right": np.ones(3)}, {}, UNKNOWN), strict=True))
    assert [name for name, value in row.items() if value] == [
        f"force.right.{name}" for name in ("x", "y", "z", "valid")
    ]
    assert list(row)[-2:] == ["force.grasp", "force.grasp.valid"]


def test_rows_of_an_episode_are_those_of_its_images_one_by_one():
    rng = np.random.default_rng(0)
    force, stddev = rng.normal(size=(20, 3)), rng.uniform(size=(20, 3))
    force[[0, 1, 7, 19]] = np.nan
    columns = {"force": force, "force_stddev": stddev}
    series = {"left": ForceSeries.build("case", "left", np.arange(20), **columns)}
    forces = PolicyForces(("left",), ("force", "stddev", "grasp"))
    grasp = np.stack([np.linalg.norm(force, axis=1), np.where(np.isnan(force[:, 0]), np.nan, 0.1)], axis=1)
    rows = forces.rows_of(series, grasp)
    assert rows.dtype == np.float32 and np.isfinite(rows).all() and not rows[:2].any()
    np.testing.assert_array_equal(rows[7, :6], rows[6, :6])
    np.testing.assert_array_equal(rows[:, 6], np.isfinite(force[:, 0]))
    np.testing.assert_array_equal(forces.rows_of(series, grasp), rows)  # from the start again


@pytest.mark.parametrize(
    "given", [{"columns": ()}, {"columns": ("torque",)}, {"prefix": "action.force"}, {"prefix": ""}]
)
def test_columns_and_prefixes_that_no_policy_could_take_are_refused(given):
    with pytest.raises(OptionError, match="expected"):
        PolicyForces(("left",), **given)


class FakeSensor:
    """Answers with the brightness of the picture; a black one it rejects."""

    def __init__(self, *given, **more):
        self.given, self.stamps = more, []

    def reset(self):
        self.stamps = []

    warm_up = reset

    def update(self, rgb, depth, stamp):
        assert rgb.shape == (4, 6, 3) and rgb.dtype == np.uint8
        if not rgb.any():
            raise ImageError("black")
        self.stamps.append(stamp)
        solution = blank_solution(stamp, "ok", "", np.ones(3, bool))
        solution = solution._replace(force=np.array([-float(rgb.max()), 0.0, 0.0]), force_stddev=np.ones(3))
        return GripperForces(
            stamp=stamp, jaws={"left": solution}, status="ok", grasp=float(rgb.max()), grasp_stddev=0.1
        )

    def skip(self, stamp, reason):
        return GripperForces(stamp=stamp, jaws={}, status=reason)


def picture(value):
    return np.full((4, 6, 3), value, np.uint8)


def test_an_image_that_is_rejected_costs_its_own_answer():
    sensor = FakeSensor()
    source = ForceInput(sensor, PolicyForces(("left",)), 30.0)
    rows = [source.update(picture(value)) for value in (3, 0, 5)]
    np.testing.assert_array_equal(np.array(rows)[:, [0, 3]], [[-3, 1], [-3, 0], [-5, 1]])
    assert sensor.stamps == pytest.approx([0.0, 2 / 30]) and source.last.status == "ok"
    source.reset()
    assert source.last is None and not source.update(picture(0)).any()
    with pytest.raises(OptionError, match="images per second"):
        ForceInput(sensor, PolicyForces(("left",)), 0.0)


class FakeRegistry:
    @staticmethod
    def register(name):
        return lambda kind: kind


@pytest.fixture
def step(monkeypatch):
    """The module of the step, with the few names of LeRobot that it needs."""
    package, processor, types = (ModuleType(name) for name in ("lerobot", "lerobot.processor", "lerobot.configs.types"))
    processor.ProcessorStepRegistry, processor.ObservationProcessorStep = FakeRegistry, object
    types.PipelineFeatureType = Enum("PipelineFeatureType", ["ACTION", "OBSERVATION"])
    types.FeatureType = Enum("FeatureType", ["STATE", "VISUAL"])
    types.PolicyFeature = SimpleNamespace
    for module in (package, processor, types):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(sys.modules, "lerobot.configs", ModuleType("lerobot.configs"))
    monkeypatch.delitem(sys.modules, "finforce_eval.lerobot", raising=False)
    import finforce_eval.lerobot as module

    monkeypatch.setattr(module, "ForceSensor", FakeSensor)
    yield module
    sys.modules.pop("finforce_eval.lerobot", None)


def test_without_lerobot_the_step_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "lerobot.processor", None)
    monkeypatch.delitem(sys.modules, "finforce_eval.lerobot", raising=False)
    with pytest.raises(MissingDependencyError, match="pip install lerobot"):
        import finforce_eval.lerobot  # noqa: F401


def test_a_robot_gets_a_number_under_each_name(step):
    one = step.ForceProcessorStep(camera="wrist", contact_height=0.04, rig="umi.yaml", sides=["left"])
    seen = one.observation({"wrist": picture(7), "gripper.pos": 0.5})
    assert {name: seen[name] for name in one.names} == dict(zip(one.names, [-7.0, 0.0, 0.0, 1.0], strict=True))
    assert seen["gripper.pos"] == 0.5 and one.status == "ok"
    kind = step._types.PipelineFeatureType
    added = one.transform_features({kind.OBSERVATION: {"gripper.pos": float}, kind.ACTION: {}})
    assert list(added[kind.OBSERVATION]) == ["gripper.pos", *one.names] and added[kind.ACTION] == {}
    with pytest.raises(ImageError, match="no image wrist"):
        one.observation({"front": picture(7)})


@pytest.mark.parametrize("into", ["state", "feature"])
def test_an_observation_for_a_policy_gets_them_in_its_state_or_beside_it(into, step):
    one = step.ForceProcessorStep(
        camera="observation.images.wrist", contact_height=0.04, rig="r", sides=["left"], into=into
    )
    image = np.float32(picture(51).transpose(2, 0, 1)[None]) / np.float32(255)
    seen = one.observation({"observation.images.wrist": image, "observation.state": np.float32([[1.0, 2.0]])})
    wanted = [[1.0, 2.0, -51.0, 0.0, 0.0, 1.0]] if into == "state" else [[-51.0, 0.0, 0.0, 1.0]]
    name = "observation.state" if into == "state" else "observation.force"
    np.testing.assert_array_equal(seen[name], wanted)
    kind = step._types.PipelineFeatureType.OBSERVATION
    known = {kind: {"observation.state": SimpleNamespace(shape=(2,))}}
    assert one.transform_features(known)[kind][name].shape == (np.shape(wanted)[1],)
    assert known[kind]["observation.state"].shape == (2,)
    with pytest.raises(ImageError, match="one robot at a time"):
        one.observation({"observation.images.wrist": image, "observation.state": np.zeros((2, 2))})


def test_what_a_step_is_made_from_makes_another(step):
    one = step.ForceProcessorStep(contact_height=0.04, rig="umi.yaml", columns=["grasp"], settings={"tare_frames": 20})
    other = step.ForceProcessorStep(**one.get_config())
    assert other.get_config() == one.get_config() and other.names == ("force.grasp", "force.grasp.valid")
    with pytest.raises(OptionError, match="into none"):
        step.ForceProcessorStep(contact_height=0.04, rig="umi.yaml", into="none")


@pytest.mark.parametrize("shape", [(4, 6, 3), (3, 4, 6), (1, 3, 4, 6)])
def test_pictures_in_every_form_are_the_same_bytes(shape, step):
    values = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)
    moved = values if shape[-1] == 3 else values.transpose(2, 0, 1).reshape(shape)
    np.testing.assert_array_equal(step.to_picture(moved), values)
    np.testing.assert_array_equal(step.to_picture(np.float32(moved) / np.float32(255)), values)


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.zeros((2, 3, 4, 6), np.float32), "expected one picture"),
        (np.zeros((4, 6), np.uint8), "expected one picture"),
        (np.full((3, 4, 6), -1.7, np.float32), "not normalised"),
        (np.full((3, 4, 6), np.nan, np.float32), "not normalised"),
        (np.zeros((4, 6, 3), np.uint16), "of uint16: expected uint8"),
    ],
)
def test_images_that_are_no_picture_are_refused(image, reason, step):
    with pytest.raises(ImageError, match=reason):
        step.to_picture(image)


def test_policy_names_no_library_of_its_users():
    assert "lerobot" not in vars(policy)
