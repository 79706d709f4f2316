from copy import copy
from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest

from finforce.camera import project
from finforce_sim.gripper import TwinGripper
from finforce_sim.scenarios import build_scenario
from finforce_sim.sensor import build_d405_vga
from finforce_sim.simulated_camera import BANDS, SimulatedCamera
from finforce_sim.simulated_recording import SimulatedRecording, parse_size

CAMERA = build_d405_vga()


@pytest.fixture(scope="module")
def gripper():
    return TwinGripper(build_scenario("grasp_cylinder"), 3, density="coarse")


@pytest.fixture(scope="module")
def states(gripper):
    return list(islice(gripper.states(), 80))


@pytest.fixture(scope="module")
def pressed(states):
    return next(state for state in states if np.linalg.norm(state.jaws["left"].force) > 1.0)


@pytest.fixture(scope="module")
def shot(gripper, pressed):
    return SimulatedCamera(gripper, CAMERA, 3).shoot(pressed)


def test_true_pixels_are_the_projected_key_points(shot):
    for truth in shot.jaws.values():
        points = truth.points @ truth.T_camera_jaw[:3, :3].T + truth.T_camera_jaw[:3, 3]
        np.testing.assert_allclose(truth.pixels, project(points, CAMERA), atol=1e-9)


def test_depth_at_visible_key_points_is_that_of_the_finger(shot):
    for truth in shot.jaws.values():
        points = truth.points @ truth.T_camera_jaw[:3, :3].T + truth.T_camera_jaw[:3, 3]
        at = np.round(truth.pixels).astype(int)
        error = shot.depth[at[:, 1], at[:, 0]] - points[:, 2]
        assert np.nanmedian(np.abs(error[truth.visible])) < 1e-3  # noise and millimetre steps


def test_what_the_object_covers_is_not_visible(shot, gripper, pressed):
    simulated_camera = SimulatedCamera(gripper, CAMERA, 3)
    simulated_camera.mesh = None
    bare = simulated_camera.shoot(pressed)
    for side, truth in bare.jaws.items():
        assert truth.visible.all()
        assert not shot.jaws[side].visible.all()
        assert shot.jaws[side].visible.sum() >= 10


def test_the_same_seed_gives_the_same_image_and_another_one_another(shot, gripper, pressed):
    again = SimulatedCamera(gripper, CAMERA, 3).shoot(pressed)
    np.testing.assert_array_equal(again.color, shot.color)
    np.testing.assert_array_equal(again.depth, shot.depth)
    assert (SimulatedCamera(gripper, CAMERA, 4).shoot(pressed).color != shot.color).mean() > 0.5


def test_the_dot_on_the_holder_is_where_the_reference_point_is(shot, gripper):
    for side, truth in shot.jaws.items():
        point = gripper.jaws[side].reference_point[None]
        reference = point @ truth.T_camera_jaw[:3, :3].T + truth.T_camera_jaw[:3, 3]
        column, row = np.round(project(reference, CAMERA)[0]).astype(int)
        dot = shot.color[row - 1 : row + 2, column - 1 : column + 2].mean()
        around = shot.color[row - 14 : row + 15, column - 14 : column + 15].astype(float)
        assert abs(dot - np.median(around)) > 20.0  # grey levels


def test_depth_comes_in_the_steps_that_were_asked_for(gripper, pressed):
    for step in (1e-3, 1e-4):
        depth = SimulatedCamera(gripper, CAMERA, 3, step).shoot(pressed).depth
        depth = depth[np.isfinite(depth)].astype(float)
        np.testing.assert_allclose(depth / step, np.round(depth / step), atol=1e-3)  # float32 metres
        assert len(np.unique(np.round(depth / step))) > (50 if step == 1e-3 else 500)


def test_rows_of_a_rolling_shutter_are_of_their_own_time(gripper, states):
    before, state = next((a, b) for a, b in pairwise(states) if a.jaws["left"].origin_x < b.jaws["left"].origin_x)
    readout, height, rolling = 0.02, CAMERA.height, copy(gripper)
    rolling.scenario = replace(gripper.scenario, readout=readout)
    rolled, flat = SimulatedCamera(rolling, CAMERA, 3).look(state, before), SimulatedCamera(gripper, CAMERA, 3)
    band = height // BANDS
    for number in (0, BANDS - 1):
        rows = slice(number * band, (number + 1) * band)
        ago = readout * (1.0 - (rows.start + 0.5 * (band - 1)) / (height - 1))
        then = flat.look(state.blend(before, ago / (state.stamp - before.stamp)))
        inner = slice(rows.start + 1, rows.stop - 1)  # a band's edge has no neighbours that show an edge in its pixels
        np.testing.assert_allclose(rolled.color[inner], then.color[inner], atol=1e-6)
    # a point is where the jaw was when the point's own row was exposed
    now, past = (flat.look(some).jaws["left"].pixels for some in (state, before))
    seen = rolled.jaws["left"].pixels
    ago = readout * (1.0 - seen[:, 1] / (height - 1)) / (state.stamp - before.stamp)
    np.testing.assert_allclose(seen[:, 0], now[:, 0] + ago * (past - now)[:, 0], atol=0.02)
    assert np.ptp((seen - now)[:, 0]) > 0.5


def test_a_gripper_that_stands_is_looked_at_once_and_has_the_images_that_it_had(gripper, states):
    simulated_camera, looks = SimulatedCamera(gripper, parse_size("64x48"), 3), []
    watched = copy(simulated_camera)
    watched.look = lambda *states: looks.append(states) or simulated_camera.look(*states)
    closing, states = copy(gripper), [*states[48:56], *states[70:]]  # it stands, closes, and stands again
    closing.states = lambda: iter(states)
    for state, before, frame in zip(states, [None, *states], SimulatedRecording(closing, watched, 3), strict=False):
        alone = simulated_camera.shoot(state, before)
        np.testing.assert_array_equal(frame.color, alone.color)
        np.testing.assert_array_equal(frame.depth, alone.depth)
        for side, true in alone.jaws.items():
            np.testing.assert_array_equal(frame.jaws[side].pixels, true.pixels)
            np.testing.assert_array_equal(frame.jaws[side].force, true.force)
    moves = sum(not state.looks_like(before) for before, state in pairwise(states))
    assert moves > 2 and len(looks) < 0.8 * len(states)
