"""Claims about the jaw of stored equilibria: it answers as the full mechanics does, wherever and whatever presses."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_fakes import magnitudes, make_estimator, ramp, record, run
from mechanics_fakes import BENCH, bench_mechanics, press, rounded_box, settle

from finforce_ifea.contact_mechanics.friction import constant_traction
from finforce_ifea.contact_mechanics.indenter import DEPTH, HEIGHT, SHAPE, OutlineIndenter, RoundIndenter
from finforce_ifea.contact_mechanics.pressed_jaw import RigidContact, limit_step
from finforce_ifea.errors import ContactError, JawFileError, MeshError
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.mechanics import build_chosen, build_mechanics
from finforce_ifea.observation import Contact
from finforce_ifea.paper_inverse import Problem, solve_inverse
from finforce_ifea.reduced.equilibria import approach_grid
from finforce_ifea.settings import EstimatorSettings

DEPTHS = np.array([0.5, 2.0, 5.0, 10.0]) * 1e-3
# Steps of depth [m], log radius and height [m] for central differences.
STEPS = {DEPTH: 1e-6, SHAPE: 1e-4, HEIGHT: 1e-6}
MODELS = ["solid", "frame"]


def reduced(mesh="coarse"):
    return bench_mechanics(mesh, "reduced")


def keypoints(mechanics, q):
    return mechanics.model.positions(mechanics.model.attach(BENCH.keypoints, 1e-3), q)


def compare(indenter, shape, height, depths=DEPTHS, mechanics=None):
    """Relative errors of force and errors of key points [m] at the depths, beside the full mechanics."""
    full, other = bench_mechanics(), mechanics or reduced()
    true, found = (press(each.contact, indenter(), shape, height, depths) for each in (full, other))
    forces, others = (np.array([state.force for _, state in results]) for results in (true, found))
    shapes = [
        np.abs(keypoints(full, a) - keypoints(other, b)).max() for (a, _), (b, _) in zip(true, found, strict=True)
    ]
    return np.linalg.norm(others, axis=1) / np.linalg.norm(forces, axis=1) - 1.0, np.array(shapes)


@pytest.mark.parametrize(
    ("radius", "height"),
    [
        *((0.0125, height) for height in (0.0205, 0.0333, 0.0418, 0.0571, 0.0689)),
        *((radius, height) for radius in (0.004, 0.0175) for height in (0.0205, 0.0689)),
    ],
)
def test_forces_and_shapes_are_those_of_the_full_mechanics_between_the_stored_heights(radius, height):
    force, shape = compare(RoundIndenter, radius, height)
    assert np.abs(force).max() < 0.003
    assert shape.max() < 0.03e-3


@pytest.mark.parametrize("tilt", [0.0, 0.1, -0.3])
def test_boxes_are_pressed_in_as_by_the_full_mechanics(tilt):
    force, shape = compare(lambda: OutlineIndenter((rounded_box(0.02),)), tilt, 0.045)
    assert np.abs(force).max() < 0.003
    assert shape.max() < 0.06e-3


def test_modes_are_the_derivatives_of_the_equilibrium_by_depth_radius_and_height():
    contact = reduced().contact
    place = np.array([0.004, 0.0125, 0.031])
    [(q, state)] = press(contact, RoundIndenter(), place[SHAPE], place[HEIGHT], [place[DEPTH]])
    for which, size in STEPS.items():
        step = size * np.eye(3)[which]
        (_, above), (_, below) = (settle(contact, q, place + sign * step) for sign in (1, -1))
        change = (above.force - below.force) / (2 * size)
        # what the interpolated compliance changes on the way is left out
        np.testing.assert_allclose(state.force_modes[:, which], change, atol=0.03 * np.linalg.norm(change))


def test_equilibrium_is_found_again_from_another_place():
    contact = reduced().contact
    place = np.array([0.006, 0.0125, 0.050])
    [(q, state)] = press(contact, RoundIndenter(), place[SHAPE], place[HEIGHT], [place[DEPTH]])
    [(other, _)] = press(contact, RoundIndenter(), place[SHAPE], place[HEIGHT] - 2e-3, [place[DEPTH] - 1e-3])
    there, found = settle(contact, other, place)
    np.testing.assert_allclose(found.force, state.force, atol=1e-5)
    np.testing.assert_allclose(keypoints(reduced(), there), keypoints(reduced(), q), atol=1e-7)


def test_jaw_that_has_lost_contact_comes_back_to_touch():
    contact = reduced().contact
    [(q, _)] = press(contact, RoundIndenter(), 0.0125, 0.030, [0.004])
    place = np.array([0.001, 0.0125, 0.030])
    state = contact.linearize(q, place)
    assert not state.touches
    back = q + contact.approach(q, state.correction, place)
    assert contact.linearize(back, place).touches


def test_key_points_come_with_the_linearisation_as_after_it():
    mechanics, place = reduced(), np.array([0.0041, 0.0125, 0.0302])
    contact, probe = mechanics.contact, mechanics.model.attach(BENCH.keypoints, 1e-3)
    [(q, _)] = press(contact, RoundIndenter(), 0.0125, 0.030, [0.004])
    found = contact.linearize_points(probe, q, place, constant_traction(0.2))
    expected = RigidContact.linearize_points(contact, probe, q, place, constant_traction(0.2))
    np.testing.assert_array_equal(found[0].force, expected[0].force)
    for one, other in zip(found[1:], expected[1:], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
    assert np.abs(found[1] - mechanics.model.positions(probe, q)).max() > 0.03e-3  # after the correction, not before it


def test_forces_are_in_proportion_to_the_modulus():
    modulus = 7.0 * BENCH.material.young_modulus
    stiff = replace(BENCH, material=BENCH.material.model_copy(update={"young_modulus": modulus}))
    settings = EstimatorSettings(solver="reduced", mesh="coarse")
    place = (0.0125, 0.040, [0.005])
    [(_, soft)] = press(reduced().contact, RoundIndenter(), *place)
    [(_, hard)] = press(build_mechanics(stiff, settings).contact, RoundIndenter(), *place)
    np.testing.assert_allclose(hard.force, 7.0 * soft.force, rtol=1e-4)


def test_deformed_surface_is_that_of_the_full_mechanics():
    full, other = bench_mechanics(), reduced()
    [(a, _)] = press(full.contact, RoundIndenter(), 0.0125, 0.040, [0.008])
    [(b, _)] = press(other.contact, RoundIndenter(), 0.0125, 0.040, [0.008])
    np.testing.assert_allclose(other.model.vertices(b), full.model.vertices(a), atol=0.05e-3)


def test_shapes_that_are_far_from_the_stored_ones_are_known_as_such():
    contact = reduced().contact
    near = press(contact, RoundIndenter(), 0.0125, 0.045, [0.008])[0][1].extrapolation
    wide = press(contact, OutlineIndenter((rounded_box(0.04),)), 0.0, 0.045, [0.008])[0][1].extrapolation
    assert near < 0.05
    assert wide > 0.9


@pytest.mark.parametrize("solver", MODELS)
def test_force_of_key_points_is_that_of_the_full_solver(solver):
    """The finger may recommend either model; the estimate of a press with noise is the same within 1 % of the force."""
    jaw, recording = replace(BENCH, model=solver), record(ramp(3, 8, 2, 0))
    full, other = (
        magnitudes(run(recording, make_estimator(jaw, solver=name, mesh="coarse"))) for name in (solver, "reduced")
    )
    assert np.isfinite(other[60:]).all()
    np.testing.assert_allclose(other[60:], full[60:], atol=0.01 * np.nanmax(full))


def test_given_contact_gives_the_force_of_the_full_solver():
    recording = record(ramp(3, 6), noise=0.2, offsets=0.0)
    place = Contact(points=np.array([[BENCH.inner_face_x, 0.0, 0.040]]), weights=np.ones(1))
    full, other = (
        magnitudes(run(recording, contact=place, solver=name, mesh="coarse")) for name in ("solid", "reduced")
    )
    loaded = np.abs(full) > 0.3
    assert loaded.sum() > 60
    np.testing.assert_allclose(other[loaded], full[loaded], rtol=0.02)


@pytest.mark.parametrize("height", [0.0015, 0.0026])
def test_force_on_the_lowest_element_counts_what_the_clamp_holds(height):
    force, _ = compare(RoundIndenter, 0.004, height, [0.02e-3, 0.05e-3])
    assert np.abs(force).max() < 0.003


def test_wide_box_that_changes_its_edge_is_followed():
    """Without a limit to the energy, Newton's method swings between contacts at 7 mm for ever."""
    force, _ = compare(
        lambda: OutlineIndenter((rounded_box(0.03306),)), 0.01538, 0.03059, np.array([6.0, 7.0, 8.0]) * 1e-3
    )
    assert np.abs(force).max() < 0.01


def test_steel_finger_is_right_near_its_tip_where_it_stiffens_at_once():
    jaw = load_jaw("steel")
    full, other = (build_mechanics(jaw, EstimatorSettings(solver=name)) for name in ("frame", "reduced"))
    depths = [0.3e-3, 1.5e-3]
    forces = [
        [np.linalg.norm(state.force) for _, state in press(each.contact, RoundIndenter(), 0.0225, 0.1201, depths)]
        for each in (full, other)
    ]
    np.testing.assert_allclose(forces[1], forces[0], rtol=0.01)


@pytest.mark.parametrize("height", [0.025, 0.045, 0.065])
def test_given_contact_is_found_from_rest_in_one_frame(height):
    """The height on the grid follows the load at once; the full solver needs 8 iterations for 6 mm."""
    model, face = reduced().model, BENCH.inner_face_x
    [(bent, _)] = press(reduced().contact, RoundIndenter(), 0.0125, height, [0.006])
    points = np.array([[face, 0.0, height]])
    problem = Problem(
        effectors=model.attach(BENCH.keypoints, 3e-3),
        targets=keypoints(reduced(), bent),
        contacts=model.attach(points),
        neighbours=model.attach(np.repeat(points, 2, axis=0) + [[0.0, 0.0, -1e-3], [0.0, 0.0, 1e-3]]),
        weights=np.ones(1),
    )
    assert solve_inverse(model, problem, np.zeros(model.size), iterations=12, tolerance=5e-3).converged


def test_forces_in_three_axes_are_refused():
    with pytest.raises(JawFileError, match="expected force_axes normal"):
        build_mechanics(BENCH, EstimatorSettings(solver="reduced", mesh="coarse", force_axes="three"))


def test_steps_are_limited_by_the_reach_of_loads_and_grid_coordinates():
    model = reduced().model
    step = np.random.default_rng(0).normal(size=model.size)
    limited = limit_step(model, 100.0 * step)
    assert np.isclose((np.abs(limited) / model.reach).max(), 1.0)
    np.testing.assert_array_equal(limit_step(model, 1e-6 * step), 1e-6 * step)


def test_jaw_of_which_nothing_can_be_stored_is_described_in_full_unless_reduced_is_asked_for(monkeypatch, caplog):
    def refuse(*_):
        raise ContactError("the jaw cannot be pressed")

    monkeypatch.setattr("finforce_ifea.reduced.cache._share_manifold", refuse)
    chosen = build_chosen(BENCH, EstimatorSettings(mesh="coarse"))
    assert isinstance(chosen.model, SolidModel)
    assert "the jaw cannot be pressed" in caplog.text
    with pytest.raises(ContactError):
        build_chosen(BENCH, EstimatorSettings(mesh="coarse", solver="reduced"))


def test_points_of_the_inner_face_move_with_its_rows_as_the_full_mechanics_has_them():
    full, other = bench_mechanics(), reduced()
    points = np.array([[BENCH.inner_face_x, 0.0, height] for height in (0.021, 0.0405, 0.066)])
    [(a, _)] = press(full.contact, RoundIndenter(), 0.0125, 0.040, [0.006])
    [(b, state)] = press(other.contact, RoundIndenter(), 0.0125, 0.040, [0.006])
    probe = other.model.attach(points)
    found = other.model.positions(probe, b)
    # the middle of the face bends a little more than the mean across it
    np.testing.assert_allclose(found, full.model.positions(full.model.attach(points, 1e-3), a), atol=0.08e-3)
    small = 1e-6 * state.modes
    moved = np.stack([other.model.positions(probe, b + mode) - found for mode in small.T], axis=2)
    np.testing.assert_allclose(other.model.project(probe, b, small), moved, atol=1e-12)


@pytest.mark.parametrize(("direction", "left"), [(1.0, 0.5), (-1.0, 0.0)])
def test_a_step_that_leads_away_from_the_stored_equilibria_is_left_out_and_told(direction, left):
    count, grid = 8, (5, 5)
    stiff = np.eye(count, dtype=np.float32) * np.arange(1.0, 6.0, dtype=np.float32)[:, None, None, None]
    tables = np.zeros((*grid, count)), np.broadcast_to(stiff, (*grid, count, count)).copy(), np.zeros((*grid, count))
    m, step = np.array([2.0, 2.0]), np.array([0.5 * direction, 0.0, 3e-6 * np.sqrt(2.0)])
    assert approach_grid(tables, np.full(count, 1e-6), m, step) == left
    assert step[0] == (0.0 if left else -0.5)


def test_points_are_on_the_jaw_within_the_distance_that_is_allowed():
    model = reduced().model
    far = model.attach(BENCH.keypoints + [0.0, 2e-3, 0.0], 20e-3)
    with pytest.raises(MeshError):
        model.attach(far.points, 1e-6)
