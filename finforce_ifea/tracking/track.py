"""What a tracker says of one image with its standard deviations, and when a force must not be reported."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.relaxation import relax_force
from finforce_ifea.tare import Tare

# Standard deviation of an offset that all key points share [m]: a depth scale wrong by 1 % at 0.15 m.
_COMMON_OFFSET = 1.5e-3


# What acts along the face is seen by nobody where the object is not known: half of the cone for one deviation.
UNSEEN_LEAN = 0.5


class AcrossFinger(NamedTuple):
    """What acts across a finger.

    Attributes:
        place: of the pressure along y [m].
        place_stddev: [m].
        force: along y [N].
        lean_stddev: standard deviation of the force along y as a share of all force [-].
    """

    place: float
    place_stddev: float
    force: float
    lean_stddev: float


class Track(NamedTuple):
    """The outcome of one frame.

    Attributes:
        covariance: of what was estimated (m, m): depth [m], log radius and height [m], or a given contact's force [N].
        force: elastic contact force on the jaw (3,) [N].
        magnitude: of it [N].
        stddev: of it along itself, by the covariance [N].
        force_modes: derivative of the force by what was estimated (3, m).
        pressure_point: pressure centre on the deformed surface (3,) [m].
        pressure_place: the same on the undeformed surface (3,) [m].
        weights: of the key points (K,), 0 for what was not used.
        residual: weighted root mean square residual [m].
        stiffening: force over depth beside that of first touch [-]; large where the place has run to the base.
        misfit: averaged residuals over their standard deviations, about 1 where the model fits.
        extrapolation: distance of the shape from the stored ones, as a share of what the mechanics is good for.
        away: how far the key points alone would have the contact from where it was said to be [m].
        mistaken: probability that it is not there.
        agreement: share of the measured key points that agree with the shape.
        place_error: relative standard deviation of the force that its place leaves, beside the covariance.
        place_stddev: of the height of the pressure centre [m].
        condition: of what was solved, its unknowns scaled.
        kkt: gradient of the objective that is left, relative to its parts.
        iterations: Newton iterations.
        converged: whether the last one changed nothing that matters.
        bearable: force beyond which no equilibrium is believed [N].
        across: what acts across the finger, None where nobody knows.
        lean_stddev: standard deviation of the lean of the force along the finger [-], None where nobody knows.
        lean_leak: change of the force along x by one along the finger [-].
        ambiguity: change of the force by the last iteration where that has not converged [N].
        sound: whether the mesh is in order and the numbers are finite.
        quiet: whether nothing seems to press.
        loaded: whether something surely presses.
    """

    covariance: NDArray
    force: NDArray
    magnitude: float
    stddev: float
    force_modes: NDArray
    pressure_point: NDArray
    pressure_place: NDArray
    weights: NDArray
    stiffening: float
    residual: float
    misfit: float
    kkt: float
    iterations: int
    converged: bool
    sound: bool
    quiet: bool
    loaded: bool
    away: float = 0.0
    extrapolation: float = 0.0
    mistaken: float = 0.0
    agreement: float = 1.0
    place_error: float = 0.0
    place_stddev: float = 0.0
    condition: float = 1.0
    ambiguity: float = np.inf
    bearable: float = np.inf
    across: AcrossFinger | None = None
    lean_stddev: float | None = None
    lean_leak: float = 0.0


def compute_magnitude_stddev(force: NDArray, modes: NDArray, covariance: NDArray) -> float:
    """Returns the standard deviation [N] of a force (3,) along itself, along -x when it is none.

    Args:
        force: (3,) [N].
        modes: derivative of the force by what was estimated (3, m).
        covariance: of what was estimated (m, m).
    """
    modes, covariance = np.ascontiguousarray(modes), np.ascontiguousarray(covariance)
    return float(measure_along(np.ascontiguousarray(force), modes, covariance))


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadFit:
    """Least squares of one mode: its gain (2 n,) on the offsets, and the standard deviation of what it finds."""

    gain: NDArray
    stddev: float


def fit_load(modes: NDArray, deviation: NDArray) -> LoadFit:
    """Returns the fit of one mode (n, 2) to offsets of n key points, each off by chance by its deviation (n,) [m].

    All together are off by chance, too, as a wrong depth scale moves them alike.
    """
    common = np.broadcast_to(np.eye(2), (len(modes), 2, 2))
    design = np.concatenate([modes[:, :, None], common], axis=2) / deviation[:, None, None]
    design = np.concatenate([design.reshape(-1, 3), np.diag([0.0, 1.0, 1.0]) / _COMMON_OFFSET])
    covariance = np.linalg.pinv(design.T @ design)
    gain = (covariance @ design.T)[0, :-3] / np.repeat(deviation, 2)
    return LoadFit(gain=gain, stddev=float(np.sqrt(max(covariance[0, 0], 1e-300))))


def explain_offsets(modes: NDArray, tare: Tare, offset_stddev: float) -> float:
    """Returns by how many standard deviations one mode (K, 2) explains the offsets of a tare; see `fit_load`."""
    seen = tare.counts > 0
    fit = fit_load(modes[seen], np.sqrt(offset_stddev**2 + tare.offset_variance(0.0)[seen]))
    return float(fit.gain @ tare.offsets[seen][:, [0, 2]].ravel() / fit.stddev)


# Between two corners of an object a place may not settle; it matters where the force changes by more than this [N].
_AMBIGUOUS = 0.15
# Beyond these a force is not reported: misfit of the shape, stiffening, standard deviation [N], its share of the force.
_LARGEST_MISFIT = 2.0
_LARGEST_STIFFENING = 5.0
_VAGUE_FORCE, _VAGUE_SHARE = 1.0, 0.25
# Shapes so many times as far from the stored ones as they are good for.
_STRANGEST = 2.0
# Share of the key points: what no majority says is not believed.
_MAJORITY = 0.5
# A contact that is so surely another one, and at least so far from where it was said to be [m].
_MISTAKEN, _LEAST_AWAY = 0.99, 4e-3


def find_doubt(track: Track, *, settles: bool) -> str:
    """Returns why a track must not be believed, empty when it may.

    Args:
        track: of one frame.
        settles: whether the solver iterates until nothing changes, so that one that has not is in doubt.
    """
    if settles and not track.converged and track.ambiguity > _AMBIGUOUS:
        return f"the shape has not settled within {track.iterations} iterations; is the contact's place right?"
    if track.extrapolation > _STRANGEST:
        return "the jaw's shape is too far from the stored ones; solver solid or frame knows any shape"
    if track.misfit > _LARGEST_MISFIT:
        return f"the key points do not fit this contact ({track.misfit:.1f} standard deviations); is its place right?"
    if track.stiffening > _LARGEST_STIFFENING:
        return f"the jaw seems {track.stiffening:.0f} times as stiff as at the given height; is the contact elsewhere?"
    if track.agreement <= _MAJORITY:
        return f"only {100 * track.agreement:.0f} % of the key points agree with the jaw's shape"
    if track.mistaken > _MISTAKEN and abs(track.away) > _LEAST_AWAY:
        return f"the contact is not where it was said to be: the key points have it {1e3 * track.away:+.0f} mm away"
    if track.magnitude > track.bearable:
        most = f"expected {track.bearable:.0f} N at most"
        return f"the shape would take {track.magnitude:.0f} N, {most}; is the contact elsewhere?"
    if not track.stddev <= max(_VAGUE_FORCE, _VAGUE_SHARE * track.magnitude):
        return f"the visible key points tell the force only within {track.stddev:.2g} N"
    return ""


_OPTIONS = {"cache": True, "error_model": "numpy"}


class SolutionNumbers(NamedTuple):
    """One force, and what belongs to it.

    Attributes:
        force: that the material gives now (3,) [N].
        torque: about the jaw frame's origin (3,) [N m].
        force_stddev: (3,) [N].
        torque_stddev: (3,) [N m].
        contact_point: pressure centre (3,) [m], NaN without a force.
        contact_place: the same on the undeformed surface (3,) [m], NaN without a force.
        normal: direction of the force (3,), NaN without a force.
        magnitude: of the force [N].
        magnitude_stddev: [N].
    """

    force: NDArray
    torque: NDArray
    force_stddev: NDArray
    torque_stddev: NDArray
    contact_point: NDArray
    contact_place: NDArray
    normal: NDArray
    magnitude: float
    magnitude_stddev: float


@njit(**_OPTIONS)
def measure_along(force: NDArray, modes: NDArray, covariance: NDArray) -> float:
    """Returns the standard deviation [N] of a force (3,) along itself, along -x when it is none.

    Args:
        force: (3,) [N].
        modes: derivative of the force by what was estimated (3, m).
        covariance: of what was estimated (m, m).
    """
    magnitude = np.sqrt((force * force).sum())
    direction = force / magnitude if magnitude > 0.0 else np.array([-1.0, 0.0, 0.0])
    m, total = modes.shape[1], 0.0
    mode = np.zeros(m)
    for i in range(m):
        for a in range(3):
            mode[i] += direction[a] * modes[a, i]
    for i in range(m):
        for j in range(m):
            total += mode[i] * covariance[i, j] * mode[j]
    return np.sqrt(total)


class ForceEvidence(NamedTuple):
    """A force that was tracked, and what is known of it.

    Attributes:
        elastic: that the shape asks for (3,) [N].
        modes: its derivative by what was estimated (3, m).
        covariance: of what was estimated (m, m).
        pressure: pressure centre on the deformed surface (3,) [m].
        place: the same on the undeformed surface (3,) [m].
        place_stddev: of its height [m].
        across: the four of `AcrossFinger`; the force is NaN where nobody knows it.
        along: standard deviation of the lean along the finger [-].
        leak: by which such a lean shows along x, too [-].
        error: relative standard deviation of the mechanics.
        sliding: friction of an object that may slide along the finger, 0 for one that does not.
    """

    elastic: NDArray
    modes: NDArray
    covariance: NDArray
    pressure: NDArray
    place: NDArray
    place_stddev: float
    across: tuple[float, float, float, float]
    along: float
    leak: float
    error: float
    sliding: float


def find_numbers(evidence: ForceEvidence, relaxation: tuple, dt: float) -> SolutionNumbers:
    """Returns the force that the material gives for a tracked one, and what belongs to it.

    Args:
        evidence: of the force.
        relaxation: the finger's, see `Relaxation.packed`, which goes on by dt.
        dt: time since the last force [s].
    """
    vectors, magnitude, stddev = _find_numbers(tuple(evidence), relaxation, dt)
    return SolutionNumbers(*vectors, magnitude, stddev)


# What two jaws hold does not slide out, though their bent faces lean: friction takes up the force along the finger, and
# the magnitude that belongs to the same shape is larger, by a share of the tangent of the lean that the twin's held
# objects have.
_LEANING = 0.3
# Share of a force that nobody has seen along z.
UNSEEN_ALONG = 0.3


@njit(**_OPTIONS)
def _find_numbers(evidence, relaxation, dt):
    """Returns the vectors (7, 3), the magnitude and its standard deviation of `SolutionNumbers`."""
    elastic, modes, covariance, pressure, place, place_stddev, across, along, leak, error, sliding = evidence
    out = np.empty((7, 3))
    force, torque, stddev, torque_stddev, arm, undeformed, normal = out
    y, y_stddev, aside, lean_across = across
    fit, before = measure_along(elastic, modes, covariance), _measure_length(elastic)
    relax_force(elastic, relaxation, dt, force)
    if before > 0.0 and np.isfinite(aside):
        force[1] = aside * _measure_length(force) / before
    magnitude, leaning = _measure_length(force), 0.0
    if sliding > 0.0:
        leaning = _LEANING * min(sliding, abs(force[2]) / max(abs(force[0]), 1e-9))
    # the mechanics errs in the direction as in the magnitude
    wrong = (error**2 + leaning**2) * magnitude**2
    leaked, leaned = (leak * along * magnitude) ** 2, (along * magnitude) ** 2
    # a larger force leans more: where it is hardly known, its direction is not known either
    leaned += (UNSEEN_ALONG * fit**2 / max(magnitude + fit, 1e-300)) ** 2
    more = (wrong + leaked, (lean_across * magnitude) ** 2, wrong + leaned)
    for a in range(3):
        variance = more[a]
        for i in range(modes.shape[1]):
            for j in range(modes.shape[1]):
                variance += modes[a, i] * covariance[i, j] * modes[a, j]
        stddev[a] = np.sqrt(variance)
        arm[a], undeformed[a] = pressure[a], place[a]
    arm[1] = undeformed[1] = y
    arm_stddev = (0.0, y_stddev, place_stddev)
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        torque[a] = arm[b] * force[c] - arm[c] * force[b]
        variance = (arm[b] * stddev[c]) ** 2 + (arm[c] * stddev[b]) ** 2
        variance += (arm_stddev[b] * force[c]) ** 2 + (arm_stddev[c] * force[b]) ** 2
        torque_stddev[a] = np.sqrt(variance)
    for a in range(3):
        if magnitude > 0.0:
            normal[a] = force[a] / magnitude
        else:
            arm[a] = undeformed[a] = normal[a] = np.nan
    return out, magnitude, np.sqrt(fit**2 + wrong + leaked)


@njit(**_OPTIONS)
def _measure_length(vector):
    """Returns the length of a vector (3,)."""
    return np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
