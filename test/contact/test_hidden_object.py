"""An object that the closing jaws hide from whoever finds its pose: contact and force go on."""

import numpy as np
import pytest
from contact_fakes import FACE, JAW, cylinder, pose

from finforce.gripper_frames import jaw_in_gripper
from finforce.transforms import invert_pose
from finforce_contact.estimator import ContactEstimator
from finforce_contact.loop import ForceLoop
from finforce_contact.parameters import ContactSettings
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.observation import Observation
from finforce_sim.gripper import TwinGripper
from finforce_sim.scenarios import build_scenario
from finforce_sim.simulated_recording import disturb_pose

NOISE = 0.1e-3  # [m] of key points
TIMEOUT = ContactSettings().pose_timeout
SLOW = {"tare": 1.7, "closing_speed": 0.004, "displacement": 0.006, "levels": 2}


def play(*, is_hidden, changes):
    """True and found force and its deviation (n, 3) [N] of a jaw under load, the object hidden from its touch on."""
    gripper, random = TwinGripper(build_scenario("grasp_cylinder", **SLOW, **changes), 0), np.random.default_rng(3)
    force = ForceEstimator(gripper.jaws["left"], calibration=load_calibration("twin"))
    loop, rows, touched = ForceLoop(ContactEstimator(force.jaw, mesh=gripper.object_mesh), force), [], np.inf
    for number, state in enumerate(gripper.states()):
        jaw = state.jaws["left"]
        loop.follow_jaw(jaw_in_gripper("left", jaw.origin_x))
        touched = min(touched, state.stamp) if jaw.force.any() else touched
        T = invert_pose(jaw_in_gripper("left", jaw.origin_x)) @ disturb_pose(state.T_gripper_object, random)
        is_seen = number % 3 == 0 and not (is_hidden and state.stamp > touched + 0.2)
        points = jaw.keypoints + NOISE * random.standard_normal(jaw.keypoints.shape)
        observation = Observation(stamp=state.stamp, points=points, likelihood=np.ones(len(points)))
        solution = loop.update(observation, [(state.stamp, T)] if is_seen else [])
        if np.linalg.norm(jaw.force) > 0.2:
            found = solution.force if solution.trusted else np.full(3, np.nan)
            rows.append((jaw.force, found, solution.force_stddev))
    assert len(rows) > 3 * 30.0 * TIMEOUT
    return np.array(rows).swapaxes(0, 1)


@pytest.mark.parametrize("changes", [{}, {"roughness": 0.4, "friction": 2.0}], ids=["smooth", "rough"])
def test_forces_of_a_whole_grasp_are_as_accurate_without_poses(changes):
    errors = {}
    for is_hidden in (False, True):
        true, found, stddev = play(is_hidden=is_hidden, changes=changes)
        assert np.isfinite(found).all()
        assert (np.abs(found - true) < 3.0 * stddev + 0.02)[:, [0, 2]].mean() > 0.98
        errors[is_hidden] = np.sqrt(np.mean((found - true) ** 2, axis=0))
    assert (errors[True] < errors[False] + 0.1).all()


class TestEstimator:
    @pytest.fixture
    def held(self):
        """An estimator that has seen a cylinder 2 mm deep in the jaw for a second."""
        estimator = ContactEstimator(JAW, mesh=cylinder())
        for stamp in np.arange(10.0, 11.0, 0.1):
            estimator.take_pose(stamp, pose(FACE + 0.0125 - 0.002, 0.04))
            assert estimator.update(stamp).touching
        return estimator

    def test_the_pose_of_a_held_object_may_be_ten_times_as_old(self, held):
        assert held.update(11.0 + 9.0 * TIMEOUT).touching
        gone = held.update(11.0 + 11.0 * TIMEOUT)
        assert (gone.status, gone.contact) == ("no_pose", None)

    def test_an_object_that_the_jaw_has_left_is_held_no_longer(self, held):
        away = np.eye(4)
        away[0, 3] = 0.01
        held.carry(away)
        assert held.update(11.0).status == "apart"
        assert held.update(11.0 + 2.0 * TIMEOUT).status == "no_pose"

    def test_its_outline_is_not_taken_for_what_was_seen(self, held):
        seen = held.update(11.0).contact.outline.stddev
        later = held.update(11.0 + 5.0 * TIMEOUT).contact.outline.stddev
        assert (later[:2] > seen[:2]).all() and later[0] < 5e-3
