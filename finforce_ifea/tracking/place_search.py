"""The place of an object in one image: forecast, Newton's method on jaw and place together, and what is to be reported.

The same function runs as Python, for the mechanics that are evaluated in full, and compiled for a reduced jaw.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import DEPTH, HEIGHT, SHAPE
from finforce_ifea.contact_mechanics.pressed_jaw import RollingContact
from finforce_ifea.reduced.evaluation import ReducedContact, ReducedProbe
from finforce_ifea.tracking.place_update import (
    Average,
    Residuals,
    Uncertainty,
    blank_residuals,
    forecast_place,
    update_place,
    weigh_residuals,
)
from finforce_ifea.tracking.pressing import (
    approach_at,
    limit_at,
    linearize_at,
    motions_at,
    positions_at,
    touch_at,
)
from finforce_ifea.tracking.track import measure_along

_OPTIONS = {"cache": True, "error_model": "numpy"}
_BOTH = {"error_model": "numpy"}
_STILL = np.zeros(2)
# The mechanics is evaluated at this depth [m] at least; below it shapes and forces are continued linearly.
_LEAST_DEPTH = 3e-5
TOUCH_DEPTH, LOADED_DEPTH = 0.15e-3, 0.5e-3
_DEPTH_DRIFT = 0.01e-3
_LARGEST_MOVE = 0.7e-3
# A leap only has to come near. One that leaves the points as far as they were by all but this is in vain [m].
_LARGEST_LEAP, _LEAST_APPROACH = 2e-3, 0.1e-3
_LARGEST_SHIFT = 0.3e-3
_SETTLED_MOVE = 1e-4
# Of the model's reach, 0.1 mm.
_SETTLED_CORRECTION = 0.05
_UNDECIDED = 0.2
# Fewer points in agreement with the forecast than this share call for a leap; a forecast is never wider than this [m].
_LEAST_AGREEMENT = 0.6
_WIDEST_FORECAST = 1e-3


class PlaceState(NamedTuple):
    """What one frame leaves to the next, which writes over it.

    Attributes:
        q: unknowns of the jaw (size,).
        modes: their motions by depth, shape and height (size, 3).
        reached: the place at which the mechanics stands (3,).
        motion: depth [m] and speed [m/s] (2,).
        spread: covariance of both (2, 2).
        slow: shape and height [m] (2,).
        residuals: averaged over the last frames (K, 2) [m]; see `Average`.
        by_place: their derivatives (K, 2, 3).
        count: frames that they stand for (K,).
    """

    q: NDArray
    modes: NDArray
    reached: NDArray
    motion: NDArray
    spread: NDArray
    slow: NDArray
    residuals: NDArray
    by_place: NDArray
    count: NDArray


class PlaceFrame(NamedTuple):
    """The key points of one image.

    Attributes:
        measured: (K, 3) [m], offsets and what acts across taken off, NaN where unused.
        rest: of the undeformed model (K, 3) [m].
        noise: see `Uncertainty`; so the next four.
        gain: (K, 2).
        width_variance: (K,) [m^2].
        trust: (K,).
        offset_variance: (K,) [m^2].
        dt: time since the last image [s].
        sudden: whether that did not show the speed.
    """

    measured: NDArray
    rest: NDArray
    noise: NDArray
    gain: NDArray
    width_variance: NDArray
    trust: NDArray
    offset_variance: NDArray
    dt: float
    sudden: bool


class PlaceRules(NamedTuple):
    """What is expected of the object and allowed to the search.

    Attributes:
        prior: of shape and height (2,).
        prior_variance: (2,).
        lowest: shape [-] or tilt [rad].
        highest: the same.
        largest_change: of it at once.
        settled_change: of it that matters no more.
        has_corners: whether the object may rock.
        farthest: of the height from the prior [m].
        acceleration: expected [m/s^2].
        memory: longest average [frames].
        model_error: see `Uncertainty`.
        gate: see `Uncertainty`.
        iterations: most of them.
        fewest: key points.
        stiffness: of the jaw at first touch [N/m], 0 where nobody knows.
    """

    prior: NDArray
    prior_variance: NDArray
    lowest: float
    highest: float
    largest_change: float
    settled_change: float
    has_corners: bool
    farthest: float
    acceleration: float
    memory: float
    model_error: float
    gate: float
    iterations: int
    fewest: int
    stiffness: float


class FoundPlace(NamedTuple):
    """The outcome of one image; its arrays hold until the next image is looked at.

    Attributes:
        place: that the key points ask for (3,).
        moved: of it since the forecast (3,).
        pressing: of the object on the jaw before the last step (3,) [N].
        force: elastic contact force on the jaw (3,) [N].
        leaning: its derivative by a lean of the force (3,).
        pressure_point: pressure centre on the deformed surface (3,) [m].
        pressure_place: the same on the undeformed surface (3,) [m].
        force_modes: derivatives of the force by the place (3, 3).
        covariance: of the place (3, 3), by the misfit too.
        motions: of the key points by the place and a lean of the force (K, 3, 4).
        data: residuals and weights.
        magnitude: of the force [N].
        stddev: of it along itself [N].
        pressed: depth below first touch [m].
        jumped: see `PlaceUpdate`; so the next seven.
        depth_variance: [m^2].
        kkt: [-].
        residual: [m].
        misfit: [-].
        away: [m].
        mistaken: [-].
        condition: [-].
        height_variance: [m^2].
        stiffening: see `Track`.
        ambiguity: see `Track`.
        extrapolation: see `PressedState`.
        iterations: made.
        settled: whether the last one changed nothing that matters.
        sound: whether the numbers are finite and the mesh is in order.
    """

    place: NDArray
    moved: NDArray
    pressing: NDArray
    force: NDArray
    leaning: NDArray
    pressure_point: NDArray
    pressure_place: NDArray
    force_modes: NDArray
    covariance: NDArray
    motions: NDArray
    data: Residuals
    magnitude: float
    stddev: float
    pressed: float
    jumped: bool
    depth_variance: float
    kkt: float
    residual: float
    misfit: float
    away: float
    mistaken: float
    condition: float
    height_variance: float
    stiffening: float
    ambiguity: float
    extrapolation: float
    iterations: int
    settled: bool
    sound: bool


_VECTORS, _MATRICES = 7, 2  # of three and of nine numbers, the first of `FoundPlace`
_SCALARS = 3 * _VECTORS + 9 * _MATRICES  # where the single numbers begin
_SINGLE = 22  # of them: used, known, jump, agreed of `Residuals`, and what follows `data`


class PlaceRoom:
    """Where a search for the place of an object leaves what it has found.

    Arrays that are made anew in compiled code and handed to Python cost more than finding what they hold.

    Attributes:
        arrays: for compiled code: numbers (61,), motions (K, 3, 4) and `Residuals` as a plain tuple.
    """

    def __init__(self, count: int) -> None:
        """Makes room for `count` key points."""
        numbers, motions, middle = np.zeros(_SCALARS + _SINGLE), np.zeros((count, 3, 4)), 3 * _VECTORS
        self._blank = blank_residuals(count)
        self.arrays = numbers, motions, tuple(self._blank)
        vectors, matrices = numbers[:middle].reshape(-1, 3), numbers[middle:_SCALARS].reshape(-1, 3, 3)
        self._views, self._single = (*vectors, *matrices, motions), numbers[_SCALARS:]

    def read(self) -> FoundPlace:
        """Returns what the last search has found."""
        single = self._single.tolist()
        used, known, jump, agreed = single[:4]
        data = self._blank._replace(used=int(used), known=int(known), jump=jump, agreed=int(agreed))
        ends = int(single[-3]), bool(single[-2]), bool(single[-1])
        return FoundPlace(*self._views, data, *single[4:7], bool(single[7]), *single[8:-3], *ends)


def find_place(
    contact: RollingContact, probe: Any, state: PlaceState, frame: PlaceFrame, rules: PlaceRules, room: PlaceRoom
) -> FoundPlace | None:
    """Returns the place of the object in one image, None where too few key points agree.

    Args:
        contact: of the jaw with the object.
        probe: of its key points.
        state: of the image before.
        frame: key points.
        rules: what is expected and allowed.
        room: for what is found.
    """
    if isinstance(contact, ReducedContact) and isinstance(probe, ReducedProbe):
        packed = contact.packed, tuple(contact.indenter.pressed), tuple(contact.rubbing.describe(_STILL))
        points = probe.points, probe.shapes, probe.compliance
        found = _find_reduced(packed, points, tuple(state), tuple(frame), tuple(rules), room.arrays)
    else:
        found = _find_place(contact, probe, state, frame, rules, room.arrays)
    return room.read() if found else None


@register_jitable(**_BOTH)
def reach_place(contact: Any, place: NDArray) -> NDArray:
    """Returns the place (3,) at which the mechanics stands for `place`: nowhere above the surface."""
    reached = place.copy()
    reached[DEPTH] = max(place[DEPTH], touch_at(contact, place) + _LEAST_DEPTH)
    return reached


@register_jitable(**_BOTH)
def _bound(asked, place, share, rules):
    """Returns the place asked for, within a share of where the linearisation about the present one holds."""
    aim = np.empty(3)
    change = (_LARGEST_MOVE, share * rules.largest_change, share * _LARGEST_SHIFT)
    for i in range(3):
        aim[i] = min(max(asked[i], place[i] - change[i]), place[i] + change[i])
    aim[SHAPE] = min(max(aim[SHAPE], rules.lowest), rules.highest)
    middle = rules.prior[1]
    aim[HEIGHT] = min(max(aim[HEIGHT], middle - rules.farthest), middle + rules.farthest)
    return aim


@register_jitable(**_BOTH)
def _is_settled(state, moved, missing, rules):
    """Whether the last iteration changed nothing that matters."""
    change = (_SETTLED_MOVE, rules.settled_change, _SETTLED_MOVE)
    for i in range(3):
        if max(abs(moved[i]), abs(missing[i])) >= change[i]:
            return False
    return state.size < _SETTLED_CORRECTION


@register_jitable(**_BOTH)
def _spread_modes(modes, change):
    """Returns what a change (3,) of the place makes of the unknowns (size,)."""
    return modes[:, 0] * change[0] + modes[:, 1] * change[1] + modes[:, 2] * change[2]


@register_jitable(**_BOTH)
def _weigh(contact, probe, q, state, frame, chance, place, expected):
    """Returns the residuals of a linearised state at a place, and the motions of the key points (K, 3, 4)."""
    motions = motions_at(contact, probe, q, state.modes)
    positions = positions_at(contact, probe, q)
    below = place[DEPTH] - reach_place(contact, place)[DEPTH]
    data = weigh_residuals(frame.measured, positions, frame.rest, motions, place - expected, below, chance)
    return data, motions


def _find_place(contact, probe, state, frame, rules, room):
    """Writes the `FoundPlace` of one image to room; returns whether enough key points agree. See `pressing`."""
    state, frame, rules = PlaceState(*state), PlaceFrame(*frame), PlaceRules(*rules)
    numbers, kept_motions, kept = room
    forecast = forecast_place(
        state.motion, state.spread, state.slow, frame.dt, rules.acceleration, _DEPTH_DRIFT, frame.sudden
    )
    depth_variance = min(forecast.spread[0, 0], _WIDEST_FORECAST**2)
    chance = Uncertainty(
        frame.noise,
        frame.gain,
        frame.width_variance,
        frame.trust,
        frame.offset_variance,
        depth_variance,
        rules.model_error,
        rules.gate,
    )
    average = Average(state.residuals, state.by_place, state.count)
    largest = np.array([rules.largest_change, _LARGEST_SHIFT])
    place = forecast.place.copy()
    q = state.q + _spread_modes(state.modes, reach_place(contact, place) - state.reached)
    found, settled, iteration, share = False, False, 0, 1.0
    last, moved, far, in_vain = np.zeros(3), np.zeros(3), np.inf, 0
    while not settled and iteration < rules.iterations and in_vain < 2:
        iteration += 1
        mechanical = reach_place(contact, place)
        pressed = linearize_at(contact, q, mechanical)
        if not pressed.touches:
            q = q + approach_at(contact, q, pressed.correction, mechanical)
            continue
        q = q + pressed.correction
        data, motions = _weigh(contact, probe, q, pressed, frame, chance, place, forecast.place)
        if data.used < max(rules.fewest, _LEAST_AGREEMENT * data.known):
            # towards the median depth that the points ask for, which disagree with the forecast
            leapt = place.copy()
            leapt[DEPTH] += min(max(data.jump, -_LARGEST_LEAP), _LARGEST_LEAP)
            step = pressed.modes[:, DEPTH] * (reach_place(contact, leapt)[DEPTH] - mechanical[DEPTH])
            place, q = leapt, q + limit_at(contact, step)
            in_vain = in_vain + 1 if abs(data.jump) > far - _LEAST_APPROACH else 0
            far = abs(data.jump)
            continue
        update, found = (
            update_place(data, average, forecast, rules.prior, rules.prior_variance, rules.memory, largest),
            True,
        )
        aim = _bound(update.place, place, share, rules)
        # between two corners of an object the linearisation changes its mind: meet in the middle
        change = aim - place
        if rules.has_corners and last[SHAPE] * change[SHAPE] + last[HEIGHT] * change[HEIGHT] < 0.0:
            share *= 0.5
        missing = update.place - aim if share > _UNDECIDED else np.zeros(3)
        last, moved, place = change, reach_place(contact, aim) - mechanical, aim
        q = q + limit_at(contact, _spread_modes(pressed.modes, moved))
        settled = _is_settled(pressed, moved, missing, rules)
    if not found or not pressed.touches:
        return False
    _keep(state, q, pressed.modes, reach_place(contact, place), place, update)
    depth = place[DEPTH] - touch_at(contact, place)
    last_step = (moved, iteration, settled)
    _report(numbers, depth, q, last_step, pressed, data, update, forecast.place, rules.stiffness)
    _keep_residuals(kept, tuple(data), kept_motions, motions)
    return True


@register_jitable(**_BOTH)
def _keep(state, q, modes, reached, place, update):
    """Writes what the next frame starts from."""
    for k in range(len(q)):
        state.q[k] = q[k]
        for i in range(3):
            state.modes[k, i] = modes[k, i]
    state.motion[0], state.motion[1] = place[DEPTH], update.speed
    for i in range(3):
        state.reached[i] = reached[i]
    for a in range(2):
        state.slow[a] = place[1 + a]
        for b in range(2):
            state.spread[a, b] = update.spread[a, b]
    for k in range(len(state.count)):
        state.count[k] = update.average.count[k]
        for a in range(2):
            state.residuals[k, a] = update.average.residuals[k, a]
            for i in range(3):
                state.by_place[k, a, i] = update.average.modes[k, a, i]


@register_jitable(**_BOTH)
def _report(out, depth, q, last_step, pressed, data, update, expected, stiffness):
    """Writes the numbers of a `FoundPlace` to out (61,) after a search whose last step moved the place by (3,)."""
    moved, iterations, settled = last_step
    modes, covariance, misfit = np.empty((3, 3)), np.empty((3, 3)), max(1.0, update.misfit**2)
    continued = max(0.0, depth / _LEAST_DEPTH) if depth < _LEAST_DEPTH else 1.0
    force, changed, size, total = np.empty(3), 0.0, 0.0, q.sum()
    for a in range(3):
        change = 0.0
        for i in range(3):
            modes[a, i] = pressed.force_modes[a, i]
            change += modes[a, i] * moved[i]
            covariance[a, i] = update.covariance[a, i] * misfit
            total += update.covariance[a, i]
        force[a] = (pressed.force[a] + change) * continued
        changed, size, total = changed + change * change, size + force[a] * force[a], total + force[a]
    covariance[DEPTH, DEPTH] += update.depth_variance * misfit
    for a in range(3):
        out[a], out[3 + a], out[6 + a] = update.place[a], update.place[a] - expected[a], pressed.force[a]
        out[9 + a], out[12 + a] = force[a], pressed.force_modes[a, 3]
        out[15 + a], out[18 + a] = pressed.pressure_point[a], pressed.pressure_place[a]
        for i in range(3):
            out[21 + 3 * a + i], out[30 + 3 * a + i] = modes[a, i], covariance[a, i]
    single = out[_SCALARS:]
    single[0], single[1], single[2], single[3] = data.used, data.known, data.jump, data.agreed
    magnitude = np.sqrt(size)
    single[4], single[5] = magnitude, measure_along(force, modes, covariance)
    single[6], single[7], single[8] = depth, update.jumped, update.depth_variance
    single[9], single[10], single[11] = update.kkt, update.residual, update.misfit
    single[12], single[13], single[14] = update.away, update.mistaken, update.condition
    single[15], single[16] = update.covariance[HEIGHT, HEIGHT], 1.0
    if stiffness > 0.0 and depth >= LOADED_DEPTH:
        single[16] = magnitude / (stiffness * depth)
    single[17], single[18] = 0.0 if settled else np.sqrt(changed), pressed.extrapolation
    single[19], single[20], single[21] = iterations, settled, np.isfinite(total) and pressed.smallest_det > 0.0


@njit(**_OPTIONS)
def _keep_residuals(kept, data, kept_motions, motions):
    """Writes over residuals that were kept, plain tuples both, and over the motions of the key points (K, 3, 4)."""
    kept, data = Residuals(*kept), Residuals(*data)
    for k in range(len(data.weights)):
        kept.weights[k], kept.bias[k] = data.weights[k], data.bias[k]
        kept.off[k], kept.off_noise[k] = data.off[k], data.off_noise[k]
        for a in range(2):
            kept.r[k, a] = data.r[k, a]
            for b in range(2):
                kept.noise[k, a, b] = data.noise[k, a, b]
            for i in range(3):
                kept.modes[k, a, i] = data.modes[k, a, i]
        for a in range(3):
            for i in range(4):
                kept_motions[k, a, i] = motions[k, a, i]


# Plain tuples are handed over from Python several times as fast as named ones.
_find_reduced = njit(**_OPTIONS)(_find_place)
