"""Lateral position of the pressure on a jaw, and the lateral force, from the key points' motion along y.

A normal force N off the middle twists the finger, a lateral force bends it sideways,

    y_k = a_k y_c N + b_k (F_r + t N),    F_r = -F_x r,

with the location y_c of the pressure, the lateral traction ratio t, and what the normal force has along y because the
face rolls by the slope r. a and b are those of the linear jaw at rest: the mechanics of the jaw's plane know neither,
and both are small compared with bending, so that they are added to it. A finger that is bent by u(z) along x turns
about its own inclined axis, though: with the turn f(z) of its sections about z that goes with a and b,

    y(z) += int f'(s) (u(z) - u(s) - u'(s) (z - s)) ds.

y_c is expected where the object's mesh is nearest. Where the direction of gravity g is known, the lateral force t N is
w g_y + e, with this jaw's share w of the weight, and the force e of a support, which a turn or a lift leaves behind.
"""

from dataclasses import dataclass
from functools import cached_property
from math import hypot, inf, isfinite, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.filter.filter import solve_lower
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw
from finforce_ifea.jaw.mesh import VolumeMesh
from finforce_ifea.posture import WristMove
from finforce_ifea.tracking.contact_state import MIDDLE_STDDEV, ContactState

_OPTIONS = {"cache": True, "error_model": "numpy"}
_HEIGHTS = 13
# Distance of each force of the twisting pair from the middle, relative to half the width [-].
_ARM = 0.8
# Largest mesh [nodes]: of larger ones, only the plane is computed.
_MOST_NODES = 20_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Torsion:
    """Answers of the unloaded jaw at several heights of its inner face.

    Attributes:
        heights: (m,) [m], rising.
        half_width: of the inner face [m].
        by_moment: motions of the key points (m, K, 3) per moment about the line x = inner face, y = 0 [m/(N m)].
        by_force: the same per force along y there (m, K, 3) [m/N].
        roll: slope dx/dy of the face where the moment acts, per moment (m,) [1/(N m)].
    """

    heights: NDArray
    half_width: float
    by_moment: NDArray
    by_force: NDArray
    roll: NDArray

    def at(self, height: float) -> tuple[NDArray, NDArray, float]:
        """Return the motions by moment and by force (K, 3) each and the roll at a height [m]."""
        return _interpolate(self.packed, height)

    @cached_property
    def packed(self) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Heights, motions by moment and by force, and roll, for compiled code."""
        return self.heights, self.by_moment, self.by_force, self.roll


@njit(**_OPTIONS)
def _interpolate(torsion, height):
    """Return the motions by moment and by force (K, 3) each and the roll at a height [m]; see `Torsion.packed`."""
    (heights, moment, force, roll), low = torsion, 0
    while low < len(heights) - 2 and height >= heights[low + 1]:
        low += 1
    share = min(max((height - heights[low]) / (heights[low + 1] - heights[low]), 0.0), 1.0)
    moment = (1.0 - share) * moment[low] + share * moment[low + 1]
    force = (1.0 - share) * force[low] + share * force[low + 1]
    return moment, force, (1.0 - share) * roll[low] + share * roll[low + 1]


def _find_narrowest(jaw: Jaw, heights: NDArray, half: float) -> float:
    """Return the least half width [m] of the inner face at heights (n,) [m], `half` where it is the same all along."""
    if jaw.section is None or not jaw.section.taper.any():
        return half
    places = np.stack([[jaw.face.read(z), z] for z in heights])
    return 0.5 * float(jaw.section.read_width(places).min())


# Of the last two jaws, for later estimators.
_LAST: dict[tuple, Torsion | None] = {}


def measure_torsion(jaw: Jaw, mesh: VolumeMesh) -> Torsion | None:
    """Return the torsion and lateral bending of a jaw; None if it is no solid, or its mesh too large.

    Args:
        jaw: with its material and key points.
        mesh: of that jaw, undeformed.
    """
    side = "" if jaw.mesh_file is None else jaw.side  # a drawn finger is its own mirror image
    stiffness = jaw.material.young_modulus, jaw.material.poisson_ratio
    key = (jaw.digest, side, jaw.inner_face_x, *stiffness, len(mesh.nodes), jaw.keypoints.tobytes())
    if key not in _LAST:
        for last in list(_LAST)[:-1]:
            del _LAST[last]
        _LAST[key] = _solve_at_rest(jaw, mesh)
    return _LAST[key]


def _solve_at_rest(jaw: Jaw, mesh: VolumeMesh) -> Torsion | None:
    """Return what `measure_torsion` does, by the finger's model at rest."""
    is_solid = jaw.drawing is None or jaw.drawing.is_solid
    mesh = mesh if jaw.section is None else jaw.build_mesh("coarse")
    if not is_solid or len(mesh.nodes) > _MOST_NODES:
        return None
    model = SolidModel(mesh, jaw.material, symmetric=False)
    face = mesh.nodes[jaw.face.holds(mesh.nodes)]
    half, (low, high) = float(face[:, 1].max()), (face[:, 2].min(), face[:, 2].max())
    heights = np.linspace(low + 0.1 * (high - low), high - 0.05 * (high - low), _HEIGHTS)
    arm, rest = _ARM * _find_narrowest(jaw, heights, half), np.zeros(model.size)
    places = np.array([[jaw.face.read(z), y, z] for z in heights for y in (-arm, 0.0, arm)])
    if jaw.section is not None:
        places[:, 1] = jaw.section.place_across(places)
    probes = [model.attach(places[3 * row : 3 * row + 3], 1e-3) for row in range(_HEIGHTS)]
    twist, across = np.zeros((3, 3)), np.zeros((3, 3))
    twist[0, 0], twist[2, 0], across[1, 1] = 0.5 / arm, -0.5 / arm, 1.0
    loads = [model.load(probe, rest, force) for probe in probes for force in (twist, across)]
    steps = model.factorise(model.linearize(rest).tangent).solve(np.stack(loads, axis=1))
    roll = [
        (moved[2, 0] - moved[0, 0]) / (2.0 * arm)
        for moved in (model.project(probe, rest, steps[:, [2 * row]])[:, :, 0] for row, probe in enumerate(probes))
    ]
    by = np.moveaxis(model.project(model.attach(jaw.keypoints, KEYPOINT_DISTANCE), rest, steps), 2, 0)
    return Torsion(
        heights=heights,
        half_width=half,
        by_moment=np.ascontiguousarray(by[::2]),
        by_force=np.ascontiguousarray(by[1::2]),
        roll=np.array(roll),
    )


# Standard deviation of the pressure centre, relative to that of an even pressure over what touches [-].
_EVEN = 0.4
# Least further factor on it where the whole width of the finger touches [-].
_WIDE = 0.15
# Inverse of the core of a rectangular section, relative to half its width [-].
_CORE = 3.0
# Correlation time of the pressure centre [s].
_LOCATION_TIME = 10.0
# Standard deviation of the lateral traction ratio [-].
_TRACTION = 0.1
# Correlation time of that ratio [s].
_TRACTION_TIME = 60.0
# Standard deviation of that ratio after a lift, by a weight that the jaws turn [-].
_WEIGHT = 0.3
# Correlation time of that ratio [s].
_WEIGHT_TIME = 1.0
_LIFTED_RATIO = _WEIGHT**2 + _TRACTION**2, _WEIGHT_TIME
# Standard deviation of this jaw's part of the weight, relative to the normal force [-].
_SHARE = 0.3
# Correlation time of that part [s].
_SHARE_TIME = 30.0
# Standard deviation of the lateral traction ratio beside a known weight [-].
_REST = 0.05
# Log prior odds of a lift in an image.
_LIFTED = np.log(1e-4)
# The same where the direction of gravity is known.
_LIFTED_ALONG = np.log(1e-2)
# Log likelihood ratio of a lift below which the test starts anew.
_UNLIKELY = -3.0
# Standard deviation of the ratio by the linear model of the jaw [-].
_NONLINEAR = 0.04
# Ratio of which half is reported [sigma]: a soft threshold.
_CLEAR = 3.0
# Force below which the filter starts anew [N].
_LEAST_FORCE = 0.3
# Standard deviation of the mechanics' part of a key point's offset along y [m].
_FLOOR = 0.02e-3
# Correlation length of that error [m].
_OFFSET_LENGTH = 10e-3
# Correlation time of that error [s].
_OFFSET_TIME = 60.0
# Relative error of the motion of a bent finger by a rotation [-].
_TURN_ERROR = 0.5
# Distance from the middle plane from which a key point shows the rotation of its section [m].
_LEAST_ARM = 1e-3
# Distance along the finger up to which two key points are of one section [m].
_LEAST_RISE = 2e-3


class _Estimate(NamedTuple):
    """Mean (3 + K,) and covariance (3 + K, 3 + K) of the state of `LateralLoad`."""

    x: NDArray
    P: NDArray


class LateralLoad:
    """Kalman filter of the lateral load of one finger.

    Its state is the location of the pressure [m], the lateral traction ratio [-], an offset along y for each key point
    [m], and the jaw's share of the weight [N]. Two hypotheses differ in the ratio: it stays as it was, or the jaws have
    lifted a weight. Their likelihoods decide, or a move that leaves a support behind.

    Attributes:
        motions: of the key points by what acts laterally (K, 3) [m]; zero where nothing does.
        load: location along y [m], its standard deviation [m], lateral force [N], and the standard deviation of that
            as a share of all force (4,).
    """

    def __init__(self, torsion: Torsion | None, count: int, traction: float, *, may_be_held: bool) -> None:
        """Keep the response of the jaw with `count` key points, None where nothing is known of it.

        `traction` is the standard deviation of the lateral traction ratio until something is seen; `may_be_held` says
        that the jaws may lift a weight.
        """
        self._torsion, self._count, self._traction, self._may_be_held = torsion, count, traction, may_be_held
        self._expected = (0.0, MIDDLE_STDDEV)
        self.reset()

    def reset(self) -> None:
        """Reset the filter; the expected position of the object stays."""
        self._known: _Estimate | None = None
        self._depth, self._is_lifted, self._parted, self._largest = 0.0, False, 0.0, 0.0
        self.motions = np.zeros((self._count, 3))
        self.load = np.array([*self._expected, 0.0, self._traction])

    def expect(self, location: float, stddev: float) -> None:
        """Set the lateral position of the object's nearest part [m], and the standard deviation of its width."""
        half = self._torsion.half_width if self._torsion else abs(location)
        narrow = max(_WIDE, 1.0 - 3.0 * (stddev / half) ** 2) if half > 0.0 else 1.0
        # beyond a third of the half width, the core of a section, an eccentric pressure leaves the other edge
        uneven = _EVEN + (1.0 - _EVEN) * min(_CORE * abs(location) / half, 1.0) if half > 0.0 else 1.0
        self._expected = min(max(float(location), -half), half), uneven * narrow * float(stddev)

    def weigh(self, force: float) -> tuple[float, float]:
        """Return this jaw's part of the weight, and its standard deviation [N], for the force on the jaw [N]."""
        if self._known is None or self._largest == 0.0:
            return 0.0, _SHARE * force
        return float(self._known.x[-1]), sqrt(max(self._known.P[-1, -1], 0.0))

    def update(
        self, motions: NDArray, bend: NDArray, points: NDArray, state: ContactState, dt: float, move: WristMove | None
    ) -> None:
        """Update with the motions of the key points along y in an image.

        Args:
            motions: measured along y (K,) [m], NaN where unused.
            bend: of the model along x (K,) [m].
            points: see `KEYPOINT`.
            state: see `CONTACT_STATE`.
            dt: time since the last image [s].
            move: of a jaw that may lift a weight; None where its posture is not known.
        """
        torsion, force, height = self._torsion, state["force"], float(state["pressure_location"][2])
        normal = hypot(force[0], force[2])
        if torsion is None or not normal > _LEAST_FORCE or not isfinite(height):
            self.reset()
            return
        place = height, normal, force[0], self.load[0]
        measured, (by_moment, by_force, rolled) = _observe(points, motions, bend, torsion.packed, place)
        moved, self._depth = abs(float(state["depth"]) - self._depth), float(state["depth"])
        self._follow(measured, points["offset_variance"], (moved, dt), move, normal)
        x, P, half = *self._known, torsion.half_width
        location, stddev = min(max(float(x[0]), -half), half), hypot(sqrt(P[1, 1]), _NONLINEAR)
        # unless a weight was lifted, chance and what the linear jaw errs by are no force
        clear = inf if self._is_lifted else (float(x[1]) / (_CLEAR * stddev)) ** 4
        total = rolled + float(x[1]) * normal / (1.0 + 1.0 / max(clear, 1e-300))
        self.load[:] = location, sqrt(P[0, 0]), total, stddev
        self.motions = by_moment * (-location * force[0]) + by_force * total

    def _follow(
        self,
        measured: tuple[NDArray, ...],
        offsets: NDArray,
        passed: tuple[float, float],
        move: WristMove | None,
        normal: float,
    ) -> None:
        """Update both hypotheses with an image, and decide between them.

        Args:
            measured: see `_observe`.
            offsets: stationary variance of each key point's offset (K,) [m^2].
            passed: motion of the object in depth [m] and time [s] since the last image.
            move: see `update`.
            normal: force [N].
        """
        if self._known is None:
            self._known = self._candidate = _begin(self._expected, offsets)
            self._odds = 0.0
        light, lifted = (*self._expected, _TRACTION**2, _TRACTION_TIME), (*self._expected, *_LIFTED_RATIO)
        prior, weight = _LIFTED, (0.0, 0.0, 0.0, normal, 0.0, 0.0)
        if move is not None:
            self._parted += move.parting
            self._is_lifted |= self._parted > 1.0
            lifted, prior, before = (*self._expected, _REST**2, _WEIGHT_TIME), _LIFTED_ALONG, self._largest
            self._largest = max((_SHARE * normal) ** 2, before)
            told = float(move.before[1]), float(move.now[1]), move.parting
            weight = (*told, normal, self._largest, self._largest - before)
        if self._is_lifted:
            self._known = _step(tuple(self._known), lifted, offsets, passed, measured, weight)[0]
            return
        self._known, likely = _step(tuple(self._known), light, offsets, passed, measured, weight)
        if not self._may_be_held:
            return
        self._candidate, other = _step(tuple(self._candidate), lifted, offsets, passed, measured, weight)
        self._odds += other - likely
        if self._odds < _UNLIKELY:
            self._candidate, self._odds = self._known, 0.0
        elif self._odds + prior > 0.0:
            self._known, self._is_lifted = self._candidate, True


@njit(**_OPTIONS)
def _observe(points, motions, bend, torsion, place):
    """Return what the key points show across the finger.

    Args:
        points: see `KEYPOINT` (K,).
        motions: measured along y (K,) [m], NaN where unused.
        bend: of the model along x (K,) [m].
        torsion: see `Torsion.packed`.
        place: height of the pressure [m], normal force [N], force along x [N], and the location so far [m].

    Returns:
        Numbers of the key points that are seen (m,), derivatives by location and ratio (m, 2), motions less that by the
        roll (m,) [m], and their variances (m,) [m^2]; with them the motions by moment and by force (K, 3) at that
        height, and the force along y by the roll of the face [N].
    """
    height, normal, ahead, location = place
    by_moment, by_force, roll = _interpolate(torsion, height)
    rolled = ahead**2 * roll * location  # -F_x r, with r = roll (-y F_x)
    turns = turn_bent(by_moment[:, 0], points.rest, bend)
    aside = turn_bent(by_force[:, 0], points.rest, bend)
    count, m = len(points), 0
    seen, H, z, R = np.empty(count, np.int64), np.empty((count, 2)), np.empty(count), np.empty(count)
    for k in range(count):
        if np.isfinite(motions[k]) and points[k].weight > 0.0:
            across = by_force[k, 1] + aside[k]
            seen[m], z[m] = k, motions[k] - across * rolled
            H[m, 0], H[m, 1] = normal * (by_moment[k, 1] + turns[k]), normal * across
            R[m] = points[k].width_variance / (points[k].noise_ratio * max(points[k].weight, 1e-9))
            R[m] += (_TURN_ERROR * turns[k] * location * normal) ** 2
            m += 1
    return (seen[:m], H[:m], z[:m], R[:m]), (by_moment, by_force, rolled)


@njit(**_OPTIONS)
def _begin(expected, offsets):
    """Return the estimate before the first image; see `_step` for the arguments."""
    x, V = np.zeros(3 + len(offsets)), np.empty(3 + len(offsets))
    x[0] = expected[0]
    V[0], V[1], V[2:-1], V[-1] = expected[1] ** 2, _TRACTION**2, offsets + _FLOOR**2, 0.0
    return _Estimate(x, np.diag(V))


@njit(**_OPTIONS)
def _step(estimate, expected, offsets, passed, measured, weight):
    """Return the estimate after an image, and the logarithm of its likelihood; see `LateralLoad`.

    Args:
        estimate: before it, a plain tuple.
        expected: location [m], its standard deviation [m], variance of the ratio, and time over which it lasts [s].
        offsets: stationary variance of each key point's offset (K,) [m^2].
        passed: motion [m] and time [s] since the last image.
        measured: see `_observe`.
        weight: gravity along y in the last image and in this one [-], see `WristMove.parting`, normal force [N],
            variance of the share of the weight, and by how much that has grown [N^2].
    """
    (moved, dt), (seen, H, z, R), estimate = passed, measured, _Estimate(*estimate)
    (location, stddev, variance, time), (before, now, parting, normal, carried, more) = expected, weight
    n, m, kept = len(estimate.x), len(seen), np.exp(-moved / _OFFSET_LENGTH - dt / _OFFSET_TIME)
    rates, left = (np.exp(-dt / _LOCATION_TIME), np.exp(-dt / time)), np.exp(-parting)
    x, P, a = estimate.x.copy(), estimate.P.copy(), np.empty(n)
    w = n - 1
    for i in range(w):
        a[i] = rates[i] if i < 2 else kept
    a[1] *= left
    a[w] = np.exp(-dt / _SHARE_TIME)
    for i in range(n):
        mean = location if i == 0 else 0.0
        x[i] = mean + a[i] * (x[i] - mean)
        for j in range(n):
            P[i, j] *= a[i] * a[j]
    pull = (now - a[1] * before) / (a[w] * normal)
    x[1] += pull * x[w]
    P[1] += pull * P[w]
    P[:, 1] += pull * P[:, w]
    P[0, 0] += (1.0 - a[0] ** 2) * stddev**2
    P[1, 1] += (1.0 - rates[1] ** 2) * variance + (1.0 - left**2) * _REST**2
    for i in range(2, w):
        P[i, i] += (1.0 - a[i] ** 2) * (offsets[i - 2] + _FLOOR**2)
    P[w, w] += (1.0 - a[w] ** 2) * carried + more
    HP, nu, S = np.empty((m, n)), np.empty((m, 1)), np.empty((m, m))
    for i in range(m):
        k = 2 + seen[i]
        nu[i, 0] = z[i] - H[i, 0] * x[0] - H[i, 1] * x[1] - x[k]
        for j in range(n):
            HP[i, j] = H[i, 0] * P[0, j] + H[i, 1] * P[1, j] + P[k, j]
    for i in range(m):
        for j in range(m):
            S[i, j] = HP[i, 0] * H[j, 0] + HP[i, 1] * H[j, 1] + HP[i, 2 + seen[j]]
        S[i, i] += R[i]
    L = np.linalg.cholesky(S)
    A, white = solve_lower(L, HP), solve_lower(L, nu)
    A_T = np.ascontiguousarray(A.T)
    likely = -0.5 * (white**2).sum() - np.log(np.diag(L)).sum()
    return _Estimate(x + np.dot(A_T, white)[:, 0], P - np.dot(A_T, A)), likely


@njit(**_OPTIONS)
def turn_bent(along_x, rest, bend):
    """Return the motion of a bent finger along y by a rotation of its sections (K,), see the module.

    Args:
        along_x: motions of the key points by the turn (K,).
        rest: of the undeformed finger (K, 3) [m].
        bend: motions along x (K,) [m].
    """
    count = len(rest)
    steps, turned, moved = np.zeros((count, 4)), np.zeros(count), np.zeros(count)
    for k in range(count):
        if abs(rest[k, 1]) > _LEAST_ARM:
            turned[k] = -along_x[k] / rest[k, 1]
    z, u, f, used = 0.0, 0.0, 0.0, 0
    for k in np.argsort(rest[:, 2], kind="mergesort"):
        rise = rest[k, 2] - z
        if rise > _LEAST_RISE:
            steps[used] = z + 0.5 * rise, 0.5 * (u + bend[k]), (bend[k] - u) / rise, turned[k] - f
            z, u, f, used = rest[k, 2], bend[k], turned[k], used + 1
        for j in range(used):
            middle, own, slope, turn = steps[j]
            moved[k] += turn * (bend[k] - own - slope * (rest[k, 2] - middle))
    return moved
