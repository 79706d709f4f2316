"""Key points of a press in time, what an estimator says of them, and whether that is right."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from finforce_ifea.errors import ContactError
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.observation import Contact, ObjectOutline, Observation, Solution
from finforce_ifea.settings import EstimatorSettings
from lab.presses import PressHistory, RigidCylinder, press_jaw
from lab.stress.stress import Plan, Trial, attempt

PERIOD = 1 / 30
LIKELIHOOD = 0.95
# Key point noise of a bench camera [m]: across and along its line of sight.
ACROSS, ALONG = 0.2e-3, 0.45e-3
SIGHT = np.array([0.25, -0.95, 0.18]) / np.linalg.norm([0.25, -0.95, 0.18])
OFFSET = 0.2e-3
# Standard deviation of a tracked pose: x, z [m] and turn [rad].
POSE = np.array([0.5e-3, 0.5e-3, 5e-3])
# What an estimator is told of objects that slide without friction.
FRICTIONLESS = {"friction": 0.0, "friction_stddev": 0.03}


@dataclass(frozen=True, kw_only=True, eq=False)
class SessionStep:
    """The input of an estimator in one image, and the truth.

    Attributes:
        stamp: [s].
        points: (K, 3) [m].
        likelihood: (K,).
        contact: as for `ForceEstimator.update`.
        force: true (3,) [N].
        torque: true (3,) [N m].
        level: see `Trial`.
    """

    stamp: float
    points: NDArray
    likelihood: NDArray
    contact: Contact | None
    force: NDArray
    torque: NDArray
    level: str = ""

    @property
    def observation(self) -> Observation:
        """The observation of the step."""
        return Observation(stamp=self.stamp, points=self.points, likelihood=self.likelihood)


def noise_of(random: np.random.Generator, shape: tuple[int, ...], scale: float = 1.0) -> NDArray:
    """Return the noise (..., 3) [m] of a bench camera, `scale` times as large."""
    scatter = ACROSS * random.normal(size=(*shape, 3))
    return scale * (scatter + ALONG * random.normal(size=(*shape, 1)) * SIGHT)


def tell_pose(bench: Bench, polygon: NDArray, front: float, state: NDArray, off: NDArray) -> Contact:
    """Return the contact that a tracked object tells: its outline at a pose.

    Args:
        bench: whose jaw it presses.
        polygon: outline (n, 2) [m].
        front: distance from its origin to its leading point [m].
        state: of the contact (3,): depth [m], tilt [rad], height [m].
        off: error of the pose along x, z [m], and turn [rad] (3,).
    """
    depth, tilt, height = state
    face = bench.jaw.inner_face_x
    origin = np.array([face + front - depth, height]) + off[:2]
    outline = ObjectOutline(polygons=(polygon,), origin=origin, tilt=tilt + off[2], stddev=POSE)
    where = np.array([[face, 0.0, min(max(height, 0.01), 0.07)]])
    return Contact(points=where, weights=np.ones(1), outline=outline)


@dataclass(frozen=True, kw_only=True, eq=False)
class Session:
    """An estimator that has tared and is about to see a press.

    Attributes:
        bench: whose estimator it is.
        random: of the noise.
        history: the press.
        contact: contact that is given to the estimator.
        offsets: of the key points, constant (K, 3) [m].
        start: stamp of the last unloaded image [s].
        level: see `Trial`.
    """

    bench: Bench
    random: np.random.Generator
    history: PressHistory
    contact: Contact
    offsets: NDArray
    start: float
    level: str = ""

    def steps(self, depths: NDArray, *, scale: float = 1.0) -> list[SessionStep]:
        """Return one step for each depth (n,) [m], a period apart, with `scale` times a bench camera's noise."""
        clean = self.history.keypoints(depths) + self.offsets
        points = clean + noise_of(self.random, clean.shape[:2], scale)
        forces, torques = self.history.forces(depths), self.history.torques(depths)
        return [
            SessionStep(
                stamp=self.start + (i + 1) * PERIOD,
                points=points[i],
                likelihood=np.full(len(points[i]), LIKELIHOOD),
                contact=self.contact,
                force=forces[i],
                torque=torques[i],
                level=self.level,
            )
            for i in range(len(depths))
        ]

    def press(self, *, scale: float = 1.0, hold: int = 20) -> list[SessionStep]:
        """Return the steps of a press: three images of rest, 0.4 s of ramp, and `hold` images, 0.7 s, of hold."""
        depth = self.history.depth
        rising = np.linspace(0.0, depth, 13)[1:]
        return self.steps(np.concatenate([np.zeros(3), rising, np.full(hold, depth)]), scale=scale)

    def play(self, seed: int, steps: Iterable[SessionStep]) -> Iterator[Trial]:
        """Give steps to the estimator and yields one trial each."""
        for step in steps:
            yield attempt(
                seed,
                lambda s=step: update(self.bench, s),
                lambda got, s=step: judge(got, s),
                level=step.level,
            )


def open_session(
    bench: Bench,
    random: np.random.Generator,
    *,
    history: PressHistory | None = None,
    tare: float = 1.0,
    level: str = "",
) -> Session:
    """Draw a press unless one is given, and lets the estimator tare on images with `tare` times the usual noise.

    The estimator is told the height of first touch, off by what its settings call that height's deviation.
    """
    history = history or bench.press(random)
    offsets = OFFSET * random.normal(size=bench.jaw.keypoints.shape)
    error = bench.estimator.settings.height_stddev * random.normal()
    contact = Contact.fixed(bench.jaw, history.height + error)
    rest = bench.jaw.keypoints + offsets
    bench.estimator.reset()
    stamp, likelihood = 10.0, np.full(len(rest), LIKELIHOOD)
    for noise in noise_of(random, (bench.estimator.settings.tare_frames, len(rest)), tare):
        stamp += PERIOD
        seen = Observation(stamp=stamp, points=rest + noise, likelihood=likelihood)
        bench.estimator.update(seen, contact)
    return Session(
        bench=bench, random=random, history=history, contact=contact, offsets=offsets, start=stamp, level=level
    )


def take_another(session: Session, random: np.random.Generator) -> Session:
    """Return the session with another press and what is told of it, the estimator going on as it is."""
    history = session.bench.press(random)
    error = session.bench.estimator.settings.height_stddev * random.normal()
    return replace(session, history=history, contact=Contact.fixed(session.bench.jaw, history.height + error))


def update(bench: Bench, step: SessionStep) -> Solution:
    """Return what the bench's estimator says of a step."""
    return bench.estimator.update(step.observation, step.contact)


def judge(solution: Solution, step: SessionStep) -> Trial:
    """Return how a solution compares with the truth: force, its magnitude, and torque about y."""
    error = solution.force - step.force
    magnitude = np.linalg.norm(solution.force) - np.linalg.norm(step.force)
    stated = (*solution.force_stddev, solution.magnitude_stddev, solution.torque_stddev[1])
    wrench = np.concatenate([solution.force, solution.torque, solution.force_stddev, solution.torque_stddev])
    return Trial(
        sure=solution.trusted,
        errors=tuple(np.abs([*error, magnitude, solution.torque[1] - step.torque[1]]).tolist()),
        stated=tuple(map(float, stated)),
        nan=not np.isfinite([*wrench, solution.magnitude_stddev]).all(),
        note=f"{solution.status}: true {np.linalg.norm(step.force):.3g} N",
    )


# The truth comes from the estimator's own mechanics: no more than this share of a force is left to it.
FORCE_ERROR = 0.01
COURSE_STEPS = 16
OWN_MECHANICS = ("solid", "frame", "plane")
# Heights [m] of the bench finger's first and last candidate.
_BENCH_REACH = (0.008, 0.073)


class Bench:
    """One jaw with an estimator, and the same mechanics to press it with."""

    def __init__(self, plan: Plan, *, modulus: float = 1.0, jaw: Jaw | None = None, **settings) -> None:
        """Build the bench jaw, or another one, with `modulus` times its Young's modulus."""
        self.plan = plan
        jaw = jaw or load_jaw(plan.jaw)
        self._reach = jaw.candidates[[0, -1], 2]
        self._size = float(np.diff(self._reach)[0] / np.diff(_BENCH_REACH)[0]) if plan.jaw != "bench" else 1.0
        young_modulus = modulus * jaw.material.young_modulus
        jaw = replace(jaw, material=jaw.material.model_copy(update={"young_modulus": young_modulus}))
        calibration = Calibration(young_modulus=young_modulus, force_error=FORCE_ERROR, clamped_z=0.0)
        chosen = EstimatorSettings(solver=plan.solver, mesh=plan.mesh, **{**FRICTIONLESS, **settings})
        self.estimator = ForceEstimator(jaw, settings=chosen, calibration=calibration)
        self.estimator.warm_up()
        self.jaw = self.estimator.jaw
        own, full = plan.solver in OWN_MECHANICS, replace(chosen, solver=self.jaw.model)
        self.mechanics = self.estimator.mechanics if own else build_mechanics(self.jaw, full)

    def find_height(self, height: float) -> float:
        """Return the height on this finger of a height on the bench finger [m]: at the same share of its candidates."""
        return float(self._reach[0] + self._size * (height - _BENCH_REACH[0])) if self._size != 1.0 else height

    def find_depth(self, depth: float) -> float:
        """Return the depth for this finger of a depth for the bench finger [m]: as much less as it is shorter."""
        return depth * min(self._size, 1.0)

    def press(self, random: np.random.Generator, *, depth: float | None = None) -> PressHistory:
        """Return a press by a drawn cylinder at a drawn height, `depth` [m] deep or drawn too.

        A press that slips off or buckles is drawn anew.
        """
        while True:
            height, radius = random.uniform(0.018, 0.062), np.exp(random.uniform(np.log(5e-3), np.log(25e-3)))
            deepest = np.exp(random.uniform(np.log(0.3e-3), np.log(8e-3))) if depth is None else depth
            try:
                return self.history(height=height, radius=radius, depth=deepest)
            except ContactError:
                continue

    def history(self, *, height: float, radius: float, depth: float) -> PressHistory:
        """Return the press of a cylinder at a height and depth [m] that are meant for the bench finger.

        Raises:
            ContactError: There is no equilibrium.
        """
        height, depth = self.find_height(height), self.find_depth(depth)
        model, surface = self.mechanics.model, self.mechanics.contact.surface
        depths, probe = np.linspace(0.0, depth, COURSE_STEPS + 1), model.attach(self.jaw.keypoints, max_distance=1.0)
        presses = press_jaw(model, surface, self.jaw.inner_face_x, RigidCylinder(radius=radius), height, depths)
        return PressHistory(
            height=height,
            radius=radius,
            depth=depth,
            keypoints=PchipInterpolator(depths, [model.positions(probe, press.q) for press in presses]),
            forces=PchipInterpolator(depths, [press.force for press in presses]),
            torques=PchipInterpolator(depths, [press.torque for press in presses]),
        )
