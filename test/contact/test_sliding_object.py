"""An object that is drawn along the jaws or rocked: contact and force follow it, and nothing pulls that does not."""

import numpy as np
import pytest

from finforce.gripper_frames import jaw_in_gripper
from finforce.transforms import invert_pose
from finforce_contact.estimator import ContactEstimator
from finforce_contact.loop import ForceLoop
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.observation import Observation
from finforce_ifea.settings import EstimatorSettings
from finforce_sim.gripper import TwinGripper
from finforce_sim.scenarios import build_scenario
from finforce_sim.simulated_recording import disturb_pose

NOISE = 0.05e-3  # [m] of key points


@pytest.fixture(scope="module", params=["shifting", "rocking"])
def course(request):
    """Time [s], true and found force (3,) [N], true and found height of the pressure [m], image by image."""
    gripper, random = TwinGripper(build_scenario(request.param), 0), np.random.default_rng(2)
    force = ForceEstimator(
        gripper.jaws["left"], settings=EstimatorSettings(held="yes"), calibration=load_calibration("twin")
    )
    loop, rows = ForceLoop(ContactEstimator(force.jaw, mesh=gripper.object_mesh), force), []
    for number, state in enumerate(gripper.states()):
        jaw = state.jaws["left"]
        T = invert_pose(jaw_in_gripper("left", jaw.origin_x)) @ disturb_pose(state.T_gripper_object, random)
        points = jaw.keypoints + NOISE * random.standard_normal(jaw.keypoints.shape)
        observation = Observation(stamp=state.stamp, points=points, likelihood=np.ones(len(points)))
        solution = loop.update(observation, [(state.stamp, T)] if number % 3 == 0 else [])
        pressed = abs(jaw.force[0]) > 0.5
        height = jaw.torque[1] / jaw.force[0] if pressed else np.nan
        place = solution.contact_point[2] if solution.trusted and pressed else np.nan
        rows.append(
            (state.stamp, *jaw.force, *(solution.force if solution.trusted else np.full(3, np.nan)), height, place)
        )
    return np.array(rows)


def test_force_and_place_follow_it(course):
    held = np.isfinite(course[:, 7])
    error = course[held, 4:7] - course[held, 1:4]
    answered = np.isfinite(error).all(axis=1)
    assert answered.mean() > 0.9
    magnitude = np.linalg.norm(course[held, 4:7], axis=1) - np.linalg.norm(course[held, 1:4], axis=1)
    assert np.sqrt(np.nanmean(magnitude**2)) < 0.1
    assert np.nanmedian(np.abs(course[held, 8] - course[held, 7])) < 1e-3
    assert np.ptp(course[held, 7]) > 6e-3


def test_nothing_pulls_along_the_finger_where_nothing_rubs(course):
    held = np.isfinite(course[:, 7])
    along = course[held, 6] - course[held, 3]
    assert np.sqrt(np.nanmean(along**2)) < 0.4
