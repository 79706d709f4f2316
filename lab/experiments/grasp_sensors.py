"""What sees a grasp of the twin in stepped time: the whole chain, on key points with noise or on rendered images."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from finforce.messages import magnitude_stddev
from finforce_contact.estimator import ContactEstimator
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.grasp_force import R_GRIPPER_JAW
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.observation import Observation, Solution
from finforce_ifea.settings import EstimatorSettings
from finforce_keypoints.build import build_detector
from finforce_keypoints.detectors.dots import DotSettings
from finforce_keypoints.geometry.jaw_localizer import JawKeypoints
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.parameters import DetectorParameters, load_jaws
from finforce_keypoints.settings import DetectorSettings
from finforce_sim.gripper.footage import disturb_pose, parse_size, set_stage
from finforce_sim.gripper.gripper import TwinState
from finforce_sim.gripper.pressing import PressedGrasp
from finforce_sim.rendering.photographer import Photographer
from lab.experiments.grasp_world import Plant

POINT_NOISE = 0.15e-3  # [m] per axis, of a detected key point from image to image
POSE_PERIOD = 0.1  # [s] of the object's tracker


def build_plant(name: str, pressed: PressedGrasp) -> Plant:
    """Return the twin's fingers as a plant."""
    return Plant(
        name=name,
        force_at=pressed.elastic_force,
        touch_opening=pressed.touch_opening,
        terms=pressed.assembly.material.terms,
    )


def observe_found(stamp: float, keypoints: JawKeypoints) -> Observation:
    """Return what a solver is told of found key points: of those that are not valid no place."""
    points = np.where(keypoints.valid[:, None], keypoints.points, np.nan)
    return Observation(stamp=stamp, points=points, likelihood=keypoints.likelihood, stddev=keypoints.stddev)


class JawSensor:
    """Contact estimator and solver of one jaw, fed as their nodes are: with the surface of the image before."""

    def __init__(self, pressed: PressedGrasp, side: str) -> None:
        self._side = side
        self._solver = JawEstimator(
            pressed.assembly.jaws[side],
            settings=EstimatorSettings(held="yes"),  # as the nodes have it for two jaws
            calibration=load_calibration("twin"),
        )
        self._contacts = ContactEstimator(self._solver.jaw, mesh=pressed.assembly.object_mesh)
        self._solver.warm_up()
        self._last: Solution | None = None

    def take_pose(self, stamp: float, T_gripper_object: NDArray, origin_x: float) -> None:
        """Take a pose of the object in the gripper's frame, where the jaw's origin is at x [m]."""
        T_jaw_gripper = np.eye(4)
        T_jaw_gripper[:3, :3] = R_GRIPPER_JAW[self._side].T
        T_jaw_gripper[:3, 3] = -T_jaw_gripper[:3, 0] * origin_x
        self._contacts.take_pose(stamp, T_jaw_gripper @ T_gripper_object)

    def solve(self, observation: Observation) -> Solution:
        """Return what the solver says of key points; `touching` says what it was told."""
        last = self._last
        surface = None if last is None or not last.trusted else self._solver.surface()
        wrench = None if surface is None else (last.force, last.torque)
        estimate = self._contacts.update(observation.stamp, surface, wrench)
        self.touching = estimate.touching
        self._last = self._solver.update(observation, estimate.contact)
        return self._last


class EstimatorSensor:
    """The force that the whole chain finds from the true key points with noise, of both jaws as the nodes pair them.

    Attributes:
        touching: whether a jaw was said to touch in the last image.
        stddev: of the jaw whose force is less certain, as the driver takes it from `wrench_stddev` [N].
        untold: time [s] of every image without a force since the first one with, and what the jaws said.
    """

    def __init__(self, pressed: PressedGrasp, seed: int) -> None:
        self._pressed, self._random = pressed, np.random.default_rng(seed)
        self._jaws = {side: JawSensor(pressed, side) for side in pressed.assembly.jaws}
        self._next_pose = 0.0
        self.touching: bool | None = None
        self.stddev = 0.0
        self.untold: list[tuple[float, str]] = []
        self._has_told = False

    def measure(self, stamp: float, force: float, opening: float) -> float | None:
        """Return min(|F_left|, |F_right|), None unless both are trusted."""
        state = self._pressed.state(opening, stamp)
        if stamp >= self._next_pose:
            self._next_pose = stamp + POSE_PERIOD
            pose = disturb_pose(state.T_gripper_object, self._random)
            for side, jaw in self._jaws.items():
                jaw.take_pose(stamp, pose, state.jaws[side].origin_x)
        seen = self._look(state)
        solutions = {side: jaw.solve(seen[side]) for side, jaw in self._jaws.items() if side in seen}
        silent = {side: "not found in the image" for side in self._jaws if side not in solutions}
        if not silent:
            self.touching = any(jaw.touching for jaw in self._jaws.values())
        silent |= {side: f"{one.status}: {one.message}" for side, one in solutions.items() if not one.trusted}
        if silent:
            if self._has_told:
                self.untold.append((stamp, "; ".join(f"{side} {words}" for side, words in silent.items())))
            return None
        self._has_told = True
        self.stddev = max(magnitude_stddev(solution.force_stddev) for solution in solutions.values())
        return min(float(np.linalg.norm(solution.force)) for solution in solutions.values())

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
        self._photographer = Photographer(set_stage(pressed.assembly, self._camera, depth_step), seed)
        parameters = DetectorParameters()
        settings = DetectorSettings(quantum=depth_step)
        self._detector = build_detector(load_jaws(parameters), parameters, settings, DotSettings()).detector

    def _look(self, state: TwinState) -> Mapping[str, Observation]:
        shot = self._photographer.shoot(state)
        image = RgbdImage(stamp=state.stamp, color=shot.color, depth=shot.depth, camera=self._camera)
        found = self._detector.detect(image)
        return {side: observe_found(state.stamp, one) for side, one in found.items()}
