"""Rendered scenes: states between those of a script, made once, and another one for another scene."""

from dataclasses import replace

import numpy as np
import pytest
from rgbd_fakes import FakeGripper
from scipy.spatial.transform import Rotation

from finforce_sim.footage import START
from lab import scenes
from lab.bench import chain
from lab.bench.chain import FINE_RATE, slot_of
from lab.scenes import EVERY_RATE, GRASP, SmoothGripper, find_scene


def turned(state, angle):
    """A state whose object is turned about z [rad]."""
    pose = state.T_gripper_object.copy()
    pose[:3, :3] = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    return replace(state, T_gripper_object=pose)


def test_state_between_two_is_between_them_in_all():
    before, after = list(FakeGripper().states())[7:9]
    middle = turned(before, 0.2).blend(turned(after, 0.6), 0.25)
    assert middle.stamp == pytest.approx(before.stamp + 0.25 / 30.0)
    for name in ("keypoints", "force", "torque"):
        ends = [getattr(state.jaws["left"], name) for state in (before, after)]
        np.testing.assert_allclose(getattr(middle.jaws["left"], name), 0.75 * ends[0] + 0.25 * ends[1], atol=1e-12)
    turn = Rotation.from_matrix(middle.T_gripper_object[:3, :3]).as_rotvec()
    np.testing.assert_allclose(turn, [0.0, 0.0, 0.3], atol=1e-12)


def test_scene_without_an_object_has_none_in_between():
    before, after = list(FakeGripper(has_object=False).states())[:2]
    assert before.blend(after, 0.5).T_gripper_object is None


@pytest.mark.parametrize("rate", [30, 60, 90])
def test_a_camera_of_every_rate_finds_all_of_its_images(rate):
    gripper = SmoothGripper(FakeGripper(), EVERY_RATE)
    course = [round(state.stamp * FINE_RATE) for state in gripper.states()]
    slots = set(course)
    assert course == sorted(slots) and len(course) == len(gripper)
    assert set(range(0, max(slots) + 1, FINE_RATE // rate)) <= slots
    assert 1 not in slots  # no camera of these rates sees it


def test_states_of_the_script_are_not_changed():
    plain, smooth = list(FakeGripper().states()), list(SmoothGripper(FakeGripper(), EVERY_RATE).states())
    assert [state.stamp for state in smooth[::4]] == [state.stamp for state in plain]
    np.testing.assert_array_equal(smooth[32].jaws["left"].force, plain[8].jaws["left"].force)


def test_slots_are_those_of_the_stamps_that_a_scene_is_recorded_with():
    assert chain.START == START
    assert slot_of(START + round(1e9 * 7 / FINE_RATE)) == 7


def test_a_scene_is_rendered_once(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(scenes, "_render", lambda scene, path: (made.append(path), path.mkdir()))
    assert find_scene(GRASP, tmp_path) == find_scene(GRASP, tmp_path)
    assert len(made) == 1
    find_scene(replace(GRASP, seed=7), tmp_path)
    assert len(made) == 2


def test_a_scene_that_cannot_be_finished_leaves_nothing(tmp_path, monkeypatch):
    def fails(scene, path):
        path.mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(scenes, "_render", fails)
    with pytest.raises(KeyboardInterrupt):
        find_scene(GRASP, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_another_scene_or_rate_has_another_name():
    others = [replace(GRASP, seed=3), replace(GRASP, slots=(0, 3)), replace(GRASP, changes={"settle": 0.1})]
    assert len({scenes.fingerprint(scene) for scene in [GRASP, *others]}) == 4
    assert scenes.fingerprint(GRASP) == scenes.fingerprint(replace(GRASP))


def test_every_scene_of_the_benchmarks_can_be_built():
    for scene in (scenes.GRASP, scenes.GRASP_FAST):
        assert scene.build().name == scene.scenario
