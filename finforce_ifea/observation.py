"""Inputs and outputs of an estimator: key points, the contact or the object's outline, the solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce.errors import ObservationError
from finforce.messages import NOTHING_SHARED, SharedStddev, check_stddev
from finforce_ifea.errors import ContactError
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.posture import WristPosture, check_posture

TRUSTED = ("ok", "unloaded")
# Standard deviations of a force from which it shows that the object touches: on bench recordings it does in 0 to 3 % of
# the images of an unloaded jaw.
_TOUCHING = 0.5
_SAME_IMAGE = 0.5e-3  # [s] between two stamps within which one image came twice
_SHORTEST_PERIOD = 1e-3  # [s] between three images in a row: no RGB-D camera takes 1000 a second
_LONGEST_PERIOD = 5.0  # [s] between three images in a row: rarer ones show no grasp
_USUAL_PERIOD = 1 / 30  # [s] between images, by which the unit of other stamps is guessed
_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}  # [s]
# Maximum coordinate of a key point [m]: fingers are 0.25 m long at most.
_FARTHEST = 1.0
# Maximum capture time [s] since 1970: the year 5138. Milliseconds since 1970 are ten times as many.
_LATEST = 1e11
# Distance in front of the undeformed face from which an object is out of reach [m].
OUT_OF_REACH = 10e-3
# Allowance for the uncertainty of its position [sigma].
_SIGMAS = 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """The key points of one image.

    Attributes:
        stamp: image capture time [s].
        points: (K, 3) [m], jaw frame; NaN where there is no depth.
        likelihood: (K,) in [0, 1]; None for 1 where there is a point and 0 where it is NaN.
        stddev: (K, 3) standard deviation of each point [m] along the axes of the jaw frame, above zero where there is a
            point; None if the detector states none.
        shared: standard deviations of additional errors that all points of the image have in common.
        posture: of the jaw; None if unknown. With it, turns and lifts tell whether only the jaws hold the object, and
            turns its weight across the fingers.
    """

    stamp: float
    points: NDArray
    likelihood: NDArray | None = None
    stddev: NDArray | None = None
    shared: SharedStddev = NOTHING_SHARED
    posture: WristPosture | None = None

    def __post_init__(self) -> None:
        if self.likelihood is None:
            seen = np.isfinite(np.asarray(self.points, dtype=float)).all(axis=-1)
            object.__setattr__(self, "likelihood", seen.astype(float))


@dataclass(frozen=True, kw_only=True, eq=False)
class Contact:
    """Contact of the object with the jaw.

    Attributes:
        points: (n, 3) [m], on the undeformed inner surface.
        weights: (n,) fractions of the force.
        touching: True if object and jaw intersect; None if unknown.
        free: True if the points are those of first touch, from which the solver tracks the contact.
        outline: outline of the object, whose position the solver estimates together with the force. It has priority
            over the points.
    """

    points: NDArray
    weights: NDArray
    touching: bool | None = None
    free: bool = False
    outline: ObjectOutline | None = None

    @classmethod
    def fixed(cls, jaw: Jaw, z: float) -> Contact:
        """Return the contact of an object that first touches the jaw at height z [m].

        Raises:
            ContactError: The height is not among those at which the jaw can be touched, see `Jaw.contact_range`.
        """
        low, high = jaw.contact_range
        if not low <= z <= high:
            raise ContactError(
                f"contact height {1e3 * z:g} mm, expected {1e3 * low:g} to {1e3 * high:g} mm on the jaw {jaw.name!r}"
            )
        return cls(points=np.array([[jaw.face.read(z), 0.0, z]]), weights=np.ones(1), free=True)


def is_out_of_reach(contact: Contact, face_x: float) -> bool:
    """Return True if a contact's outline is in front of a face x = face_x [m] by over `OUT_OF_REACH` and 3 sigma."""
    outline = contact.outline
    if outline is None or contact.touching is not False:
        return False
    return outline.nearest - face_x > OUT_OF_REACH + _SIGMAS * float(outline.stddev[0])


class Solution(NamedTuple):
    """One estimate and its quality. Only a trusted one may be published.

    Attributes:
        stamp: image capture time [s].
        status: "ok", "unloaded", "waiting", "no_contact", "not_enough_points", "unobservable" or "diverged".
        message: explanation for the user.
        force: (3,) force that the object applies to the jaw [N], jaw frame; zero unless trusted.
        torque: (3,) torque about the origin of the jaw frame [N m].
        force_stddev: (3,) standard deviation of the force [N].
        torque_stddev: (3,) standard deviation of the torque [N m].
        magnitude_stddev: standard deviation of the force's magnitude [N].
        contact_point: (3,) [m], pressure centre on the deformed surface; NaN without contact.
        contact_location: (3,) [m], the same point on the undeformed surface; NaN without contact.
        normal: (3,) direction of the force; NaN without contact.
        residual: weighted root mean square of the residuals of the used key points [m].
        kkt: scaled violation of the optimality conditions by the returned force.
        keypoints_used: (K,) bool.
        iterations: Newton iterations for this image.
        converged: True if the last iteration changed the result by less than the tolerance.
    """

    stamp: float
    status: str
    message: str
    force: NDArray
    torque: NDArray
    force_stddev: NDArray
    torque_stddev: NDArray
    magnitude_stddev: float
    contact_point: NDArray
    contact_location: NDArray
    normal: NDArray
    residual: float
    kkt: float
    keypoints_used: NDArray
    iterations: int
    converged: bool

    @property
    def trusted(self) -> bool:
        """True if a wrench may be published."""
        return self.status in TRUSTED

    @property
    def touching(self) -> bool:
        """True if the object touches, as far as that can be trusted."""
        return self.trusted and bool(is_touch(np.linalg.norm(self.force), self.magnitude_stddev))


def is_touch(force: NDArray | float, stddev: NDArray | float) -> NDArray | bool:
    """Return whether the magnitudes of forces [N] with their standard deviations [N] show that an object touches."""
    return force > _TOUCHING * stddev


def blank_solution(stamp: float, status: str, message: str, used: NDArray, iterations: int = 0) -> Solution:
    """Return a solution without force, for whatever is not a contact."""
    zero, unknown = np.zeros(3), np.full(3, np.nan)
    return Solution(
        stamp=stamp,
        status=status,
        message=message,
        force=zero,
        torque=zero,
        force_stddev=zero,
        torque_stddev=zero,
        magnitude_stddev=0.0,
        contact_point=unknown,
        contact_location=unknown,
        normal=unknown,
        residual=float("nan"),
        kkt=float("nan"),
        keypoints_used=used,
        iterations=iterations,
        converged=False,
    )


def check_observation(observation: Observation, count: int, last_stamp: float | None = None) -> None:
    """Refuse what cannot be an image's key points.

    Raises:
        ObservationError: Wrong shapes, infinite values, a likelihood outside [0, 1], a standard deviation that is none,
            a posture that is none, stamps that do not rise.
    """
    points, likelihood = np.asarray(observation.points, float), np.asarray(observation.likelihood, float)
    if points.shape != (count, 3) or likelihood.shape != (count,):
        raise ObservationError(
            f"key points of shape {points.shape} with likelihoods of shape {likelihood.shape}, "
            f"expected ({count}, 3) and ({count},)"
        )
    possible, is_far = _are_possible(points, likelihood)
    if not possible:
        if np.isinf(points).any():
            raise ObservationError(
                f"key point {int(np.argwhere(np.isinf(points))[0, 0])} is infinite, expected metres or NaN"
            )
        raise ObservationError(f"likelihoods from {likelihood.min():g} to {likelihood.max():g}, expected 0 to 1")
    if is_far:
        raise ObservationError(
            f"key points up to {np.nanmax(np.abs(points)):.4g} m from the jaw's origin, expected metres in the jaw "
            "frame: millimetres are divided by 1000"
        )
    if observation.stddev is not None:
        check_stddev(np.asarray(observation.stddev), points)
    shared = observation.shared
    if not (isinstance(shared, SharedStddev) and all(0.0 <= stddev < np.inf for stddev in shared)):
        raise ObservationError(f"shared standard deviations {shared}, expected SharedStddev with numbers from zero up")
    if observation.posture is not None:
        check_posture(observation.posture)
    check_stamp(observation.stamp)
    if last_stamp is not None and observation.stamp <= last_stamp:
        raise ObservationError(
            f"stamp {observation.stamp:.6f} s after {last_stamp:.6f} s, expected rising stamps; "
            "reset for a new recording"
        )
    if last_stamp is not None and observation.stamp < last_stamp + _SAME_IMAGE:
        raise ObservationError(
            f"stamp {observation.stamp - last_stamp:.3g} s after the last, expected at least {_SAME_IMAGE:g} s: "
            "one image came twice"
        )


def check_stamp(stamp: float) -> None:
    """Refuse what cannot be a capture time in seconds: whole numbers, which count images or ticks, and far too many.

    Raises:
        ObservationError: the stamp is such a number, or not finite.
    """
    if isinstance(stamp, Integral) or not abs(stamp) < _LATEST:
        raise ObservationError(
            f"stamp {stamp}, expected seconds as a float: divide frame numbers by the frame rate, milliseconds by 1e3, "
            "nanoseconds by 1e9"
        )


def check_periods(stamps: Sequence[float]) -> None:
    """Refuse rising stamps of three images in a row that are not in seconds; a single gap is a pause.

    Raises:
        ObservationError: they are whole numbers, or closer or further apart than a camera's images.
    """
    if len(stamps) < 3:
        return
    first, second, third = stamps
    if first.is_integer() and second.is_integer() and third.is_integer():
        raise ObservationError(
            f"stamps {first:g}, {second:g}, {third:g}, expected seconds: if these are frame numbers, divide them by "
            "the frame rate"
        )
    shorter, longer = sorted((second - first, third - second))
    if longer < _SHORTEST_PERIOD or shorter > _LONGEST_PERIOD:
        unit = min(_UNITS, key=lambda name: abs(np.log(_UNITS[name] * shorter / _USUAL_PERIOD)))
        likely = f"; the stamps look like {unit}" if shorter > _LONGEST_PERIOD else ""
        raise ObservationError(
            f"images {shorter:.4g} s apart, expected {_SHORTEST_PERIOD:g} to {_LONGEST_PERIOD:g} s{likely}"
        )


@njit(cache=True)
def _are_possible(points, likelihood):
    """Return whether no coordinate (K, 3) is infinite and all likelihoods (K,) are from 0 to 1; and if most are far.

    One or two key points may be gross errors.
    """
    far = known = 0
    for k in range(len(points)):
        is_far = False
        for a in range(3):
            if np.isinf(points[k, a]):
                return False, False
            is_far = is_far or abs(points[k, a]) > _FARTHEST
        if not 0.0 <= likelihood[k] <= 1.0:
            return False, False
        known, far = known + np.isfinite(points[k].sum()), far + is_far
    return True, 2 * far > known


# Farthest that a stated contact point may be from the undeformed inner face along x [m].
_OFF_FACE = 1e-3


def check_contact(contact: Contact, jaw: Jaw) -> None:
    """Refuse what cannot be a contact.

    Raises:
        ContactError: Wrong shapes, points off the inner face, weights that are negative or all zero.
    """
    points, weights = np.asarray(contact.points), np.asarray(contact.weights)
    if points.ndim != 2 or points.shape[1:] != (3,) or weights.shape != (len(points),):
        raise ContactError(f"contact points {points.shape} with weights {weights.shape}, expected (n, 3) and (n,)")
    if not _are_near(np.asarray(points, float), np.asarray(jaw.face.read(points[:, 2]), float)):
        raise ContactError(f"contact points off the undeformed inner surface x = {jaw.inner_face_x:g} m")
    if len(weights) and not _are_weights(np.asarray(weights, float)):
        raise ContactError(f"contact weights {weights}, expected non-negative numbers that are not all zero")


@njit(cache=True)
def _are_near(points, face):
    """Return True if points (n, 3) [m] are finite and at x of the inner face (n,) [m]."""
    off = 0
    for i in range(len(points)):
        off += not (np.isfinite(points[i].sum()) and abs(points[i, 0] - face[i]) <= _OFF_FACE)
    return off == 0


@njit(cache=True)
def are_within(points, axis, low, high):
    """Return True if points (n, 3) are from low to high along an axis, which those that are not finite are not."""
    off = 0
    for i in range(len(points)):
        off += not low <= points[i, axis] <= high
    return off == 0


@njit(cache=True)
def _are_weights(weights):
    """Return True if weights (n,) are finite, none negative, and not all zero."""
    for weight in weights:
        if not 0.0 <= weight < np.inf:
            return False
    return weights.sum() > 0.0


def sketch_contact(jaw: Jaw) -> Contact:
    """Return a contact with the outline of a square that just touches the middle of a jaw, for a first try."""
    height = float(np.median(jaw.candidates[:, 2]))
    middle = np.array([[jaw.face.read(height), 0.0, height]])
    square = 0.01 * np.array([[0.0, -1.0], [2.0, -1.0], [2.0, 1.0], [0.0, 1.0]])
    outline = ObjectOutline(polygons=(square,), origin=middle[0, ::2], tilt=0.0, stddev=np.array([1e-3, 1e-3, 0.1]))
    return Contact(points=middle, weights=np.ones(1), outline=outline)


_LARGEST = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectOutline:
    """The outline of an object in the x-z plane, in which the finger bends.

    Attributes:
        polygons: (n, 2) each, x and z [m] about the outline's origin; outer ones counterclockwise, holes clockwise.
        origin: x and z [m] of that origin in the jaw frame.
        tilt: turn of the polygons about the origin [rad]; positive turns x towards z.
        stddev: (3,) of the origin's x and z [m] and of the tilt [rad].
        across: where along y the object stands nearest, and the standard deviation of the pressure there (2,) [m];
            None where unknown.
    """

    polygons: tuple[NDArray, ...]
    origin: NDArray
    tilt: float
    stddev: NDArray
    across: NDArray | None = None

    def __post_init__(self) -> None:
        """Refuse what is no outline.

        Raises:
            ContactError: No polygon, fewer than three corners, numbers that are not finite or not metres.
        """
        if not self.polygons or any(p.ndim != 2 or p.shape[1] != 2 or len(p) < 3 for p in self.polygons):
            shapes = [p.shape for p in self.polygons]
            raise ContactError(f"outline of polygons {shapes}, expected at least one of shape (n >= 3, 2)")
        numbers = np.concatenate([p.ravel() for p in self.polygons] + [np.ravel(self.origin), [self.tilt]])
        if np.shape(self.origin) != (2,) or not np.isfinite(numbers).all() or np.abs(numbers[:-1]).max() > _LARGEST:
            raise ContactError("outline with coordinates that are not finite or beyond a metre, expected metres")
        spread = np.asarray(self.stddev)
        if spread.shape != (3,) or not (np.isfinite(spread) & (spread > 0)).all():
            raise ContactError(f"outline with standard deviations {self.stddev}, expected three finite ones above zero")
        if self.across is None:
            return
        across = np.asarray(self.across)
        if across.shape != (2,) or not (np.isfinite(across).all() and abs(across[0]) < _LARGEST and across[1] > 0):
            raise ContactError(
                f"outline with across {self.across}, expected a place along y and a standard deviation above zero [m]"
            )

    @property
    def nearest(self) -> float:
        """Least x of the outline [m], jaw frame."""
        return min(float(polygon[:, 0].min()) for polygon in self.placed())

    def placed(self) -> tuple[NDArray, ...]:
        """Return the polygons (n, 2) [m] in x and z of the jaw frame."""
        c, s = np.cos(self.tilt), np.sin(self.tilt)
        turn = np.array([[c, s], [-s, c]])
        return tuple(p @ turn + self.origin for p in self.polygons)


def are_same_polygons(first: tuple[NDArray, ...], second: tuple[NDArray, ...]) -> bool:
    """Return whether two sets of polygons (n, 2) are equal, so that what was computed from one holds for the other."""
    return first is second or (len(first) == len(second) and all(map(np.array_equal, first, second)))
