"""Claims about two jaws as one gripper."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_gripper
from finforce.messages import NANOSECONDS
from finforce_ifea.grasp_force import (
    R_GRIPPER_JAW,
    ForcePairing,
    JawDistance,
    Wrench,
    combine_wrenches,
    single_jaw_grasp,
)

forces = hnp.arrays(np.float64, 3, elements=st.floats(-50, 50))
LEFT = Wrench(np.array([-2.0, 0.3, 0.5]), np.array([0.0, -0.08, 0.01]))
RIGHT = Wrench(np.array([-3.0, 0.1, 0.4]), np.array([0.0, -0.12, 0.0]))


def combine_forces(left, right):
    return combine_wrenches(Wrench(left, np.zeros(3)), Wrench(right, np.zeros(3)), None)


def test_an_object_squeezed_evenly_is_held_and_not_moved():
    force = np.array([-4.0, 0.0, 0.0])
    grasp = combine_forces(force, force)
    np.testing.assert_allclose(grasp.grasp, [4.0, 0.0, 0.0])
    np.testing.assert_allclose(grasp.manipulation, np.zeros(3))


def test_the_stronger_jaw_pushes_the_gripper_along_its_own_force():
    # the object presses the right jaw harder: outwards, along +x of gripper_base
    grasp = combine_forces(np.array([-2.0, 0, 0]), np.array([-3.0, 0, 0]))
    np.testing.assert_allclose(grasp.grasp, [2.0, 0.0, 0.0])
    np.testing.assert_allclose(grasp.manipulation, [1.0, 0.0, 0.0])


def test_a_weight_on_both_jaws_adds_up():
    grasp = combine_forces(np.array([-2.0, 0.5, -1.0]), np.array([-2.0, -0.5, -1.0]))
    np.testing.assert_allclose(grasp.manipulation, [0.0, 1.0, -2.0])


@given(forces, forces)
def test_the_grasp_force_is_never_negative_nor_above_either_jaw(left, right):
    held = combine_forces(left, right).grasp[0]
    assert 0.0 <= held <= min(np.linalg.norm(left), np.linalg.norm(right)) + 1e-9


@given(forces, forces)
def test_turning_the_gripper_round_swaps_the_jaws_and_turns_the_net_force(left, right):
    turned = combine_forces(right, left).manipulation * [-1, -1, 1]
    np.testing.assert_allclose(turned, combine_forces(left, right).manipulation)


def test_one_jaw_alone_holds_with_its_own_force():
    grasp = single_jaw_grasp(Wrench(np.array([-3.0, 0.0, 4.0]), np.array([0.1, 0.2, 0.3])), "right")
    np.testing.assert_allclose(grasp.grasp, [5.0, 0.0, 0.0])
    np.testing.assert_allclose(grasp.manipulation, [3.0, 0.0, 4.0])
    np.testing.assert_allclose(grasp.torque, [-0.1, -0.2, 0.3])


def test_the_torque_is_that_of_both_forces_about_the_middle_between_the_jaws():
    places = {"left": np.array([-0.03, 0.0, 0.0]), "right": np.array([0.03, 0.0, 0.0])}
    touched = {"left": np.array([0.014, 0.002, 0.05]), "right": np.array([0.013, -0.001, 0.04])}
    forces = {"left": np.array([-3.0, 0.2, 0.7]), "right": np.array([-2.0, 0.4, -0.3])}
    wrenches = {side: Wrench(forces[side], np.cross(touched[side], forces[side])) for side in forces}
    R = R_GRIPPER_JAW
    torque = sum(np.cross(places[side] + R[side] @ touched[side], R[side] @ forces[side]) for side in forces)
    grasp = combine_wrenches(wrenches["left"], wrenches["right"], 0.06)
    np.testing.assert_allclose(grasp.torque, torque, atol=1e-12)
    assert combine_wrenches(wrenches["left"], wrenches["right"], None).torque is None


def test_the_distance_of_the_jaws_is_known_while_both_are_seen():
    camera = np.linalg.inv(ROBOT_CAMERA)
    distance = JawDistance(max_age=0.5)
    distance.take("left", 10 * NANOSECONDS, camera @ jaw_in_gripper("left", -0.031))
    assert distance.at(10 * NANOSECONDS) is None
    distance.take("right", 10 * NANOSECONDS, camera @ jaw_in_gripper("right", 0.029))
    assert distance.at(10 * NANOSECONDS) == pytest.approx(0.060)
    assert distance.at(11 * NANOSECONDS) is None


@pytest.mark.parametrize("own_first", [True, False])
@pytest.mark.parametrize(("side", "own", "peer"), [("left", LEFT, RIGHT), ("right", RIGHT, LEFT)])
def test_a_pair_is_complete_with_its_second_force(side, own, peer, own_first):
    pairing = ForcePairing(side)
    first, second = (own, peer) if own_first else (peer, own)
    assert pairing.add(1, first, own=own_first) is None
    grasp = pairing.add(1, second, own=not own_first)
    np.testing.assert_allclose(grasp.manipulation, combine_wrenches(LEFT, RIGHT, None).manipulation)
    assert grasp.torque is None
    assert pairing.add(1, second, own=not own_first) is None


def test_forces_of_different_stamps_are_not_paired():
    pairing = ForcePairing("left")
    assert pairing.add(1, LEFT, own=True) is None
    assert pairing.add(2, RIGHT, own=False) is None


def test_what_nobody_answers_is_forgotten():
    pairing = ForcePairing("left", depth=4)
    for stamp in range(10):
        pairing.add(stamp, LEFT, own=True)
    assert pairing.add(5, RIGHT, own=False) is None
    assert pairing.add(6, RIGHT, own=False) is not None


def test_the_other_jaw_is_silent_until_it_is_heard():
    pairing = ForcePairing("left")
    pairing.add(1, LEFT, own=True)
    assert pairing.silence == float("inf")
    pairing.add(1, RIGHT, own=False)
    assert pairing.silence < 1.0
