"""A gripper, fingers about an object and a camera in stepped time, for grasps by force.

The emulated gripper answers on the virtual bus as firmware does; its true opening bends the fingers, whose force
relaxes; a camera of 30 Hz tells it late. How it is told is a sensor's matter: noise on the truth, or an estimator.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from finforce.gripper_frames import jaw_in_gripper
from finforce.messages import magnitude_stddev
from finforce.transforms import invert_pose
from finforce_contact.estimator import ContactEstimator
from finforce_contact.loop import ForceLoop
from finforce_driver.grasp.force_monitor import ForceSample, TouchSample
from finforce_driver.grasp.session import hold_force
from finforce_driver.gripper import Gripper
from finforce_driver.settings import GraspGoal, GraspSettings
from finforce_driver.state import GraspPhase, GraspStatus, Phase
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.observation import Observation
from finforce_ifea.relaxation import Relaxation, RelaxationTerm
from finforce_ifea.settings import EstimatorSettings
from finforce_keypoints.build import build_detector
from finforce_keypoints.detectors.dots import DotSettings
from finforce_keypoints.geometry.jaw_localizer import JawKeypoints
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.parameters import DetectorParameters, DetectorSettings, load_jaws
from finforce_sim.emulator.adapter import EmulatedAdapter
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.emulator.virtual import VirtualBus, VirtualClock
from finforce_sim.gripper import PressedGrasp, TwinState
from finforce_sim.simulated_camera import SimulatedCamera
from finforce_sim.simulated_recording import disturb_pose, parse_size

IMAGES = 30.0  # [Hz]
LOST = 0.02  # share of the images
WIDTH = 0.025  # [m] of the objects between springs
CLEARANCE = 0.003  # [m] of the opening before first touch
HOLDING = 10.0  # [s]
BLIND = 8.0  # [s] that a grasp without a camera is watched
# shares and times in the middle of what the twin draws for its fingers
TERMS = (RelaxationTerm(share=0.065, time_constant=2.2), RelaxationTerm(share=0.065, time_constant=10.0))
POINT_NOISE = 0.15e-3  # [m] per axis, of a detected key point from image to image
POSE_PERIOD = 0.1  # [s] of the object's tracker


@dataclass(frozen=True, kw_only=True, eq=False)
class Plant:
    """Fingers about an object: elastic force [N] at an opening [m], first touch [m], relaxation."""

    force_at: Callable[[float], float]
    touch_opening: float = WIDTH
    terms: Sequence[RelaxationTerm] = TERMS


class Sensor(Protocol):
    """A source of forces [N] from images; None where it does not trust itself.

    Attributes:
        touching: True if the jaws were said to touch in the last image; None where nobody says it.
        stddev: that is stated of the last force [N].
    """

    touching: bool | None
    stddev: float

    def measure(self, stamp: float, force: float, opening: float) -> float | None:
        """Return what an image at `stamp` [s] shows of a true force [N] at an opening [m]."""


class NoisySensor:
    """The true force with white noise [N], as a magnitude: never negative."""

    touching = None
    stddev = 0.0

    def __init__(self, noise: float, seed: int) -> None:
        self._noise, self._random = noise, np.random.default_rng(seed)

    def measure(self, stamp: float, force: float, opening: float) -> float | None:
        """Return force and noise."""
        return abs(force + self._noise * self._random.standard_normal())


@dataclass(frozen=True, kw_only=True)
class GraspCase:
    """One grasp: what is held, how hard and how fast, and how late the camera is."""

    plant: Plant
    force: float
    speed: float
    latency: float
    seed: int
    variant: str = "new"


@dataclass(kw_only=True)
class GraspTrace:
    """The record of a grasp: true force and opening over time, and the controller's words."""

    times: list[float] = field(default_factory=list)
    forces: list[float] = field(default_factory=list)
    statuses: list[tuple[float, GraspStatus]] = field(default_factory=list)
    held_at: float = math.nan
    touched_at: float = math.nan
    violations: dict[str, int] = field(default_factory=dict)
    error: str = ""


class World:
    """One emulated gripper with fingers and camera; `hold_force` takes its forces.

    A grasp by force is watched until it has held for `holding` seconds.
    """

    def __init__(
        self,
        case: GraspCase,
        sensor: Sensor,
        settings: GraspSettings | None = None,
        holding: float = HOLDING,
    ) -> None:
        self._holding = holding
        self._case, self._sensor, self._settings = case, sensor, settings
        self.emulated = EmulatedGripper(case.variant, load=case.plant.force_at)
        self.clock = VirtualClock()
        self.gripper = Gripper(self._connect(), clock=self.clock)
        self._relaxation = Relaxation(case.plant.terms)
        self._random = np.random.default_rng([case.seed, 1])
        self._arrivals: list[tuple[float, int, ForceSample | TouchSample]] = []
        self._order = count()
        self._next_image = 0.0
        self.force = 0.0
        self.trace = GraspTrace()

    def _connect(self) -> VirtualBus:
        """Return the bus to the gripper."""
        return VirtualBus(EmulatedAdapter(self.emulated), self.clock)

    def step(self, dt: float) -> None:
        """Bend and relax the fingers, and take an image where one is due."""
        now, opening = self.clock.now(), self.emulated.jaws.opening
        elastic = np.array([self._case.plant.force_at(opening), 0.0, 0.0])
        self.force = float(self._relaxation.update(elastic, dt)[0])
        self.trace.times.append(now)
        self.trace.forces.append(self.force)
        if math.isnan(self.trace.touched_at) and self.force > 0.02:
            self.trace.touched_at = now
        if now >= self._next_image:
            self._next_image = now + 1.0 / IMAGES
            self._photograph(now, opening)

    def take(self) -> Sequence[ForceSample | TouchSample]:
        """Return the forces that have arrived."""
        ready = []
        while self._arrivals and self._arrivals[0][0] <= self.clock.now():
            ready.append(heapq.heappop(self._arrivals)[2])
        return ready

    def run(self) -> GraspTrace:
        """Calibrate, open, grasp, hold, and return what happened."""
        self._prepare()
        # an estimator has its tare to make first
        self.gripper.wait(lambda state: bool(self._arrivals), 5.0)
        goal = GraspGoal(force=self._case.force, speed=self._case.speed)
        try:
            hold_force(self.gripper, self.take, goal, self._settings, until=self._is_over)
        except Exception as error:  # whatever ends a grasp is a result of the benchmark
            self.trace.error = str(error)
        self.trace.violations = dict(self.emulated.violations)
        return self.trace

    def run_blind(self, opening: float, current: float) -> GraspTrace:
        """Calibrate, open, and go to an opening [m] with a limit of the motor's current [A], whatever is there."""
        self._prepare()
        try:
            self.gripper.move(opening, self._case.speed, self.gripper.settings.force_of(current))
            end = self.clock.now() + BLIND
            self.gripper.wait(lambda state: self.clock.now() > end, BLIND + 1.0)
        except Exception as error:  # whatever ends a grasp is a result of the benchmark
            self.trace.error = str(error)
        self.trace.violations = dict(self.emulated.violations)
        return self.trace

    def _prepare(self) -> None:
        """Make the gripper ready and leave it open before the object, with the camera on."""
        gripper, plant = self.gripper, self._case.plant
        load, self.emulated.jaws.load = self.emulated.jaws.load, None
        self._make_ready()
        gripper.move(plant.touch_opening + self._clearance(), speed=0.1)
        gripper.wait(lambda state: state.phase is Phase.READY and state.at_target, 10.0)
        self.emulated.jaws.load = load
        self.clock.attach(self)

    def _make_ready(self) -> None:
        """Calibrate the gripper."""
        self.gripper.wait(lambda state: state.phase is Phase.UNCALIBRATED, 5.0)
        self.gripper.calibrate()
        self.gripper.wait(lambda state: state.phase is Phase.READY, 40.0)

    def _clearance(self) -> float:
        """Return how far before the first touch the jaws stand [m]; seeds begin at other places between two steps."""
        return CLEARANCE + float(np.random.default_rng(self._case.seed).uniform(0.0, 0.002))

    def _photograph(self, now: float, opening: float) -> None:
        """Send what an image shows on its way, if it does not get lost."""
        measured = self._sensor.measure(now, self.force, opening)
        late = max(0.005, self._case.latency + 0.008 * self._random.standard_normal())
        if self._random.uniform() < LOST:
            return
        if measured is not None:
            self._send(
                now + late, ForceSample(stamp=now, arrived=now + late, force=measured, stddev=self._sensor.stddev)
            )
        if self._sensor.touching is not None:
            self._send(now + late, TouchSample(stamp=now, touching=self._sensor.touching))

    def _send(self, due: float, sample: ForceSample | TouchSample) -> None:
        heapq.heappush(self._arrivals, (due, next(self._order), sample))

    def _is_over(self, status: GraspStatus) -> bool:
        """Keep the status, and say whether the force was held for long enough."""
        now = self.clock.now()
        self.trace.statuses.append((now, status))
        if math.isnan(self.trace.held_at) and status.phase is GraspPhase.HOLDING:
            self.trace.held_at = now
        return now > self.trace.held_at + self._holding


def observe_found(stamp: float, keypoints: JawKeypoints) -> Observation:
    """Return what a solver is told of found key points: of those that are not valid no place."""
    points = np.where(keypoints.valid[:, None], keypoints.points, np.nan)
    return Observation(stamp=stamp, points=points, likelihood=keypoints.likelihood, stddev=keypoints.stddev)


def build_loop(pressed: PressedGrasp, side: str) -> ForceLoop:
    """Return the loop of contact and force of one jaw."""
    solver = ForceEstimator(
        pressed.jaws[side],
        settings=EstimatorSettings().resolve_held(both=True),  # as the nodes have it
        calibration=load_calibration("twin"),
    )
    solver.warm_up()
    return ForceLoop(ContactEstimator(solver.jaw, mesh=pressed.object_mesh), solver)


class EstimatorSensor:
    """The force that the whole chain finds from the true key points with noise, of both jaws as the nodes pair them.

    Attributes:
        touching: True if a jaw was said to touch in the last image.
        stddev: of the jaw whose force is less certain, as the driver takes it from `wrench_stddev` [N].
        told: stated deviation and error of every force [N].
        untold: time [s] of every image without a force since the first one with, and what the jaws said.
    """

    def __init__(self, pressed: PressedGrasp, seed: int) -> None:
        self._pressed, self._random = pressed, np.random.default_rng(seed)
        self._loops = {side: build_loop(pressed, side) for side in pressed.jaws}
        self._next_pose = 0.0
        self.touching: bool | None = None
        self.stddev = 0.0
        self.told: list[tuple[float, float]] = []
        self.untold: list[tuple[float, str]] = []

    def measure(self, stamp: float, force: float, opening: float) -> float | None:
        """Return min(|F_left|, |F_right|), None unless both are trusted."""
        state = self._pressed.state(opening, stamp)
        jaws = {side: jaw_in_gripper(side, jaw.origin_x) for side, jaw in state.jaws.items()}
        for side, T in jaws.items():
            self._loops[side].follow_jaw(T)
        if stamp >= self._next_pose:
            self._next_pose = stamp + POSE_PERIOD
            pose = disturb_pose(state.T_gripper_object, self._random)
            for side, loop in self._loops.items():
                loop.take_pose(stamp, invert_pose(jaws[side]) @ pose)
        seen = self._look(state)
        solutions = {side: loop.update(seen[side]) for side, loop in self._loops.items() if side in seen}
        silent = {side: "not found in the image" for side in self._loops if side not in solutions}
        if not silent:
            self.touching = any(loop.contact.estimate.touching for loop in self._loops.values())
        silent |= {side: f"{one.status}: {one.message}" for side, one in solutions.items() if not one.trusted}
        if silent:
            if self.told:
                self.untold.append((stamp, "; ".join(f"{side} {words}" for side, words in silent.items())))
            return None
        self.stddev = max(magnitude_stddev(solution.force_stddev) for solution in solutions.values())
        found = min(float(np.linalg.norm(solution.force)) for solution in solutions.values())
        self.told.append((self.stddev, found - force))
        return found

    def _look(self, state: TwinState) -> Mapping[str, Observation]:
        """Return the key points of the jaws that are found in a state."""
        return {side: self._observe(state.stamp, jaw.keypoints) for side, jaw in state.jaws.items()}

    def _observe(self, stamp: float, keypoints: NDArray) -> Observation:
        noisy = keypoints + POINT_NOISE * self._random.standard_normal(keypoints.shape)
        return Observation(stamp=stamp, points=noisy, likelihood=np.full(len(noisy), 0.9))


class ImageSensor(EstimatorSensor):
    """The same from rendered images, by the key point detector."""

    def __init__(self, pressed: PressedGrasp, seed: int, size: str = "640x480") -> None:
        super().__init__(pressed, seed)
        self._camera, depth_step = parse_size(size), 1e-3
        self._simulated_camera = SimulatedCamera(pressed, self._camera, seed, depth_step)
        self._before: TwinState | None = None
        parameters = DetectorParameters()
        settings = DetectorSettings(quantum=depth_step)
        self._detector = build_detector(load_jaws(parameters), parameters, settings, DotSettings())

    def _look(self, state: TwinState) -> Mapping[str, Observation]:
        shot = self._simulated_camera.shoot(state, self._before)
        self._before = state
        image = RgbdImage(stamp=state.stamp, color=shot.color, depth=shot.depth, camera=self._camera)
        found = self._detector.detect(image)
        return {side: observe_found(state.stamp, one) for side, one in found.items()}
