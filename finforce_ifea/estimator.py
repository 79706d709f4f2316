"""Key points and a contact in, force out, one image after the other: the entry for nodes and for evaluation."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from math import hypot
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.errors import ObservationError
from finforce_ifea.contact_mechanics.friction import Coefficient
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics
from finforce_ifea.errors import ContactError, NotEnoughDataError, UnobservableError
from finforce_ifea.filter.lateral_load import measure_torsion
from finforce_ifea.filter.tracker import ContactTracker
from finforce_ifea.jaw.calibration import Calibration, load_calibration
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.mechanics import build_chosen
from finforce_ifea.observation import (
    Contact,
    Observation,
    Solution,
    are_within,
    blank_solution,
    check_contact,
    check_observation,
    check_periods,
    sketch_contact,
)
from finforce_ifea.relaxation import Relaxation
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import Tare, TareKeeper
from finforce_ifea.touch import find_touch_probability
from finforce_ifea.tracking.contact_state import (
    LARGEST_RESIDUAL,
    UNSEEN_ALONG,
    ContactState,
    bound_residual,
    compute_force,
    find_rejection_reason,
)
from finforce_ifea.tracking.given_contact import GivenContactTracker
from finforce_ifea.tracking.influence import OffsetChange, UnloadedCheck, split_change

_LONGEST_GAP = 1.0
_FEWEST_COMPARED = 3
_TOLERANCE = 1e-3
# Age from which repeated key points are stale [s]: detectors look again every 4 s.
_STALE = 5.0
_UNTARED = "no tare: the jaw was loaded from the start; key point offsets are unknown"
# Relative standard deviation of forces without a calibration, beside that of the modulus [-].
_UNCALIBRATED = 0.1
# Relative error of forces at the end of the range of the stored shapes [-].
_EXTRAPOLATED = 0.015
# Fingers and settings that this process has compiled.
_WARM: set[tuple[str, EstimatorSettings]] = set()


class ForceEstimator:
    """Estimates the force on one jaw; deterministic, one thread.

    Attributes:
        is_idle: True if the jaw was at rest in the last image, its object out of reach.
    """

    def __init__(
        self,
        jaw: Jaw | str | Path,
        *,
        settings: EstimatorSettings | None = None,
        calibration: Calibration | str | Path | None = None,
    ) -> None:
        """Build the mechanics of the jaw as the calibration describes it.

        Args:
            jaw: as its file has it, that file, or the name of a shipped jaw.
            settings: of this estimator.
            calibration: of the finger, its file or a shipped name; None for the jaw as it is.

        Raises:
            FinforceError: Jaw, settings and calibration do not fit each other.
        """
        self.calibration = calibration = None if calibration is None else load_calibration(calibration)
        jaw = jaw if isinstance(jaw, Jaw) else load_jaw(jaw)
        self.jaw = calibration.apply(jaw) if calibration else jaw
        self.settings = (settings or EstimatorSettings()).resolve_friction(self.jaw.material)
        self.mechanics: Mechanics = build_chosen(self.jaw, self.settings)
        torsion = measure_torsion(self.jaw, self.mechanics.mesh)
        surface = self.mechanics.contact.surface
        # the least and the greatest y and z of contacts on the inner surface [m]
        self._surface_range = np.stack([surface.low - _TOLERANCE, surface.high + _TOLERANCE])
        self._tracked = ContactTracker(
            self.mechanics, self.jaw.keypoints, self.settings, torsion, contact_range=self.jaw.contact_range
        )
        self._given = GivenContactTracker(self.jaw, self.mechanics, self.settings, self._tracked.response)
        self._tracker: ContactTracker | GivenContactTracker = self._tracked
        self._gate = KeypointGate(self.jaw, self.settings)
        terms = calibration.relaxation if calibration else ()
        self._relaxation, self._relaxation_stddev = Relaxation(terms), Relaxation(terms)
        self._modulus_error = 0.0 if calibration else self.jaw.material.spread
        self._force_error = calibration.expect_error(self.jaw, self.settings.solver) if calibration else _UNCALIBRATED
        self._taring = TareKeeper(
            self.jaw.keypoints,
            self.settings,
            lambda *chance: self._tracker.significance(*chance),
            self._tracked.rest_modes,
        )
        self._unloaded_check = UnloadedCheck(self.jaw.keypoints, self.jaw.inner_face_x, self._tracked.rest_modes)
        self.reset()

    def reset(self) -> None:
        """Forget everything but the jaw: offsets, place, relaxation, stamps."""
        self._stamps: deque[float] = deque(maxlen=3)  # of the last images [s]
        self._bits, self._changed = b"", 0.0
        self._followed: float | None = None  # stamp of the last image that a tracker took
        self._contact: Contact | None = None
        self._pressed: ContactState | None = None  # of the last image, if its force is told
        self._at_rest = self.is_idle = self._was_interrupted = False
        self._scale_error = 0.0  # relative standard deviation of the displacements that all key points share [-]
        self._relaxed: float | None = None
        self._taring.reset()
        self._unloaded_check.reset()
        self._relaxation.reset()
        self._relaxation_stddev.reset()
        self._tracked.reset()
        self._given.reset()

    def forget(self) -> None:
        """Forget the object, too: what was learnt of its friction."""
        self.reset()
        self._tracked.forget()

    def expect_friction(self, friction: Coefficient | None) -> None:
        """Expect an object of a stated coefficient of friction; None for one of which the settings say all."""
        self._tracked.expect_friction(friction)

    @property
    def friction(self) -> Coefficient:
        """The object's coefficient of friction as far as it is known."""
        return self._tracked.friction

    @property
    def friction_source(self) -> str:
        """Source of that coefficient: "stated", "expected" by the settings, or "learned" from the object's path."""
        return self._tracked.friction_source

    @property
    def touch_probability(self) -> float:
        """Probability that the object touched in the last image, 0 where no force was found."""
        if self._pressed is None:
            return 0.0
        return find_touch_probability(self._pressed, self._contact, self.jaw.inner_face_x)

    def warm_up(self) -> None:
        """Compile what is compiled on first use, once in a process for each finger, and leave no trace."""
        kind = self.jaw.digest, self.settings
        if kind not in _WARM:
            warm_up(self.jaw, self.settings.tare_frames, self.update, self.forget)
            _WARM.add(kind)

    @property
    def _stamp(self) -> float:
        """Stamp of the last image [s]."""
        return self._stamps[-1]

    @property
    def tared(self) -> bool:
        """True if the key points' offsets are known."""
        return self._taring.tared

    @property
    def is_taring(self) -> bool:
        """True if unloaded images are needed, for the first tare or for a better average."""
        return self._taring.is_averaging

    def interrupt(self) -> None:
        """Note that images were left out, in which an object may have been let go and grasped again.

        A tare that is asked for takes none from before.
        """
        self._taring.interrupt()
        self._bits, self._was_interrupted = b"", True

    @property
    def offsets(self) -> Tare:
        """Offsets and noise of the key points; see `tare`."""
        return self._taring.tare

    def adopt_tare(self, tare: Tare) -> None:
        """Take the offsets that another part of the session has shown, with jaw and camera mounted in the same way."""
        self._taring.adopt(tare)

    def compare_offsets(self, tare: Tare) -> OffsetChange:
        """Return by how much the offsets differ from those of a tare, in key points that both have.

        Raises:
            NotEnoughDataError: they have too few in common.
        """
        own = self._taring.tare
        both = (own.counts > 0) & (tare.counts > 0)
        if both.sum() < _FEWEST_COMPARED:
            raise NotEnoughDataError(f"{both.sum()} key points in both tares, expected {_FEWEST_COMPARED} at least")
        return split_change(self._tracked.rest_modes()[both], (own.offsets - tare.offsets)[both])

    @property
    def surface_triangles(self) -> NDArray:
        """Triangles of the surface (t, 3), indices into `surface()`."""
        return self.mechanics.mesh.surface

    def surface(self) -> NDArray:
        """Return the deformed mesh vertices (n, 3) [m], in mesh order."""
        return self._tracker.vertices()

    def update(self, observation: Observation, contact: Contact | None) -> Solution:
        """Take one image's key points and return what they say.

        Args:
            observation: stamp [s], points (K, 3) [m] in the jaw frame, likelihood (K,), stddev (K, 3) [m].
            contact: where the object touches; None or no rows when there is no object.

        Raises:
            ObservationError: Key points of wrong shape, infinite, or stamps that are not seconds or do not rise.
            ContactError: The contact is not on the jaw.
        """
        self.learn()
        check_observation(observation, len(self.jaw.keypoints), self._stamps[-1] if self._stamps else None)
        if contact is not None and contact is not self._contact:
            check_contact(contact, self.jaw)
            self._follow(contact)
        self._contact, self._pressed = contact, None
        self._stamps.append(float(observation.stamp))
        check_periods(self._stamps)
        bits = np.asarray(observation.points).tobytes()
        if bits != self._bits:
            self._bits, self._changed = bits, self._stamp
        points = self._gate.accept(observation)
        is_apart = contact is not None and contact.touching is False
        dt = self._stamp - self._stamps[max(len(self._stamps) - 2, 0)]
        self._taring.add(points, observation.stddev, apart=is_apart, dt=dt)
        used, self.is_idle = np.isfinite(points[:, 0]), False
        count = np.count_nonzero(used)
        if count < self.settings.minimum_keypoints:
            seen = f"{count} of {len(used)} key points can be used"
            return self._fail("not_enough_points", seen, used)
        if self._stamp - self._changed > _STALE and self._taring.is_noisy:
            stale = f"the same key points to the bit for {self._stamp - self._changed:.0f} s"
            return self._fail("unobservable", f"{stale}: the camera or the detector hangs", used)
        waiting = self._await_tare()
        if waiting:
            return self._fail("waiting", waiting, used)
        if contact is None or not len(contact.points):
            return self._without_contact(points, used)
        self.is_idle = self.tared and self._unloaded_check.is_idle(contact, points, self._taring.tare)
        if self.is_idle:
            return self._rest("the object is out of reach, the jaw is at rest", points)
        beyond = self._find_beyond(contact)
        if beyond:
            return self._fail("unobservable", beyond, used)
        dt = 0.0 if self._followed is None else min(self._stamp - self._followed, _LONGEST_GAP)
        self._followed, self._scale_error = self._stamp, observation.shared.scale
        try:
            state = self._tracker.update(points, self._taring.tare, dt, observation)
        except UnobservableError as error:
            return self._fail("unobservable", str(error), used)
        return self._conclude(state, used)

    def learn(self) -> None:
        """Learn what the last image tells in addition to its force; the next image does it where there was no time."""
        self._tracked.learn()

    def tare(self) -> str:
        """Take the last frames as unloaded and learn each key point's offset; return what was found, a sentence.

        Raises:
            NotEnoughDataError: Too few unloaded frames or visible key points.
            UnderLoadError: The jaw is, or looks, loaded.
        """
        return self._taring.take()

    def _find_beyond(self, contact: Contact) -> str:
        """Return what to say of a contact at heights where key points tell no force, empty for any other.

        An object that is drawn may be near such heights as long as it does not touch.
        """
        low, high = self.jaw.contact_range
        if contact.outline is not None:
            low, high = (-np.inf, np.inf) if contact.touching is False else self._surface_range[:, 1]
        if are_within(contact.points, 2, low, high):
            return ""
        found = np.round(1e3 * contact.points[:, 2], 1).tolist()
        where = f"contact at heights {found} mm, expected {1e3 * low:g} to {1e3 * high:g} mm"
        return f"{where}: beyond, key points show no force"

    def _await_tare(self) -> str:
        """Return what is missing for the first tare, empty when it is done or not due."""
        if self._taring.tared:
            return ""
        if self._taring.missing:
            self._relax(np.zeros(3))
            return f"{self._taring.missing} more unloaded frames for the tare"
        try:
            self._taring.begin()
        except NotEnoughDataError as error:
            return str(error)
        return ""

    def _follow(self, contact: Contact) -> None:
        """Hand a contact to the tracker that it is for."""
        if not len(contact.points):
            return
        low, high = self._surface_range
        axes = (1, 2) if contact.outline is None else (1,)
        if not all(are_within(contact.points, axis, low[axis - 1], high[axis - 1]) for axis in axes):
            places = np.round(1e3 * contact.points[:, 1:], 1).tolist()
            raise ContactError(
                f"contact at y, z = {places} mm, expected on the inner surface from "
                f"{np.round(1e3 * low, 1).tolist()} to {np.round(1e3 * high, 1).tolist()} mm"
            )
        free = (contact.free or contact.outline is not None) and self.settings.solver != "paper"
        chosen = self._tracked if free else self._given
        if chosen is not self._tracker:
            chosen.resume(self._tracker.give_shape())
            self._tracker = chosen
        chosen.follow(contact)

    def _without_contact(self, points: NDArray, used: NDArray) -> Solution:
        """Tell what can be said without an object: nothing presses, or it cannot be known where."""
        if self._taring.is_at_rest(points):
            return self._rest("no object, the jaw is at rest", points)
        return self._fail("no_contact", "the jaw is bent but no contact is known", used)

    def _rest(self, message: str, points: NDArray) -> Solution:
        """Tell that nothing presses, as far as the key points (K, 3) [m] tell it."""
        self._taring.note(quiet=True, loaded=False)
        self._relax(np.zeros(3))
        if not self._at_rest:  # the shape of a load that has gone
            self._tracker.reset()
            self._contact, self._at_rest = None, True
        response, used = self._tracked.response, np.isfinite(points[:, 0])
        deviations = points - self.jaw.keypoints - self._taring.tare.offsets
        stddev = response.bound_force(deviations)
        return blank_solution(self._stamp, "unloaded", message, used)._replace(
            converged=True,
            force_stddev=stddev * np.array([1.0, 0.0, UNSEEN_ALONG]),
            torque_stddev=np.array([0.0, stddev * response.heights[-1], 0.0]),
            magnitude_stddev=stddev,
        )

    def _fail(self, status: str, message: str, used: NDArray, iterations: int = 0) -> Solution:
        """Return a solution without force."""
        return blank_solution(self._stamp, status, message, used, iterations)

    def _conclude(self, state: ContactState | None, used: NDArray) -> Solution:
        """Turn what a tracker has found into a solution."""
        self._at_rest = False
        if state is None:
            return self._fail("not_enough_points", "too few key points agree with the jaw's shape", used)
        used, iterations = self._tracker.used, int(state["iterations"])
        if not state["sound"]:
            self._tracker.reset()
            self._contact = None
            return self._fail("diverged", "the shape cannot be reached by the jaw", used, iterations)
        # no bound is below `LARGEST_RESIDUAL`; the paper's linear tetrahedra lock and leave more than that
        is_far = self.settings.solver != "paper" and state["residual"] > LARGEST_RESIDUAL
        most = bound_residual(self.jaw.keypoints, self._taring.tare.noise) if is_far else np.inf
        reason = find_rejection_reason(state, largest_residual=most, largest_stddev=self.settings.largest_stddev)
        if reason:
            if state["magnitude"] <= state["max_force"]:
                self._relax(state["force"])
            return self._fail("unobservable", reason, used, iterations)
        self._taring.note(quiet=bool(state["quiet"]), loaded=bool(state["loaded"]))
        return self._solution(state, used)

    def _relax(self, force: NDArray) -> None:
        """Let the material relax under a force (3,) [N] that is not told."""
        self._relaxation.update(force, self._pass_time(force))

    def _pass_time(self, force: NDArray) -> float:
        """Return the time since the material's last force [s], as it gets one (3,) [N].

        When within that time the force came is not known, either; after an interruption, not even of one that stayed.
        """
        dt = 0.0 if self._relaxed is None else self._stamp - self._relaxed
        self._relaxed = self._stamp
        self._relaxation_stddev.update(np.zeros(3), dt)
        before = self._relaxation.packed[0]
        change = np.maximum(np.abs(force), np.abs(before)) if self._was_interrupted else force - before
        self._relaxation_stddev.doubt(change, dt)
        self._was_interrupted = False
        return dt

    def _solution(self, state: ContactState, used: NDArray) -> Solution:
        """Return the force that belongs to a contact, and how good it is."""
        self._pressed = state
        extrapolated = _EXTRAPOLATED * state["extrapolation"]
        error = hypot(self._force_error, self._scale_error, state["location_error"], extrapolated)
        vectors, dt = np.empty((7, 3)), self._pass_time(state["force"])
        magnitude, stddev = compute_force(
            state,
            self._relaxation.packed,
            self._relaxation_stddev.overstress,
            dt,
            (error, self._modulus_error),
            vectors,
        )
        force, torque, force_stddev, torque_stddev, point, location, normal = vectors
        return Solution(
            stamp=self._stamp,
            status="ok" if magnitude > 0.0 else "unloaded",
            message="" if self.tared else _UNTARED,
            force=force,
            torque=torque,
            force_stddev=force_stddev,
            torque_stddev=torque_stddev,
            magnitude_stddev=stddev,
            contact_point=point,
            contact_location=location,
            normal=normal,
            residual=float(state["residual"]),
            kkt=float(state["kkt"]),
            keypoints_used=used,
            iterations=int(state["iterations"]),
            converged=bool(state["converged"]),
        )


_STDDEV = 0.3e-3
_NOISE = 0.05e-3
_EACH = 3
# [m] a press, a release, a press, and a hold that is long enough for what is held to be weighed
_BENDS = [1e-3 * bend for bend in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 2.5, 2.0, 2.5, *40 * (3.0,))]
Update = Callable[[Observation, Contact], object]


def warm_up(jaw: Jaw, tare_frames: int, update: Update, reset: Callable[[], None]) -> None:
    """Give an estimator images with each kind of contact, with stated standard deviations and without.

    Args:
        jaw: the jaw.
        tare_frames: that are taken before the first force.
        update: of the estimator.
        reset: of the same, left reset in the end.
    """
    random = np.random.default_rng(0)
    for stddev in (None, np.full(jaw.keypoints.shape, _STDDEV)):
        reset()
        fixed = Contact.fixed(jaw, float(np.median(jaw.candidates[:, 2])))
        contacts = [fixed, replace(fixed, free=False), sketch_contact(jaw)]
        sequence = [contacts[0]] * tare_frames + [contact for contact in contacts for _ in range(_EACH)]
        bends = [0.0] * len(sequence) + _BENDS
        for count, bend in enumerate(bends):
            contact = sequence[min(count, len(sequence) - 1)]
            points = jaw.keypoints + _NOISE * random.standard_normal(jaw.keypoints.shape)
            points[:, 0] -= bend * (points[:, 2] / jaw.keypoints[:, 2].max()) ** 2
            seen = np.ones(len(points))
            update(Observation(stamp=count / 30.0, points=points, likelihood=seen, stddev=stddev), contact)
    reset()


# Distance from its position at rest, along any axis, beyond which a key point is rejected [m].
_FARTHEST = 0.03


class KeypointGate:
    """Switches key points off that are hidden, without depth, outside the workspace, or ignored."""

    def __init__(self, jaw: Jaw, settings: EstimatorSettings) -> None:
        """Keep the key points at rest and the thresholds.

        Raises:
            ObservationError: A name to be ignored is no key point of the jaw.
        """
        self._rest = jaw.keypoints
        self._threshold = settings.likelihood_threshold
        self._allowed = np.ones(len(jaw.keypoints), bool)
        for name in filter(None, (part.strip() for part in settings.ignored_keypoints.split(","))):
            if name not in jaw.keypoint_names:
                raise ObservationError(f"ignored_keypoints: {name!r} is not a key point of the jaw {jaw.name!r}")
            self._allowed[jaw.keypoint_names.index(name)] = False

    def accept(self, observation: Observation) -> NDArray:
        """Return the points (K, 3) [m] with NaN in the rows that must not be used."""
        points = np.array(observation.points, float)
        near = (np.abs(points - self._rest) <= _FARTHEST).all(axis=1)
        points[~(near & self._allowed & (np.asarray(observation.likelihood) >= self._threshold))] = np.nan
        return points
