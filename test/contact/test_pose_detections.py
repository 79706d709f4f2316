"""Claims about poses by vision_msgs over real ROS, in a process that has it; and about turns that nobody sees."""

from pathlib import Path

import message_fakes
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from finforce.transforms import rotation_between
from finforce_contact.estimator import ContactEstimator
from finforce_contact.parameters import ContactSettings
from finforce_contact.pose.symmetry import find_symmetries, read_symmetry
from finforce_ifea.errors import ContactError
from finforce_ifea.jaw.jaw import load_jaw
from finforce_sim.objects import build_object


def test_poses_of_foundationpose_over_real_ros():
    said = message_fakes.run_trials("vision_msgs", Path(__file__).with_name("detection_trials.py"))
    assert "7 passed" in said


@pytest.mark.parametrize(
    ("name", "turns"),
    [
        ("cylinder", ("x_180", "y_180", "z_full")),
        ("cube", ("x_90", "y_90", "z_90")),
        ("bottle", ("z_full",)),
        ("block", ("x_180", "y_180", "z_180")),
        ("mug", ()),
        ("wedge", ()),
    ],
)
def test_turns_that_map_an_object_onto_itself_are_found(name, turns):
    assert find_symmetries(build_object(name)) == turns


@pytest.mark.parametrize("name", ["cylinder", "cube", "bottle"])
def test_a_flipped_pose_is_turned_back_and_looks_the_same(name):
    """FoundationPoseROS2 18."""
    mesh, random = build_object(name), np.random.default_rng(3)
    symmetry = read_symmetry("auto", mesh)
    last = np.eye(4)
    last[:3, :3] = Rotation.random(random_state=4).as_matrix()
    last[:3, 3] = 0.1, 0.2, 0.3
    for turn in symmetry.turns:
        spin = np.eye(3) if symmetry.axis is None else Rotation.from_rotvec(2.0 * symmetry.axis).as_matrix()
        flipped = last.copy()
        nudge = Rotation.from_rotvec(random.normal(0.0, 0.02, 3)).as_matrix()
        flipped[:3, :3] = nudge @ last[:3, :3] @ turn @ spin
        flipped[:3, 3] += last[:3, :3] @ (symmetry.middle - turn @ spin @ symmetry.middle)
        chosen = symmetry.choose(flipped, last)
        assert rotation_between(chosen, last) < 0.1
        middles = [T[:3, :3] @ symmetry.middle + T[:3, 3] for T in (flipped, chosen)]
        assert middles[0] == pytest.approx(middles[1], abs=1e-9)


def test_a_pose_that_has_hardly_turned_stays_as_it_is():
    symmetry = read_symmetry("z_full x_180", build_object("cylinder"))
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.5]).as_matrix()
    assert symmetry.choose(turned, np.eye(4)) is turned


def test_what_looks_different_when_turned_is_not_turned_back():
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    for text in ("auto", "none"):
        assert read_symmetry(text, build_object("wedge")).choose(turned, np.eye(4)) is turned
    assert read_symmetry("none", build_object("cube")).choose(turned, np.eye(4)) is turned


@pytest.mark.parametrize("text", ["", "z", "w_180", "z_170", "z_5", "auto none", "x_full y"])
def test_a_symmetry_that_is_none_is_named(text):
    with pytest.raises(ContactError, match="symmetry .*expected auto, none, or words as x_180"):
        ContactEstimator(load_jaw("bench"), settings=ContactSettings(symmetry=text))
