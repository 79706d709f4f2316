"""Compiled update of the contact filter by one image: prediction, iterations and read-out."""

from __future__ import annotations

import numpy as np

from finforce.compiled import njit
from finforce.kalman import MotionNoise, expect_position, find_mean, find_variance, predict
from finforce.kalman import correct as correct_track
from finforce_ifea.contact_mechanics.indenter import CELL, find_first_touch
from finforce_ifea.filter.filter import Posterior, reduce_covariance
from finforce_ifea.filter.friction_path import expect_coefficient, find_held, preview
from finforce_ifea.filter.jump import (
    ALIKE,
    BUMPED,
    LARGEST_MOVE,
    MISPLACED,
    NO_JUMP,
    Jump,
    JumpWatch,
    correct,
    forget,
    jump_back,
    watch,
)
from finforce_ifea.filter.measurement import Measurement, find_seen, observe, summarize_detector_errors
from finforce_ifea.filter.process import (
    APPARENT_DETECTOR,
    APPARENT_TRACTION,
    BUMPED_SHIFT,
    BUMPED_TIME,
    BUMPED_TURN,
    CAMERA_SHIFT,
    CAMERA_TIME,
    CAMERA_TURN_STDDEV,
    PLACE_STRETCH,
    PLACE_TIME,
    PLACE_TURN,
    TRACTION_FLOOR,
    TRACTION_SHARE,
    Expectation,
    advance,
)
from finforce_ifea.filter.readout import COMMON, find_held_ratio, judge_points, read_out, spread_common
from finforce_ifea.filter.state import DEPTH, HEIGHT, SHAPE
from finforce_ifea.tracking.contact_state import LEAST_DEPTH

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Prior of an object's shape and height, and limits of the search for its contact.
EXPECTATION = np.dtype(
    [
        ("mean", float, 2),  # of shape and height [m]
        ("variance", float, 2),  # of both
        ("lowest", float),  # shape
        ("highest", float),  # shape
        ("largest_change", float),  # of the shape at once
        ("settled_change", float),  # of the shape that no longer matters
        ("has_corners", bool),  # whether the object may rock
        ("shared", float),  # standard deviation of a shift that all key points of an image share [m]
        ("closing", float),  # that of a shift along the closing axis alone [m]
        ("mount", float),  # standard deviation of the height at which the jaw is mounted [m]
    ],
    align=True,
)
# Process noise of the depth: drift at rest [m/s^0.5], changes of the speed in motion [m/s^1.5], speed at which motion
# starts [m/s], mean times of rest and motion [s]: jaws close at millimetres per second, and stop. Jumps [m] are images
# that were missed, or another object.
DEPTH_NOISE = MotionNoise(
    drift=(0.01e-3) ** 2,
    acceleration=0.004**2,
    start=(5e-3) ** 2,
    rest_time=3.0,
    motion_time=1.0,
    jump=(5e-3) ** 2,
    jump_probability=1e-3,
)
# Time constant of the noise level [images].
_LEVEL_IMAGES = 8.0
# Largest noise variance that one image shows, relative to the tare's [-].
_LARGEST_CHANGE = 9.0
# Largest noise variance, relative to the tare's [-].
_LARGEST_LEVEL = 25.0
# Median of D^2 for three normal numbers, less what the contact explains [-].
_MEDIAN_SQUARE = 2.05
# Time constant of the scatter of the depths [images].
_SCATTER_IMAGES = 15.0
# Largest step of the height [m].
_LARGEST_SHIFT = 0.3e-3
# Tolerance of depth and height [m].
_SETTLED = 0.1e-3
# Tolerance of the unknowns of the mechanics, relative to the model's reach [-].
_SETTLED_CORRECTION = 0.05
# Fraction of a full step below which its remainder is ignored [-]: the key points cannot decide between two corners.
_UNDECIDED = 0.2
# Standard deviation of the traction ratio by the inclination of an edge that hardly touches [-].
_INCLINED = 0.5
# Depth up to which an edge is rounded [m]: half a cell of its field.
_EDGE = 0.5 * CELL
# Weight from which a key point agrees [-].
_AGREES = 0.25
# Fraction of key points that must agree [-].
_MAJORITY = 0.5
# Largest bump of a camera [sigma].
_LARGEST_BUMP = 5.0
# Variances (4,) of the camera's motion since the tare [m^2, m^2, rad^2, -].
_STILL = np.array([CAMERA_SHIFT, CAMERA_SHIFT, CAMERA_TURN_STDDEV, 0.0]) ** 2
# The same after a bump.
_BUMPED = np.array([BUMPED_SHIFT, BUMPED_SHIFT, BUMPED_TURN, 0.0]) ** 2
_LEAST_VARIANCE = 1e-14


@njit(**_OPTIONS)
def find_place(touching, x):
    """Return the state of the mechanics for a state x (3,), never above the surface, and the depth below [m].

    `touching` are object and surface, see `find_first_touch`.
    """
    x_model, touch = x.copy(), find_first_touch(*touching, x)
    x_model[DEPTH] = max(x[DEPTH], touch + LEAST_DEPTH)
    return x_model, x[DEPTH] - touch


@njit(**_OPTIONS)
def move_along(q, modes, x, before):
    """Return unknowns (size,) moved along modes (size, 4) by a change of the state of the mechanics (3,)."""
    out = q.copy()
    for i in range(3):
        out += modes[:, i] * (x[i] - before[i])
    return out


@njit(**_OPTIONS)
def find_expectation(expectation, told, detector_variance, friction):
    """Return the `Expectation`.

    Args:
        expectation: see `EXPECTATION`.
        told: whether the contact is misplaced, and the camera was bumped; see `TractionHypotheses` for `stddev` and
            `unweighed`.
        detector_variance: see `DetectorErrors`.
        friction: expected coefficient of friction.
    """
    expectation, (misplaced, bumped, path_stddev, unweighed) = expectation[()], told
    mean, variance, camera = expectation.mean.copy(), expectation.variance.copy(), np.empty(4)
    variance[1] += (MISPLACED.stddev[0] ** 2 if misplaced else 0.0) + expectation.mount**2
    traction = TRACTION_FLOOR**2 + (TRACTION_SHARE * friction) ** 2 + min(path_stddev, friction) ** 2 + unweighed**2
    shared, time = expectation.shared, BUMPED_TIME if bumped else CAMERA_TIME
    if max(shared, expectation.closing) > 0.0:
        time = PLACE_TIME
    for i, place in enumerate((shared, shared, PLACE_TURN, PLACE_STRETCH)):
        camera[i] = (_BUMPED[i] if bumped else _STILL[i]) + (place**2 if shared > 0.0 else 0.0)
    apparent = APPARENT_TRACTION**2 + APPARENT_DETECTOR**2 * detector_variance
    camera[0] += expectation.closing**2
    return Expectation(mean, variance, traction, apparent, camera, time)


@njit(**_OPTIONS)
def predict_image(image, expected, filtered, weights, friction, passed, watches, touching):
    """Predict state and contact of an image; the state in place.

    Args:
        image: `points`, see `KEYPOINT`, and the positions of the key points in the model (K, 3) [m].
        expected: `expectation` and `told` of `find_expectation`.
        filtered: means of the hypotheses (N, n), covariance (n, n), stationary variance in the last image (n,), and
            state of the depth, see `Track`.
        weights: of the hypotheses in the last image and now (N,).
        friction: see `preview`.
        passed: time [s], mean time of rest [s], and the time [s] and motion of the object [m] that the state took.
        watches: each `JumpWatch` as plain tuples.
        touching: object and surface, see `find_first_touch`.

    Returns:
        Key points that are seen (m,); `DetectorErrors`; traction ratios (N,), and their mean; the `_Place`.
    """
    (points, positions), (x, P, V, track), (before, weights) = image, filtered, weights
    (expectation, told), (dt, rest_time, taken) = expected, passed
    detector = summarize_detector_errors(points)
    prior = find_expectation(expectation, told, detector[1], expect_coefficient(friction, before))
    predict(track, dt, rest_time, DEPTH_NOISE)
    responses = watches[0][1], watches[1][1]
    advance(x, P, V, prior, points, positions, taken, find_mean(track), before, responses)
    ratios, _ = preview(friction, x, 0.0, weights, track)
    mean, expectation = np.dot(weights, x), expectation[()]
    at = np.array([find_mean(track), min(max(mean[SHAPE], expectation.lowest), expectation.highest), mean[HEIGHT]])
    x_model, depth = find_place(touching, at)
    return find_seen(points), detector, (ratios, np.dot(weights, ratios)), (at, x_model, depth)


@njit(**_OPTIONS)
def _watch(watches, x, P, measured, posterior, detector, common, misplaced):
    """Test for jumps that only several images show; correct x (N, n) and P (n, n) for one, and return its index."""
    found, alike = NO_JUMP, (common, np.zeros(1))
    unpacked = [JumpWatch(Jump(*each[0]), each[1], each[2], each[3]) for each in watches]
    for index in range(len(watches)):
        possible = found == NO_JUMP and (index == 0 or not misplaced)
        if possible and watch(unpacked[index], measured, posterior, detector[0], alike[index]):
            jump_back(unpacked[index], x, P)
            found = index
    if found != NO_JUMP:
        for each in unpacked:
            forget(each)
    return found


@njit(**_OPTIONS)
def _smooth_depth(track, raw, z, own, scatter):
    """Smooth a depth z [m] with a `Track`.

    Args:
        track: state, which takes the depth.
        raw: the last two depths (2,) [m], which become those of this image.
        z: see above.
        own: its variance by the noise of the key points [m^2].
        scatter: variance of depths over that by the noise.

    Returns:
        The scatter that shows now; what smoothing adds to the depth [m]; by which factor it lessens the deviation.
    """
    scatter = _follow_scatter(scatter, raw, z, scatter * own)
    raw[0], raw[1] = raw[1], z
    correct_track(track, z, scatter * own, DEPTH_NOISE)
    return scatter, find_mean(track) - z, np.sqrt(min(find_variance(track) / own, scatter))


@njit(**_OPTIONS)
def finish(state, image, P, results, friction, filtered, made, where, place, watching):
    """Finish the update of an image after its last linearisation, and fill in the contact state.

    Args:
        state: see `CONTACT_STATE`.
        image: as for `iterate`.
        P: predicted covariance (n, n), see `correct`.
        results: `Measurement` and `Posterior` as plain tuples.
        friction: see `preview`; weights of the hypotheses (N,); the pull of the weight along the finger [N], and the
            standard deviation of the held ratio by it.
        filtered: state of the depth's `Track`; variance of depths over that by the noise; the last two depths (2,) [m].
        made: force, its derivatives, contact state and traction ratio of the linearisation.
        where: pressure centre on both surfaces, extrapolation and least determinant, see `PressedState`.
        place: see `_Place`.
        watching: `DetectorErrors`; each `JumpWatch`, as plain tuples; whether the search has settled.

    Returns:
        Means, covariance, log weights and weights of the hypotheses; noise level, scatter of the depth, and what
        smoothing adds to it [m]; the ratio at which only the jaws hold the object, and its slope; the jump.
    """
    ((points, seen, level, _), expectation), (packed, weights, (pull, pull_stddev)) = image, friction
    (track, scatter, raw), (force, modes, at, ratio), (detector, watches, settled) = filtered, made, watching
    measured, posterior, (at_place, x_model, depth) = Measurement(*results[0]), Posterior(*results[1]), place
    weight, offset = posterior.weight, posterior.mean[HEIGHT] - expectation[()].mean[1]
    ratios, doubt = preview(packed, posterior.x, at_place[0] - posterior.mean[DEPTH], weights, track)
    level, P, x = _follow_level(level, posterior.distances), reduce_covariance(P, posterior.A), posterior.x
    log_weights, weights = posterior.log_weights, np.exp(posterior.log_weights)
    s, jumped, shared = state[()], NO_JUMP, np.array([detector[1], detector[1], detector[1] / detector[2]])
    if settled:
        jumped = _watch(watches, x, P, measured, posterior, detector, ALIKE * shared, s.mistaken > 0.0)
    s.mistaken = 1.0 if jumped == 1 else s.mistaken
    own = max(posterior.own[0, 0], _LEAST_VARIANCE)
    scatter, smooth, lessened = _smooth_depth(track, raw, (weights * x[:, DEPTH]).sum(), own, scatter)
    point, location, extrapolation, smallest_det = where
    for i in range(3):
        s.x[i], s.x_model[i] = at_place[i], x_model[i]
        s.pressure_point[i], s.pressure_location[i] = point[i], location[i]
    s.depth, s.extrapolation, s.sound = depth, extrapolation, smallest_det > 0.0
    # an edge is rounded by more than it sinks in at first
    inclined = _INCLINED * max(1.0 - depth / _EDGE, 0.0) if expectation[()].has_corners else 0.0
    spread = doubt**2 + inclined**2 + find_held(packed, weights) * pull_stddev**2
    shift = smooth + x_model[0] - at_place[0]
    smoothing = posterior.own, lessened, spread_common(measured.H, posterior.A, posterior.L, COMMON * shared)
    read_out(state, force, modes, x, log_weights, P, shift, smoothing, at, ratios, ratio, spread)
    judge_points(state, points, seen, posterior.left, weight, offset)
    upright = find_held_ratio(force, ratio, pull)
    return (x, P, log_weights, weights), (level, scatter, smooth), upright, jumped


@njit(**_OPTIONS)
def iterate(image, at, prior, weight, possible, known, x, last):
    """Return the update of one linearisation and the next step.

    Args:
        image: `image` of `observe`; the object's `EXPECTATION`.
        at: `positions`, `motions`, `at` and `ratio` of `observe`; modes (size, 4) and size of the `PressedState`.
        prior: `ratios`, `x`, `log_weights` and `P` of `correct`.
        weight: see `correct`.
        possible: see `correct`.
        known: object and surface, see `find_first_touch`; reach of the model (size,); state of the depth's `Track`, and
            the variance of depths over that by the noise.
        x: state of the contact (3,).
        last: step (3,), and the share of a step that this one may have.

    Returns:
        Measurement, posterior and jump; the next `_Place`; the motion of the unknowns of the mechanics
        (size,); this step, and the next share; whether it changes nothing that matters.
    """
    (observed, expectation), (positions, motions, x_model, ratio, modes, size) = image, at
    (touching, reach, track, scatter), (before, share) = known, last
    measured = observe(observed, positions, motions, x_model, ratio)
    posterior, found = correct(measured, weight, *prior, possible, x_model[DEPTH])
    aim, variance = posterior.mean[: HEIGHT + 1] - x, max(posterior.own[0, 0], _LEAST_VARIANCE) * scatter
    aim[0] = expect_position(track, posterior.mean[DEPTH], variance, DEPTH_NOISE) - x[0]
    x, step, share = _take_step(x, aim, before, share, expectation)
    after, depth = find_place(touching, x)
    moved = after - x_model
    change = modes[:, 0] * moved[0] + modes[:, 1] * moved[1] + modes[:, 2] * moved[2]
    change /= max((np.abs(change) / reach).max(), 1.0)
    is_settled = size < _SETTLED_CORRECTION and _is_settled(moved, aim - step, share, expectation)
    return (measured, posterior, found), (x, after, depth), change, (step, share), is_settled


@njit(**_OPTIONS)
def _take_step(x, aim, last, share, expectation):
    """Return x (3,) after a step (3,) within a fraction of the linearisation's range, the step, and the next fraction.

    Between two corners of an object the linearisation changes its mind: meet in the middle.
    """
    expectation, step = expectation[()], np.empty(3)
    most = (LARGEST_MOVE, share * expectation.largest_change, share * _LARGEST_SHIFT)
    for i in range(3):
        step[i] = min(max(aim[i], -most[i]), most[i])
    if expectation.has_corners and step[1] * last[1] + step[2] * last[2] < 0.0:
        step[1:] *= 0.5
        share *= 0.5
    moved = x + step
    moved[1] = min(max(moved[1], expectation.lowest), expectation.highest)
    return moved, step, share


@njit(**_OPTIONS)
def _follow_level(level, distances):
    """Return the noise variance relative to the tare's, for the expected one and D^2 (m,) of the residuals."""
    seen = min(np.median(distances) / _MEDIAN_SQUARE, _LARGEST_CHANGE)
    return min(max(level * (1.0 + (seen - 1.0) / _LEVEL_IMAGES), 1.0), _LARGEST_LEVEL)


@njit(**_OPTIONS)
def _follow_scatter(scatter, before, z, R):
    """Return the variance of the depths relative to that by the noise.

    Noise sends the depth back after each step: the product of two steps is less than zero by its variance, while
    steps of a motion have the same sign, or any. Those that are far larger are no noise.

    Args:
        scatter: as it was expected.
        before: the last two depths (2,) [m], NaN if there are none.
        z: depth [m].
        R: its variance, `scatter` included [m^2].
    """
    step, last = z - before[1], before[1] - before[0]
    largest = np.sqrt(2.0 * _LARGEST_LEVEL * R)
    if not (abs(step) <= largest and abs(last) <= largest):
        return scatter
    return min(max(scatter * (1.0 - (1.0 + step * last / R) / _SCATTER_IMAGES), 1.0), _LARGEST_LEVEL)


@njit(**_OPTIONS)
def _is_settled(moved, missing, share, expectation):
    """Return True if the model's step (3,) and its remainder (3,) are below the tolerance."""
    tolerance = (_SETTLED, expectation[()].settled_change, _SETTLED)
    for i in range(3):
        if abs(moved[i]) >= tolerance[i] or (share > _UNDECIDED and abs(missing[i]) >= tolerance[i]):
            return False
    return True


@njit(**_OPTIONS)
def is_believed(mean, weight, V):
    """Return True if most key points agree by their weight (m,), and the camera has moved no farther than a bump.

    Where V (n,) allows more, it may have moved farther by the mean of the state (n,).
    """
    for i in range(len(BUMPED.entries)):
        entry = BUMPED.entries[i]
        if not abs(mean[entry]) < _LARGEST_BUMP * max(BUMPED.stddev[i], np.sqrt(V[entry])):
            return False
    return (weight > _AGREES).mean() > _MAJORITY
