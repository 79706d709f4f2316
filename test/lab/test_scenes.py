"""Rendered scenes: states between others, made once, and another one for another scene."""

from dataclasses import replace

import numpy as np
import pytest
from rgbd_fakes import FakeGripper
from scipy.spatial.transform import Rotation

from finforce_sim.scenarios import write_script
from lab import scenes
from lab.bench import chain
from lab.scenes import GRASP, find_scene


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
    others = [replace(GRASP, seed=3), replace(GRASP, changes={"rate": 60}), replace(GRASP, changes={"settle": 0.1})]
    assert len({scenes.fingerprint(scene) for scene in [GRASP, *others]}) == 4
    assert scenes.fingerprint(GRASP) == scenes.fingerprint(replace(GRASP))


@pytest.mark.parametrize("rate", chain.RATES)
def test_the_scene_of_the_chain_has_an_image_every_period_of_its_camera(rate):
    scenario = replace(GRASP, changes={**GRASP.changes, "rate": rate}).build()
    np.testing.assert_allclose(np.diff(write_script(scenario).stamps), 1.0 / rate, atol=1e-9)
