"""The state of a contact by one image: its uncertainty, the elastic force, and when to reject it.

The state x is depth [m], shape and height [m] of the pressing object. Records of these types are read by name in
Python, as `state["x"]`, and in compiled code, as `state.x`.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.relaxation import relax_force

_OPTIONS = {"cache": True, "error_model": "numpy"}
_V, _M = (np.float64, 3), (np.float64, (3, 3))

# Contact of a tracker in an image. The estimate is x where a contact is tracked, and the force [N] where its location
# is given.
CONTACT_STATE = np.dtype(
    [
        ("x", *_V),
        ("x_model", *_V),  # where the mechanics stands: never above the surface
        ("covariance", *_M),  # of the estimate
        ("force", *_V),  # elastic force on the jaw [N]
        ("force_modes", *_M),  # its derivative by the estimate
        ("pressure_point", *_V),  # pressure centre on the deformed surface [m]
        ("pressure_location", *_V),  # the same on the undeformed surface [m]
        ("magnitude", float),  # of the force [N]
        ("stddev", float),  # of the force along itself [N]
        ("unobserved_stddev", float),  # of a force elsewhere, which key points hardly show [N]
        ("depth", float),  # below first touch [m]
        ("depth_variance", float),  # [m^2]
        ("height_stddev", float),  # of the pressure centre [m]
        ("used", int),  # key points with a weight
        ("residual", float),  # weighted root mean square [m]
        ("kkt", float),  # gradient of the objective, relative to its parts
        ("offset", float),  # contact location by the key points, from the stated one [m]
        ("mistaken", float),  # probability that the stated location is wrong
        ("location_error", float),  # relative standard deviation of the force by the location
        ("extrapolation", float),  # distance of the shape from the stored ones, relative to their range
        ("max_force", float),  # largest plausible force [N]
        ("y", float),  # of the pressure along the width [m]
        ("y_stddev", float),  # [m]
        ("lateral_force", float),  # along y [N]; NaN where it is unknown
        ("lateral_stddev", float),  # of the lateral force, relative to the force
        ("traction_stddev", float),  # of the traction ratio along the finger
        ("traction_leak", *_V),  # derivative of the force by that ratio at fixed key points [N]
        ("iterations", int),
        ("converged", bool),  # the last step was below the tolerance
        ("sound", bool),  # no element is inverted, all numbers are finite
        ("quiet", bool),  # the jaw seems unloaded
        ("loaded", bool),  # the jaw is surely loaded
    ],
    align=True,
)
ContactState = NDArray  # of this type and no dimension

# One key point of an image. In the plane: along x and z, with y known.
KEYPOINT = np.dtype(
    [
        ("measured", *_V),  # offsets and lateral motion removed, NaN where unused [m]
        ("rest", *_V),  # of the undeformed model [m]
        ("tare_noise", float, (2, 2)),  # covariance in the plane in an image like those of the tare [m^2]
        ("gain", float, 2),  # regression of the noise along x and z on that along y
        ("width_variance", float),  # along y in such an image [m^2]
        ("noise_ratio", float),  # variance in the tare over that in this image
        ("offset_variance", float),  # of the constant offset [m^2]
        ("detector_variance", float),  # part of it due to the detector, constant for one shape [m^2]
        ("weight", float),  # by agreement with the others, 0 to 1
    ]
)

# Least depth at which the mechanics is evaluated [m]; shapes and forces below are extrapolated linearly.
LEAST_DEPTH = 3e-5
# Depth below which the jaw seems unloaded [m].
TOUCH_DEPTH = 0.15e-3
# Depth above which it is surely loaded [m].
LOADED_DEPTH = 0.5e-3
# Standard deviation of an unobserved traction ratio, relative to the coefficient of friction [-].
UNSEEN_TRACTION = 0.5
# Standard deviation of an unknown lateral location [m].
MIDDLE_STDDEV = 3e-3


def blank_contact_state() -> ContactState:
    """Return a contact state in which nothing was estimated and nothing is wrong."""
    return np.ndarray((), CONTACT_STATE, bytearray(_BLANK_BYTES))  # a copy field by field takes twenty times as long


_BLANK = np.zeros((), CONTACT_STATE)
_BLANK["max_force"] = np.inf
_BLANK["used"] = 1
_BLANK_BYTES = _BLANK.tobytes()

# Standard deviation beyond which a force is rejected, relative to the force [-].
_VAGUE_SHARE = 0.25
# Extrapolation from the stored shapes beyond which a force is rejected [-].
_FARTHEST_SHAPE = 2.0
# Probability of a wrong location from which a force is rejected [-].
_MISTAKEN = 0.99
# Least error of such a location [m].
_LEAST_OFFSET = 4e-3
# Residual of the key points beyond which a force is rejected, at least [m]: the mechanics explains a finger within
# 0.6 mm, even at a slightly wrong height; a zoomed or empty picture leaves 1.2 mm and more.
LARGEST_RESIDUAL = 1e-3
# The same relative to the finger's length [-].
_RESIDUAL_SHARE = 0.015
# The same for key points that were noisy during the tare [sigma].
_NOISY = 3.0
# Negative depth that rejects the image [sigma].
_PULLING = 3.0
# Bounds of that depth [m].
_LEAST_PULL, _MOST_PULL = 0.5e-3, 0.9e-3


def bound_residual(rest: NDArray, noise: NDArray) -> float:
    """Return the largest residual [m] of a jaw's key points.

    Args:
        rest: key points of the jaw file (K, 3) [m].
        noise: covariance (3, 3) of key points in the tare [m^2].
    """
    chance = _NOISY * np.sqrt(noise[0, 0] + noise[2, 2])
    return float(max(LARGEST_RESIDUAL, _RESIDUAL_SHARE * np.ptp(rest[:, 2]), chance))


def find_rejection_reason(state: ContactState, *, largest_residual: float, largest_stddev: float) -> str:
    """Return the reason for rejecting the force of a contact state; empty if it can be trusted.

    Args:
        state: of one image.
        largest_residual: of key points of the jaw, see `bound_residual` [m].
        largest_stddev: standard deviation with which a small force is still of use [N].
    """
    state = state[()]
    magnitude = float(state["magnitude"])
    if state["extrapolation"] > _FARTHEST_SHAPE:
        return "the jaw's shape is too far from the stored ones; solver solid or frame knows any shape"
    if state["mistaken"] > _MISTAKEN and abs(state["offset"]) > _LEAST_OFFSET:
        return f"the contact is off its stated location: the key points have it {1e3 * state['offset']:+.0f} mm away"
    if magnitude > state["max_force"]:
        most = f"expected {state['max_force']:.0f} N at most"
        return f"the shape would take {magnitude:.0f} N, {most}; is the contact elsewhere?"
    ambiguity = _find_ambiguity(state, max(largest_stddev, _VAGUE_SHARE * magnitude))
    if ambiguity or state["residual"] <= largest_residual:
        return ambiguity
    off = f"the key points lie {1e3 * state['residual']:.1f} mm off any shape of the jaw"
    expected = f"expected {1e3 * largest_residual:.1f} mm at most"
    return f"{off}, {expected}; another finger or camera, a zoomed picture, or nothing of the jaw in view?"


def _find_ambiguity(state: ContactState, vague: float) -> str:
    """Return the reason for which a fitting contact leaves the force uncertain by `vague` [N] or more; else empty."""
    pulled = -float(state["depth"])
    if pulled > min(max(_PULLING * sqrt(state["depth_variance"]), _LEAST_PULL), _MOST_PULL):
        bent = f"the jaw is bent towards the object, as if that pulled by {1e3 * pulled:.1f} mm"
        return f"{bent}: open the jaw and tare, or the contact is elsewhere"
    if state["unobserved_stddev"] > vague:
        return "the object may press where key points hardly show a force: next to the clamp, or along its face"
    if state["stddev"] == np.inf:
        return f"the shape has not settled within {state['iterations']} iterations; is the contact location right?"
    if not state["stddev"] <= vague:
        return f"the visible key points tell the force only within {state['stddev']:.2g} N, expected {vague:.2g} N"
    return ""


@njit(**_OPTIONS)
def measure_along(force: NDArray, modes: NDArray, covariance: NDArray) -> float:
    """Return the standard deviation [N] of a force (3,) along itself, along -x where it is zero.

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


# Standard deviation along z of an unobserved force, relative to the force [-].
UNSEEN_ALONG = 0.3
# Root mean square error of a length by a variance across it, relative to variance over length [-]: sqrt(3) / 2.
_CURVED = 0.87


@njit(**_OPTIONS)
def compute_force(state, relaxation, relaxation_stddev, dt, errors, out):
    """Compute force, torque, standard deviations and contact into out (7, 3).

    The rows are force [N], torque about the jaw frame's origin [N m], their standard deviations, contact point [m],
    contact location [m] and direction; the last three are NaN without a force.

    Args:
        state: see `CONTACT_STATE`.
        relaxation: the finger's, see `Relaxation.packed`, which is advanced by dt.
        relaxation_stddev: standard deviation of that by forces whose onset is unknown (3,) [N].
        dt: time since the last force [s].
        errors: relative standard deviations, of the mechanics, in magnitude and direction alike, and of the material's
            modulus, which leaves the direction as it is.
        out: (7, 3).

    Returns:
        The magnitude and its standard deviation [N].
    """
    force, torque, stddev, torque_stddev, arm, undeformed, normal = out
    error, stiffness_error = errors
    state = state[()]
    modes, covariance = state.force_modes, state.covariance
    fit, before = measure_along(state.force, modes, covariance), _measure_length(state.force)
    relax_force(state.force, relaxation, dt, force)
    if before > 0.0 and np.isfinite(state.lateral_force):
        force[1] = state.lateral_force * _measure_length(force) / before
    magnitude = _measure_length(force)
    # the mechanics errs in the direction as in the magnitude
    wrong, leaked = (error * magnitude) ** 2, state.traction_stddev * state.traction_leak
    # a larger force is more inclined: where it is hardly known, its direction is not known either
    inclination = (UNSEEN_ALONG * fit**2 / max(magnitude + fit, 1e-300)) ** 2
    lateral = (state.lateral_stddev * magnitude) ** 2
    more = (wrong + leaked[0] ** 2 + state.unobserved_stddev**2, lateral, wrong + inclination + leaked[2] ** 2)
    along = (leaked * force).sum() / max(magnitude, 1e-300)
    for a in range(3):
        variance = more[a] + (stiffness_error * force[a]) ** 2 + relaxation_stddev[a] ** 2
        for i in range(3):
            for j in range(3):
                variance += modes[a, i] * covariance[i, j] * modes[a, j]
        stddev[a] = np.sqrt(variance)
        arm[a], undeformed[a] = state.pressure_point[a], state.pressure_location[a]
    arm[1] = undeformed[1] = state.y
    arm_stddev = (0.0, state.y_stddev, state.height_stddev)
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
    scaled, left = (stiffness_error * magnitude) ** 2, _measure_length(relaxation_stddev) ** 2
    across = max(stddev[0] ** 2 + stddev[2] ** 2 - fit**2 - wrong - scaled - left, 0.0)
    turned = (_CURVED * across / max(magnitude + fit, 1e-300)) ** 2
    return magnitude, np.sqrt(fit**2 + wrong + scaled + along**2 + state.unobserved_stddev**2 + left + turned)


@njit(**_OPTIONS)
def _measure_length(vector):
    """Return the length of a vector (3,)."""
    return np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
