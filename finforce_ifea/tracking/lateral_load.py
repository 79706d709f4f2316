"""Where along the width a jaw is pressed, and the lateral force on it, by the key points' motion along y.

A normal force N off the middle twists the finger, a lateral force bends it sideways,

    y_k = a_k y_c N + b_k (F_r + t N),    F_r = -F_x r,

with the location y_c of the pressure, the lateral traction ratio t, and what the normal force has along y because the
face rolls by the slope r. a and b are those of the linear jaw at rest: the mechanics of the jaw's plane know neither,
and both are small compared with bending, so that they are added to it. A finger that is bent by u(z) along x turns
about its own inclined axis, though: with the turn f(z) of its sections about z that goes with a and b,

    y(z) += int f'(s) (u(z) - u(s) - u'(s) (z - s)) ds.

y_c is expected where the object's mesh is nearest.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw
from finforce_ifea.jaw.mesh import VolumeMesh
from finforce_ifea.tracking.contact_state import MIDDLE_STDDEV, ContactState

_OPTIONS = {"cache": True, "error_model": "numpy"}
_HEIGHTS = 13
# The pair of forces that twists stands so far from the middle, as a share of half the width.
_ARM = 0.8
# Larger meshes are not worth the time: of theirs only the plane is known.
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
        return _interpolate(self.heights, (self.by_moment, self.by_force), self.roll, height)


@njit(**_OPTIONS)
def _interpolate(heights, motions, roll, height):
    """Return both motions (m, K, 3) and the roll (m,) between rising heights (m,) [m], those at the ends beyond."""
    low = 0
    while low < len(heights) - 2 and height >= heights[low + 1]:
        low += 1
    share = min(max((height - heights[low]) / (heights[low + 1] - heights[low]), 0.0), 1.0)
    moment, force = motions
    moment = (1.0 - share) * moment[low] + share * moment[low + 1]
    force = (1.0 - share) * force[low] + share * force[low + 1]
    return moment, force, (1.0 - share) * roll[low] + share * roll[low + 1]


def _find_narrowest(jaw: Jaw, heights: NDArray, half: float) -> float:
    """Return the least half width [m] of the inner face at heights (n,) [m], `half` where it is the same all along."""
    if jaw.section is None or not jaw.section.taper.any():
        return half
    places = np.stack([[jaw.face.read(z), z] for z in heights])
    return 0.5 * float(jaw.section.read_width(places).min())


def measure_torsion(jaw: Jaw, mesh: VolumeMesh) -> Torsion | None:
    """Return how a jaw twists and gives way sideways; None where it is no solid, or its mesh too large.

    Args:
        jaw: with its material and key points.
        mesh: of that jaw, undeformed.
    """
    side = "" if jaw.mesh_file is None else jaw.side  # a drawn finger is its own mirror image
    stiffness = jaw.material.young_modulus, jaw.material.poisson_ratio
    key = (jaw.digest, side, jaw.inner_face_x, *stiffness, len(mesh.nodes))
    if key not in _LAST:
        _LAST.clear()
        _LAST[key] = _answer_at_rest(jaw, mesh)
    answers = _LAST[key]
    if answers is None:
        return None
    model, rest = answers.model, np.zeros(answers.model.size)
    by = np.moveaxis(model.project(model.attach(jaw.keypoints, KEYPOINT_DISTANCE), rest, answers.steps), 2, 0)
    return Torsion(
        heights=answers.heights,
        half_width=answers.half_width,
        by_moment=np.ascontiguousarray(by[::2]),
        by_force=np.ascontiguousarray(by[1::2]),
        roll=answers.roll,
    )


class _Answers(NamedTuple):
    """How a model at rest moves, steps (size, 2 m), by a moment and a lateral force at each height; see `Torsion`."""

    model: SolidModel
    steps: NDArray
    heights: NDArray
    half_width: float
    roll: NDArray


# Of the finger that was measured last, whose other jaw and later estimators need not wait for it.
_LAST: dict[tuple, _Answers | None] = {}


def _answer_at_rest(jaw: Jaw, mesh: VolumeMesh) -> _Answers | None:
    """Return the answers of a jaw; None where it is no solid, or its mesh too large."""
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
    return _Answers(model=model, steps=steps, heights=heights, half_width=half, roll=np.array(roll))


# Pressure is spread evenly: its centre strays from the middle by this share of what touches, and by less where that is
# the whole width of the finger: by what is left of a square, at least the share below. Standard deviations of the
# traction ratio, and of what the linear jaw makes of it [-].
_WIDE = 0.15
_EVEN, _TRACTION, _NONLINEAR = 0.4, 0.1, 0.04
# One over the core of a rectangular section, as a share of half its width.
_CORE = 3.0
# A ratio of so many standard deviations is believed by half; less is next to nothing.
_CLEAR = 3.0
# Images averaged, and the force below which nothing is learnt [N].
_MEMORY, _LEAST_FORCE = 45.0, 0.3
_FLOOR = 0.02e-3
# Error of what a turn moves a bent finger, as a share of it.
_TURN_ERROR = 0.5
# A key point nearer to the middle plane does not show how its section turns, and one so little above another is of the
# same section [m].
_LEAST_ARM, _LEAST_RISE = 1e-3, 2e-3
# Of a key point over the last images: residual along y [m], its derivatives by y_c and t, and images that count.
_MEANS = np.dtype([("residual", float), ("modes", float, 2), ("count", float)])


class LateralLoad:
    """Averages what the key points show across one finger.

    Attributes:
        motions: of the key points by what acts laterally (K, 3) [m]; zero where nothing does.
        by_force: of the key points by a lateral force (K, 3) [m/N], where the last one pressed; zero before.
        by_moment: the same by a moment about the finger (K, 3) [m/(N m)].
        load: location along y [m], its standard deviation [m], lateral force [N], and the standard deviation of that
            as a share of all force (4,).
    """

    def __init__(self, torsion: Torsion | None, count: int, traction: float) -> None:
        """Keep the response of the jaw with `count` key points, None where nothing is known of it.

        `traction` is the standard deviation of the lateral traction ratio until something is seen.
        """
        self._torsion, self._count, self._traction = torsion, count, traction
        self._expected = (0.0, MIDDLE_STDDEV)
        self.reset()

    @property
    def half_width(self) -> float:
        """Of the inner face [m]; 0 where unknown."""
        return self._torsion.half_width if self._torsion else 0.0

    def reset(self) -> None:
        """Forget what was seen; where the object is expected stays."""
        self._means = np.zeros(self._count, _MEANS)
        self.motions, self.by_force, self.by_moment = (np.zeros((self._count, 3)) for _ in range(3))
        self.load = np.array([*self._expected, 0.0, self._traction])

    def expect(self, location: float, stddev: float) -> None:
        """Take where along y the object is nearest [m], and how wide it is there."""
        half = self._torsion.half_width if self._torsion else abs(location)
        narrow = max(_WIDE, 1.0 - 3.0 * (stddev / half) ** 2) if half > 0.0 else 1.0
        # beyond a third of the half width, the core of a section, an eccentric pressure leaves the other edge
        uneven = _EVEN + (1.0 - _EVEN) * min(_CORE * abs(location) / half, 1.0) if half > 0.0 else 1.0
        self._expected = min(max(float(location), -half), half), uneven * narrow * float(stddev)

    def update(self, motions: NDArray, bend: NDArray, points: NDArray, state: ContactState) -> None:
        """Take the key points' motions along y (K,) [m], NaN where unused, with their weights and the contact.

        Args:
            motions: measured along y (K,) [m].
            bend: of the model along x (K,) [m].
            points: see `KEYPOINT`.
            state: see `CONTACT_STATE`.
        """
        torsion, force, height = self._torsion, state["force"], float(state["pressure_location"][2])
        if torsion is None or not np.hypot(force[0], force[2]) > _LEAST_FORCE or not np.isfinite(height):
            self.reset()
            return
        self.by_moment, self.by_force, roll = torsion.at(height)
        turned = np.stack([turn_bent(each[:, 0], points["rest"], bend) for each in (self.by_moment, self.by_force)])
        response = self.by_moment, self.by_force, turned, roll, torsion.half_width
        self.motions = _update(self._means, motions, points, force, response, self._expected, self.load)


@njit(**_OPTIONS)
def turn_bent(along_x, rest, bend):
    """Return what a turn of the sections moves a bent finger along y (K,), see the module.

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


@njit(**_OPTIONS)
def _update(means, motions, points, force, response, expected, load):
    """Add an image to the means; update the load (4,) and return the motions (K, 3) that it causes."""
    by_moment, by_force, turned, roll, half_width = response
    normal = np.hypot(force[0], force[2])
    rolled = force[0] ** 2 * roll * load[0]  # -F_x r, with r = roll (-y F_x)
    A = np.array([[1.0 / expected[1] ** 2, 0.0], [0.0, 1.0 / _TRACTION**2]])
    g = np.array([expected[0] / expected[1] ** 2, 0.0])
    row = np.empty(2)
    for k in range(len(motions)):
        point, mean = points[k], means[k]
        share = point.weight if np.isfinite(motions[k]) else 0.0
        gain = share / (min(mean.count, _MEMORY) + 1.0)
        mean.count = min(mean.count * (1.0 - 1.0 / _MEMORY) + share, _MEMORY)
        if share > 0.0:
            mean.residual += gain * (motions[k] - (by_force[k, 1] + turned[1, k]) * rolled - mean.residual)
            mean.modes[0] += gain * (normal * (by_moment[k, 1] + turned[0, k]) - mean.modes[0])
            mean.modes[1] += gain * (normal * (by_force[k, 1] + turned[1, k]) - mean.modes[1])
        if mean.count <= 0.5:
            continue
        variance = point.width_variance / max(mean.count, 1.0) + point.offset_variance + _FLOOR**2
        weight = 1.0 / (variance + (_TURN_ERROR * turned[0, k] * load[0] * normal) ** 2)
        row[0], row[1] = mean.modes[0], mean.modes[1]
        for i in range(2):
            g[i] += weight * row[i] * mean.residual
            for j in range(2):
                A[i, j] += weight * row[i] * row[j]
    det = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    location, ratio = (A[1, 1] * g[0] - A[0, 1] * g[1]) / det, (A[0, 0] * g[1] - A[1, 0] * g[0]) / det
    location = min(max(location, -half_width), half_width)
    # chance and what the linear jaw errs by are no force
    stddev = np.sqrt(A[0, 0] / det + _NONLINEAR**2)
    clear = (ratio / (_CLEAR * stddev)) ** 4
    total = rolled + ratio * clear / (1.0 + clear) * normal
    load[0], load[1], load[2], load[3] = location, np.sqrt(A[1, 1] / det), total, stddev
    return by_moment * (-location * force[0]) + by_force * total
