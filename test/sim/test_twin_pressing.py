"""Claims about a grasp as a function of the opening; a coarse mesh, solved once for all of them."""

import numpy as np
import pytest

from finforce.gripper_frames import BENCH_ORIGIN_X, SIDES
from finforce_ifea.grasp_force import R_GRIPPER_JAW, Wrench, combine_wrenches
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.relaxation import apply_relaxation
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.gripper import JAMMED, PressedGrasp, TwinGripper
from finforce_sim.scenarios import BalanceError, Posture, build_scenario

SEED = 3
FACE = load_jaw("bench").inner_face_x
HELD = 0.013  # [m], at which a rod of 25 mm is held with some 2 N


class Relaxed:
    """The wrenches of a grasp as the jaws' material gives way."""

    def __init__(self, grasp):
        self.grasp, self.relaxation, self.wrenches = grasp, grasp.relaxation(), {}

    def update(self, opening, dt):
        elastic = self.grasp.wrenches(opening)
        self.wrenches = {side: self.relaxation[side].update(wrench, dt) for side, wrench in elastic.items()}
        return self.wrenches

    @property
    def force(self):
        return float(min(np.linalg.norm(wrench.force) for wrench in self.wrenches.values()))


@pytest.fixture(scope="module")
def grasp():
    return PressedGrasp(build_scenario("grasp_cylinder"), SEED, "coarse")


def test_an_object_as_wide_as_the_opening_is_just_touched(grasp):
    assert grasp.touch_opening == pytest.approx(0.025, abs=5e-5)  # the rod is a polygon
    for opening in (0.048, 0.03, grasp.touch_opening):
        assert grasp.elastic_force(opening) == 0.0
        assert not grasp.state(opening).jaws["left"].force.any()
    # 0.4 N/mm of each jaw: 5 um beyond touch are felt
    assert 0.5e-3 < grasp.elastic_force(grasp.touch_opening - 1e-5) < 5e-3


def test_closing_further_presses_harder_down_to_closed_jaws(grasp):
    openings = np.linspace(grasp.touch_opening, 0.0, 300)
    forces = np.array([grasp.elastic_force(opening) for opening in openings])
    assert (np.diff(forces) > 0.0).all()
    assert grasp.least_opening == pytest.approx(0.0, abs=1e-12)
    assert 3.0 < forces[-1] < 8.0
    stiffness = -np.diff(forces) / np.diff(openings)
    assert 100.0 < stiffness.min() < stiffness.max() < 600.0  # [N/m] of opening


def test_jaws_stand_half_the_opening_from_the_middle(grasp):
    for opening in (0.048, 0.02, 0.0):
        jaws = grasp.state(opening).jaws
        assert jaws["right"].origin_x == pytest.approx(0.5 * opening + FACE, abs=1e-12)
        assert jaws["left"].origin_x == -jaws["right"].origin_x


def test_what_is_read_off_is_what_the_script_plays(grasp):
    scenario = build_scenario("grasp_cylinder", settle=0.1, record=0.2)
    gripper = TwinGripper(scenario, SEED, "coarse")
    held = [state for state in gripper.states() if state.phase == "0:load:6:record"][-1]
    opening = grasp.touch_opening - 2.0 * scenario.displacement
    read = grasp.state(opening)
    for side, jaw in held.jaws.items():
        # a hundredth of what a camera sees: both stop where Newton's steps are below 1 um
        np.testing.assert_allclose(read.jaws[side].vertices, jaw.vertices, atol=2e-6)
        np.testing.assert_allclose(read.jaws[side].keypoints, jaw.keypoints, atol=2e-6)
        assert read.jaws[side].origin_x == pytest.approx(jaw.origin_x, abs=1e-9)
        # the script's force relaxes from above
        assert 1.0 < np.linalg.norm(jaw.force) / np.linalg.norm(read.jaws[side].force) < 1.3
    np.testing.assert_allclose(read.T_gripper_object, held.T_gripper_object, atol=5e-6)


def test_between_two_solved_grasps_the_interpolated_one_is_the_solved_one(grasp):
    closing = 0.5 * (grasp._closings[60] + grasp._closings[61])
    held = grasp.hold_object()
    for before in grasp._closings[:61]:
        held.follow(grasp.setting_of(Posture(closing=float(before))))
    shapes = held.follow(grasp.setting_of(Posture(closing=float(closing))))
    opening = grasp.touch_opening - 2.0 * closing
    read = grasp.state(opening)
    for side, shape in shapes.items():
        np.testing.assert_allclose(read.jaws[side].force, shape.force, atol=2e-3)
        np.testing.assert_allclose(read.jaws[side].torque, shape.torque, atol=2e-4)
        np.testing.assert_allclose(read.jaws[side].vertices, shape.vertices, atol=2e-6)
    smaller = min(np.linalg.norm(shape.force) for shape in shapes.values())
    assert grasp.elastic_force(opening) == pytest.approx(smaller, abs=2e-3)


def test_forces_of_both_jaws_cancel_and_pass_through_the_object(grasp):
    jaws = grasp.state(HELD).jaws
    net = combine_wrenches(*(Wrench(jaws[side].force, jaws[side].torque) for side in SIDES), None).manipulation
    np.testing.assert_allclose(net, 0.0, atol=5e-3)
    for jaw in jaws.values():
        assert jaw.force[0] < -1.0
        assert jaw.torque[1] / jaw.force[0] == pytest.approx(0.042, abs=1e-3)


def test_an_object_off_the_middle_is_pushed_by_the_jaw_that_meets_it_first():
    grasp = PressedGrasp(build_scenario("grasp_cylinder", offset=0.004), SEED, "coarse", step=5e-4)
    places = [grasp.pose_at(opening)[0, 3] for opening in (0.048, 0.035, 0.029, 0.02)]
    assert places[0] == places[1] == pytest.approx(0.004)
    assert places[2] == pytest.approx(0.5 * (0.029 - grasp.touch_opening), abs=1e-4)
    assert abs(places[3]) < 2e-4


def test_bench_jaw_stands_and_the_object_comes_by_half_the_closing():
    grasp = PressedGrasp(build_scenario("bench_cylinder"), SEED, "coarse", step=5e-4)
    wide, narrow = grasp.state(0.04), grasp.state(0.02)
    assert wide.jaws["left"].origin_x == narrow.jaws["left"].origin_x == BENCH_ORIGIN_X
    way = narrow.T_gripper_object[0, 3] - wide.T_gripper_object[0, 3]
    assert way == pytest.approx(-0.010, abs=1e-9)
    assert 0.5 < grasp.elastic_force(0.02) < 1.5


def test_jaws_without_an_object_feel_nothing_anywhere():
    grasp = PressedGrasp(build_scenario("empty_close"), SEED, "coarse")
    for opening in (0.048, 0.0, -0.001):
        state = grasp.state(opening)
        assert grasp.elastic_force(opening) == 0.0 and state.T_gripper_object is None
        assert not state.jaws["right"].force.any()
        assert state.jaws["right"].origin_x == pytest.approx(0.5 * opening + FACE)
    assert Relaxed(grasp).update(0.0, 0.1)["left"].force.tolist() == [0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def jamming():
    """An upright cylinder, which meets the clamped bases."""
    return PressedGrasp(build_scenario("grasp_cylinder", object="cylinder", scale=0.7), SEED, "coarse", step=2.5e-4)


def test_jaws_that_cannot_bend_further_jam(jamming):
    least = jamming.least_opening
    assert 0.0 < least < jamming.touch_opening
    deeper = jamming.elastic_force(least - 1e-4) - jamming.elastic_force(least)
    assert deeper == pytest.approx(1e-4 * JAMMED, rel=1e-6)
    np.testing.assert_array_equal(
        jamming.state(least).jaws["left"].vertices, jamming.state(least - 1e-3).jaws["left"].vertices
    )
    force = jamming.state(least - 1e-4).jaws["left"].force
    assert np.linalg.norm(force) == pytest.approx(jamming.elastic_force(least - 1e-4), rel=0.02)  # two materials
    levers = [jaw.torque[1] / jaw.force[0] for jaw in (jamming.state(w).jaws["left"] for w in (least, least - 1e-4))]
    assert levers[0] == pytest.approx(levers[1], rel=1e-9)


def test_the_grasp_force_is_that_of_the_jaw_pressed_less():
    # a hand keeps the tilt of this block: the jaws' forces along z differ
    grasp = PressedGrasp(build_scenario("rocking"), SEED, "coarse", step=1e-3)
    opening = float(grasp.touch_opening - 2.0 * grasp._closings[8])
    sizes = sorted(np.linalg.norm(wrench.force) for wrench in grasp.wrenches(opening).values())
    assert sizes[1] - sizes[0] > 1e-4
    assert grasp.elastic_force(opening) == pytest.approx(sizes[0], abs=1e-9)
    relaxed = Relaxed(grasp)
    sizes = sorted(np.linalg.norm(wrench.force) for wrench in relaxed.update(opening, 0.1).values())
    assert relaxed.force == sizes[0]


def test_a_grasp_that_never_finds_an_equilibrium_is_refused(monkeypatch):
    def refuse(*_):
        raise BalanceError("no equilibrium")

    monkeypatch.setattr("finforce_sim.mechanics.HeldObject.follow", refuse)
    with pytest.raises(BalanceError, match="equilibrium"):
        PressedGrasp(build_scenario("grasp_cylinder"), SEED, "coarse")


def test_a_gripper_stalls_where_the_jaws_press_as_hard_as_its_current(jamming):
    gripper = EmulatedGripper(load=jamming.elastic_force)
    for _ in range(1500):
        gripper.jaws.drive(-20_000.0, 300.0)
    # 47.7 N/A; the balance is found by halving a way of some 0.1 mm thirty times
    assert jamming.elastic_force(gripper.jaws.opening) == pytest.approx(0.3 * 47.7, abs=1e-3)


def test_a_held_force_relaxes_by_the_material_s_terms(grasp):
    relaxed, dt = Relaxed(grasp), 1.0 / 30.0
    stamps = dt * np.arange(300)
    openings = np.interp(stamps, [0.0, 1.0, 3.0], [0.03, 0.03, HELD])
    elastic = np.array([grasp.elastic_force(opening) for opening in openings])
    measured = []
    for opening in openings:
        relaxed.update(opening, dt)
        measured.append(relaxed.force)
    wanted = apply_relaxation(elastic, stamps, grasp.material.terms)
    # the direction of the force turns a little with the shape, which the scalar filter does not know
    np.testing.assert_allclose(measured, wanted, rtol=2e-3)
    held = measured[int(3.0 * 30) :]
    assert (np.diff(held) < 0.0).all() and 1.02 < held[0] / elastic[-1] < 1.25
    assert measured[-1] > elastic[-1]


def test_relaxation_does_not_depend_on_the_steps_of_a_straight_way(grasp):
    forces = []
    for count in (30, 1000):
        relaxed = Relaxed(grasp)
        relaxed.update(grasp.touch_opening, 1.0)
        for opening in np.linspace(grasp.touch_opening, HELD, count + 1)[1:]:
            relaxed.update(float(opening), 1.0 / count)
        forces.append(relaxed.force)
    # the force is no straight line over the opening: within 30 steps it bends by less than this
    assert forces[0] == pytest.approx(forces[1], abs=1e-3)


def test_nothing_is_left_of_the_force_when_the_jaws_let_go(grasp):
    relaxed = Relaxed(grasp)
    relaxed.update(HELD, 0.5)
    assert relaxed.force > 1.0
    wrenches = relaxed.update(0.03, 0.1)
    assert relaxed.force == 0.0 and not wrenches["right"].torque.any()


def test_key_points_move_with_the_band_that_is_pressed(grasp):
    rest, held = (grasp.state(opening).jaws["right"] for opening in (0.04, HELD))
    motion = held.keypoints - rest.keypoints
    pressed = np.argmin(np.abs(rest.keypoints[:7, 2] - 0.042))
    # 6 mm beyond touch, nearly all of it the inner band's
    assert -6.5e-3 < motion[pressed, 0] < -4e-3
    face = (held.vertices @ R_GRIPPER_JAW["right"].T)[:, 0].min() + held.origin_x
    assert face > 0.5 * HELD - 1e-3  # no vertex crosses the undeformed face
