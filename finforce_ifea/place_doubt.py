"""How sure a place is: its covariance's condition, another contact, points that err together; knows no mechanics."""

import numpy as np
from numba import njit

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Beyond this many of its standard deviations the prior of a place lets go.
PRIOR_REACH = 4.0
# A height that is given is that of another contact once in so many times, and then anywhere within this [m].
_MISTAKEN = 0.01
_ANYWHERE = 0.03


@njit(**_OPTIONS)
def invert_symmetric(A):
    """Returns the inverse of a symmetric 3 x 3 matrix."""
    c00 = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
    c01 = A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
    c02 = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    det = A[0, 0] * c00 + A[0, 1] * c01 + A[0, 2] * c02
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = c00, c01, c02
    out[1, 1] = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]
    out[1, 2] = A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]
    out[2, 2] = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return out / det


@njit(**_OPTIONS)
def measure_condition(covariance):
    """Returns the condition number of a covariance (3, 3) scaled to a unit diagonal, by its eigenvalues in closed form.

    With C = 1 + O, O without diagonal: l = 1 + 2 p cos(t + 2 k pi / 3), p = sqrt(|O|^2 / 6), cos 3 t = det O / (2 p^3).
    """
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    a, b = covariance[0, 1] / scale[0] / scale[1], covariance[0, 2] / scale[0] / scale[2]
    c = covariance[1, 2] / scale[1] / scale[2]
    p = np.sqrt((a * a + b * b + c * c) / 3.0)
    if not p > 1e-12:
        return 1.0
    angle = np.arccos(min(max(a * b * c / p**3, -1.0), 1.0)) / 3.0
    largest, least = 1.0 + 2.0 * p * np.cos(angle), 1.0 + 2.0 * p * np.cos(angle + 2.0 * np.pi / 3.0)
    return largest / max(least, 1e-16)


@njit(**_OPTIONS)
def doubt_place(away, spread, prior_variance, offset):
    """Returns the probability that a contact is not where it was said to be, and what that adds to its variance [m^2].

    The key points alone have it D = away from there, with the variance s^2 = spread. It is another contact, N(0, R^2),
    with the probability p:

        p / (1 - p) = p0 N(D; 0, v + s^2 + R^2) / N(D; 0, v + s^2) / (1 - p0).

    What exceeds p0 of it adds the distance of that contact from the place that was found, `offset` from the given one.

    Args:
        away: D [m].
        spread: s^2 [m^2].
        prior_variance: v, of the given place [m^2].
        offset: of the place that was found [m].
    """
    near, far = prior_variance + spread, prior_variance + spread + _ANYWHERE**2
    odds = 0.5 * away**2 * (1.0 / near - 1.0 / far) + 0.5 * np.log(near / far) + np.log(_MISTAKEN / (1.0 - _MISTAKEN))
    mistaken = 1.0 / (1.0 + np.exp(-min(max(odds, -50.0), 50.0)))
    shrunk = _ANYWHERE**2 / (_ANYWHERE**2 + spread)
    variance = max(0.0, mistaken - _MISTAKEN) * ((shrunk * away - offset) ** 2 + shrunk * spread)
    return mistaken, variance


@njit(**_OPTIONS)
def doubt_height(hessian, gradient, offset, prior_variance):
    """Returns the height that the key points alone ask for [m], the probability of a mistake, and its variance [m^2].

    Args:
        hessian: of the log posterior (3, 3).
        gradient: of the same (3,).
        offset: of the reference height from the expected one [m].
        prior_variance: of the height [m^2].
    """
    pull = 1.0 / (prior_variance + (offset / PRIOR_REACH) ** 2)
    data, slope = hessian.copy(), gradient.copy()
    # a millionth is left of the prior, for where the key points tell nothing
    data[2, 2] -= (1.0 - 1e-6) * pull
    slope[2] += (1.0 - 1e-6) * pull * offset
    covariance = invert_symmetric(data)
    away, spread = offset + (covariance[2] * slope).sum(), max(covariance[2, 2], 0.0)
    mistaken, variance = doubt_place(away, spread, prior_variance, offset)
    return away, mistaken, variance


@njit(**_OPTIONS)
def find_rift(data, deeper, information):
    """Returns how far the depth would move if points that are half believed were not believed at all [m].

    With w the weights, h the motions by depth, r what is left of the residuals and I the information,

        rift = sum_k w_k (1 - w_k) h_k^T N_k^-1 r_k / I.

    Chance cancels in it; points that are wrong together do not.

    Args:
        data: see `Residuals`.
        deeper: change of the depth since the residuals [m].
        information: on the depth [1/m^2].
    """
    rift = 0.0
    for k in range(len(data.weights)):
        n00, n11, n01 = data.noise[k, 0, 0], data.noise[k, 1, 1], data.noise[k, 0, 1]
        h0, h1 = data.modes[k, 0, 0], data.modes[k, 1, 0]
        r0, r1 = data.r[k, 0] - h0 * deeper, data.r[k, 1] - h1 * deeper
        score = (h0 * (n11 * r0 - n01 * r1) + h1 * (n00 * r1 - n01 * r0)) / (n00 * n11 - n01 * n01)
        rift += data.weights[k] * (1.0 - data.weights[k]) * score
    return rift / information
