"""Claims about the contacts, observations, settings and jaws that `ForceEstimator` takes and refuses."""

from dataclasses import fields, replace

import numpy as np
import pytest
from estimator_fakes import (
    CALIBRATION,
    MODELS,
    PERIOD,
    REST,
    SMOOTH,
    assert_identical,
    errors,
    loaded_frames,
    make_estimator,
    pressed,
    rms,
    run,
    solved,
    statuses,
)
from mechanics_fakes import BENCH

from finforce.errors import ObservationError
from finforce_ifea.errors import CalibrationError, ContactError, JawFileError
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, load_jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.observation import Contact, Observation, check_observation
from finforce_ifea.posture import WristPosture
from finforce_ifea.settings import EstimatorSettings
from lab.presses import RigidCylinder, press_jaw

# --- contacts


@pytest.mark.parametrize(("solver", "height", "bound"), [("frame", 40, 0.08), ("frame", 60, 0.10), ("solid", 60, 0.10)])
def test_force_at_a_given_contact_that_may_not_move(height, bound, solver):
    """As a contact estimator gives it; below, the contact moves by itself, and a point that stays is 15 % off."""
    recording = pressed(height)
    contact = Contact(points=np.array([[BENCH.inner_face_x, 0.0, 1e-3 * height]]), weights=np.ones(1))
    found = errors(recording, run(recording, contact=contact, solver=solver))
    assert np.isfinite(found[loaded_frames(recording)]).all()
    assert rms(found[loaded_frames(recording)]) < bound


@pytest.mark.parametrize("solver", MODELS)
def test_given_contact_near_the_base_is_no_divergence(solver):
    contact = Contact(points=np.array([[BENCH.inner_face_x, 0.0, 0.020]]), weights=np.ones(1))
    solutions = run(pressed(20), contact=contact, solver=solver)
    found = errors(pressed(20), solutions)
    assert statuses(solutions) <= {"waiting", "ok", "unloaded"}
    assert np.nanmax(np.abs(found)) < 0.2 * 3.8


def test_weighted_contacts_share_one_force():
    contact = Contact(
        points=np.array([[BENCH.inner_face_x, 0.0, z] for z in (0.036, 0.044)]), weights=np.array([1.0, 1.0])
    )
    recording = pressed()
    solutions = run(recording, contact=contact, solver="frame")
    assert rms(errors(recording, solutions)[loaded_frames(recording)]) < 0.08
    assert solutions[160].contact_location[2] == pytest.approx(0.040, abs=5e-4)


def test_force_in_three_axes_says_what_it_does_not_know():
    """Key points tell a force along the finger badly: such a component is uncertain, or not reported."""
    contact = Contact(points=np.array([[BENCH.inner_face_x, 0.0, 0.040]]), weights=np.ones(1))
    recording = pressed().first(190)
    for i, solution in list(enumerate(run(recording, contact=contact, solver="solid", force_axes="three")))[60::8]:
        error = np.abs(solution.force - recording.forces[i])
        assert not solution.trusted or (error < 5.0 * solution.force_stddev + 0.1).all(), (
            i,
            error,
            solution.force_stddev,
        )


def test_planar_model_has_no_three_axes():
    """A planar frame cannot tell a force along the width: that is no matter of key points."""
    contact = Contact(points=np.array([[BENCH.inner_face_x, 0.0, 0.040]]), weights=np.ones(1))
    try:
        solutions = run(pressed(), contact=contact, solver="frame", force_axes="three")
    except (JawFileError, ObservationError):
        return
    assert not any(solution.trusted for solution in solutions[REST:])
    assert statuses(solutions[REST:]) == {"unobservable"}


@pytest.mark.parametrize("height", [0.060, 0.070])
def test_contact_far_from_the_truth_is_unobservable(height):
    solutions = run(pressed(20).first(150), contact=Contact.fixed(BENCH, height), solver="frame")
    assert statuses(solutions[100:150]) == {"unobservable"}
    assert "contact" in solutions[120].message
    assert not any(solution.force.any() for solution in solutions[100:150])


@pytest.mark.parametrize(
    ("points", "weights", "words"),
    [
        (np.zeros((2, 2)), np.ones(2), "expected"),
        (np.array([[0.014, 0.0, 0.04]]), np.ones(2), "weights"),
        (np.array([[0.010, 0.0, 0.04]]), np.ones(1), "off the undeformed inner surface"),
        (np.array([[0.014, 0.0, np.nan]]), np.ones(1), "off the undeformed inner surface"),
        (np.array([[0.014, 0.0, 0.04]]), np.array([-1.0]), "non-negative"),
        (np.array([[0.014, 0.0, 0.04]]), np.zeros(1), "not all zero"),
        (np.array([[0.014, 0.0, 0.04]]), np.array([np.nan]), "non-negative"),
        (np.array([[0.014, 0.0, 0.12]]), np.ones(1), "surface"),
        (np.array([[0.014, 0.05, 0.04]]), np.ones(1), "surface"),
    ],
)
def test_contact_off_the_jaw_is_refused(points, weights, words):
    estimator = make_estimator(solver="frame")
    with pytest.raises(ContactError, match=words):
        estimator.update(pressed().observations[0], Contact(points=points, weights=weights, free=True))


@pytest.mark.parametrize("z", [-0.05, 0.0, 0.001, 0.005, 0.076, 0.08, 0.12, np.nan, np.inf])
def test_height_off_the_jaw_is_refused(z):
    with pytest.raises(ContactError, match="contact height"):
        Contact.fixed(BENCH, z)


@pytest.mark.parametrize("z", [0.001, 0.079])
def test_height_where_no_key_point_tells_a_force_gets_none(z):
    contact = Contact(points=np.array([[BENCH.inner_face_x, 0.0, z]]), weights=np.ones(1), free=True)
    solutions = run(pressed(40), contact=contact, solver="frame")
    assert statuses(solutions[REST:]) == {"unobservable"}
    assert "expected 5.5 to 75.5 mm" in solutions[-1].message


# --- malformed observations


def test_key_points_of_a_jaw_that_stands_still_may_stay_as_they_are():
    """A detector repeats the mean of a jaw in which nothing has moved, under the stamp of every image."""
    recording, estimator = pressed(40), make_estimator(solver="frame")
    for observation in recording.observations[:150]:
        last = estimator.update(observation, recording.contact)
    still = [
        estimator.update(replace(observation, stamp=observation.stamp + PERIOD * (i + 1)), recording.contact)
        for i, observation in enumerate([recording.observations[149]] * 30)
    ]
    assert statuses(still) == {last.status} == {"ok"}


def test_image_that_comes_twice_is_refused():
    estimator = make_estimator(solver="frame")
    estimator.update(spoil(stamp=1.0), None)
    with pytest.raises(ObservationError, match="came twice"):
        estimator.update(spoil(stamp=1.0 + 1e-9), None)
    estimator.update(spoil(stamp=1.001), None)


def spoil(points=None, likelihood=None, stamp=20.0):
    points = BENCH.keypoints if points is None else points
    return Observation(stamp=stamp, points=points, likelihood=np.ones(15) if likelihood is None else likelihood)


def one_infinite(value):
    points = BENCH.keypoints.copy()
    points[7, 1] = value
    return points


@pytest.mark.parametrize(
    ("observation", "words"),
    [
        (spoil(np.zeros((14, 3))), r"\(14, 3\).*\(15, 3\)"),
        (spoil(np.zeros((0, 3)), np.zeros(0)), r"\(0, 3\)"),
        (spoil(np.zeros((15, 2))), r"\(15, 2\)"),
        (spoil(likelihood=np.ones(14)), r"\(14,\)"),
        (spoil(one_infinite(np.inf)), "key point 7 is infinite"),
        (spoil(one_infinite(-np.inf)), "key point 7 is infinite"),
        (spoil(likelihood=np.r_[np.ones(14), 1.5]), "to 1.5, expected 0 to 1"),
        (spoil(likelihood=np.r_[np.ones(14), -0.1]), "from -0.1"),
        (spoil(likelihood=np.r_[np.ones(14), np.nan]), "expected 0 to 1"),
        (spoil(stamp=np.nan), "stamp nan"),
        (spoil(stamp=np.inf), "stamp inf"),
    ],
)
def test_malformed_observation_is_refused_with_its_numbers(observation, words):
    estimator = make_estimator(solver="frame")
    with pytest.raises(ObservationError, match=words):
        estimator.update(observation, None)


@pytest.mark.parametrize("stamp", [20.0, 19.9, -5.0])
def test_stamps_have_to_rise(stamp):
    estimator = make_estimator(solver="frame")
    estimator.update(spoil(stamp=20.0), None)
    with pytest.raises(ObservationError, match=r"after 20\.0.*rising"):
        estimator.update(spoil(stamp=stamp), None)
    # the refused observation has left no trace, and a new recording may begin
    estimator.update(spoil(stamp=20.1), None)
    estimator.reset()
    estimator.update(spoil(stamp=stamp), None)


@pytest.mark.parametrize(
    ("period", "reason"),
    [
        (1e3 / 30, "look like milliseconds"),
        (1e6 / 30 + 0.5, "look like microseconds"),
        (1e9 / 30 + 0.5, "look like nanoseconds"),
        (1.0, "divide them by the frame rate"),
        (0.8e-3, r"0\.001 to 5 s"),
    ],
)
def test_a_period_in_another_unit_than_seconds_is_refused_with_that_unit(period, reason):
    estimator = make_estimator(solver="frame")
    for number in range(2):  # a single gap is a pause
        estimator.update(spoil(stamp=period * number), None)
    with pytest.raises(ObservationError, match=reason):
        estimator.update(spoil(stamp=period * 2), None)


def test_a_camera_that_pauses_twice_goes_on():
    estimator = make_estimator(solver="frame")
    for stamp in (1.01, 11.02):
        estimator.update(spoil(stamp=stamp), None)
    with pytest.raises(ObservationError, match="look like milliseconds"):
        estimator.update(spoil(stamp=31.03), None)
    for stamp in (31.06, 31.09):
        estimator.update(spoil(stamp=stamp), None)


def test_refused_observations_leave_no_trace():
    recording, estimator = pressed(), make_estimator(solver="frame")
    solutions = []
    for observation in recording.observations:
        for bad in (replace(observation, points=observation.points[:3]), replace(observation, stamp=0.0)):
            if observation is not recording.observations[0] or bad.stamp:
                with pytest.raises(ObservationError):
                    estimator.update(bad, recording.contact)
        solutions.append(estimator.update(observation, recording.contact))
    assert_identical(solutions, solved())


# --- settings, jaws, calibrations


def test_ignored_key_points_are_not_used():
    names = ",".join(BENCH.keypoint_names[i] for i in (2, 5))
    solutions = run(pressed(), solver="frame", ignored_keypoints=names)
    assert not any(solution.keypoints_used[[2, 5]].any() for solution in solutions)
    assert rms(errors(pressed(), solutions)[loaded_frames(pressed())]) < 0.08


def test_too_few_key_points_are_said_to_be_too_few():
    recording = pressed().changed(range(100, 130), lambda _, likelihood: likelihood.put(range(2, 15), 0.1))
    solution = run(recording, solver="frame")[120]
    assert solution.status == "not_enough_points"
    assert "2 of 15" in solution.message


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"solver": "magic"}, "solver"),
        ({"likelihood_threshold": 1.5}, "likelihood_threshold"),
        ({"minimum_keypoints": 0}, "minimum_keypoints"),
        ({"energy_form": "sofas"}, "energy_form"),
        ({"gate": float("nan")}, "gate"),
    ],
)
def test_settings_out_of_bounds_are_refused_by_name(options, name):
    with pytest.raises(ObservationError, match=name):
        EstimatorSettings(**options)


def test_every_setting_says_its_unit_and_meaning():
    for item in fields(EstimatorSettings):
        assert item.metadata["description"]
        assert "unit" in item.metadata


def test_calibration_of_another_jaw_is_refused():
    with pytest.raises(CalibrationError, match="bench"):
        ForceEstimator(load_jaw("steel"), calibration=CALIBRATION.changed(jaw="bench"))


def test_steel_finger_is_no_solid():
    with pytest.raises(JawFileError, match="frame"):
        ForceEstimator(load_jaw("steel"), settings=EstimatorSettings(solver="solid"))


def test_steel_finger_works_with_the_same_estimator():
    """Key points that the model itself has at 12 mm of depth, with a little noise: 3.5 N to a tenth."""
    jaw = load_jaw("steel")
    maker, mechanics = (
        ForceEstimator(jaw, settings=EstimatorSettings(**SMOOTH)),
        build_mechanics(jaw, EstimatorSettings()),
    )
    results = press_jaw(
        mechanics.model,
        mechanics.contact.surface,
        jaw.inner_face_x,
        RigidCylinder(radius=0.02),
        0.065,
        [0.004, 0.008, 0.012],
    )
    probe = mechanics.model.attach(jaw.keypoints, KEYPOINT_DISTANCE)
    shapes = [np.array(jaw.keypoints)] + [mechanics.model.positions(probe, result.q) for result in results]
    forces = [0.0] + [np.linalg.norm(result.force) for result in results]
    random, contact, stamp = np.random.default_rng(0), Contact.fixed(jaw, 0.065), 0.0
    for shape, force in zip(shapes, forces, strict=True):
        for _ in range(60):
            stamp += PERIOD
            points = shape + 1e-4 * random.normal(size=shape.shape)
            solution = maker.update(Observation(stamp=stamp, points=points, likelihood=np.ones(len(points))), contact)
        assert solution.trusted
        assert np.linalg.norm(solution.force) == pytest.approx(force, abs=0.1 + 0.05 * force)
    assert force > 2.0


@pytest.mark.parametrize("gravity", [np.array([0.0, 0.0, 9.81]), np.array([0.0, 1.0]), np.full(3, np.nan)])
def test_a_direction_of_gravity_is_a_unit_vector(gravity):
    one = Observation(
        stamp=0.0, points=np.zeros((2, 3)), likelihood=np.ones(2), posture=WristPosture(np.array([0.0, 0.6, 0.8]))
    )
    check_observation(one, 2)
    with pytest.raises(ObservationError, match="an elevation of inf"):
        check_observation(replace(one, posture=one.posture._replace(elevation=np.inf)), 2)
    with pytest.raises(ObservationError, match="expected a unit vector"):
        check_observation(replace(one, posture=WristPosture(gravity)), 2)


def test_key_points_in_millimetres_are_refused_with_their_unit_and_a_gross_error_is_not():
    millimetres = Observation(stamp=1.0, points=1e3 * BENCH.keypoints)
    with pytest.raises(ObservationError, match=r"key points up to \d+.* expected metres .* divided by 1000"):
        check_observation(millimetres, len(BENCH.keypoints))
    gross = BENCH.keypoints.copy()
    gross[:3] = [0.0, 0.0, 2.5]
    check_observation(Observation(stamp=1.0, points=gross), len(BENCH.keypoints))


def test_points_without_likelihood_that_are_not_there_count_as_unseen():
    points = BENCH.keypoints.copy()
    points[2] = np.nan
    assert Observation(stamp=1.0, points=points).likelihood.tolist() == [1.0, 1.0, 0.0] + [1.0] * (len(points) - 3)


@pytest.mark.parametrize("stamp", [3, np.int64(3), 1.7e12, 1.7e18, np.nan])
def test_stamps_that_are_no_seconds_are_refused(stamp):
    with pytest.raises(ObservationError, match="expected seconds as a float: divide frame numbers"):
        check_observation(Observation(stamp=stamp, points=BENCH.keypoints), len(BENCH.keypoints))
