"""Turn images into the forces on a gripper: the whole chain for a program without nodes and recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce.camera import CameraIntrinsics, decode_depth
from finforce.camera_file import build_camera, camera_numbers, read_camera
from finforce.errors import ObservationError
from finforce.gripper_frames import SIDES, read_extrinsics
from finforce.messages import check_direction
from finforce.rig import read_rig
from finforce.transforms import check_pose, invert_pose, pose_numbers
from finforce_contact.estimator import ContactEstimator
from finforce_contact.loop import ForceLoop, GivenContact
from finforce_contact.mesh.object_mesh import ObjectMesh, load_object_mesh
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.keypoint_source import build_records
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.grasp_force import Wrench, combine_wrenches, single_jaw_grasp, to_jaw
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.observation import Contact, Observation, Solution, check_stamp
from finforce_ifea.payload import Payload
from finforce_ifea.posture import WristPosture, check_posture
from finforce_ifea.settings import EstimatorSettings
from finforce_keypoints.build import build_detector
from finforce_keypoints.geometry.jaw_localizer import JawKeypoints
from finforce_keypoints.images import RgbdImage

Camera = CameraIntrinsics | str | Path | ArrayLike


@dataclass(frozen=True, kw_only=True, eq=False)
class GripperForces:
    """Forces on the gripper in one image.

    Attributes:
        stamp: image capture time [s].
        jaws: side -> force, torque, standard deviations and status of that jaw, in the frame of the jaw. A jaw that was
            not found is absent.
        status: "ok", else the reason why the force of a jaw cannot be trusted; then there is no grasp force.
        grasp: grasp force [N], the smaller of the two jaw forces; NaN unless `status` is "ok".
        grasp_stddev: standard deviation of the grasp force [N].
        manipulation: (3,) net force that the object applies to the gripper [N], in `gripper_base`.
        manipulation_stddev: (3,) its standard deviation [N].
    """

    stamp: float
    jaws: Mapping[str, Solution]
    status: str
    grasp: float = np.nan
    grasp_stddev: float = np.nan
    manipulation: NDArray = field(default_factory=lambda: np.full(3, np.nan))
    manipulation_stddev: NDArray = field(default_factory=lambda: np.full(3, np.nan))


class ForceSensor:
    """Estimates the forces on a gripper from the images of its wrist camera, one image after the other.

    Attributes:
        camera: intrinsics, or their source until the size of the images is known.

    Args:
        jaw: name of an included jaw, a jaw file, or a left jaw; None for the jaw of the rig, else "bench".
        camera: intrinsics, a file with them, a (3, 3) matrix [px], or the numbers fx, fy, cx, cy [px], optionally
            followed by k1, k2, p1, p2, k3.
        extrinsics: camera pose in `gripper_base`: a (4, 4) matrix, the seven numbers x, y, z [m], qx, qy, qz, qw, or
            "robot" or "bench", the cameras of the simulator.
        rig: file written by `finforce camera`, instead of jaw, camera and extrinsics.
        contact_height: height of first touch above the clamped base [m].
        object_mesh: mesh of the object [m], or its file, instead of the height; `update` then needs the object's pose.
        calibration: calibration of the finger, its file or an included name; None for the material of the jaw file.
        sides: jaws in the images.
        detector: parameters of the detector that differ from the defaults, by the names that `--detector` takes.
        settings: settings of the estimator, or only those that differ from the defaults, by name.
        is_video: True if the images come from a video, where a scene at rest may repeat itself bit by bit.

    Raises:
        FinforceError: one of these cannot be used.
    """

    def __init__(
        self,
        jaw: str | Path | Jaw | None = None,
        *,
        camera: Camera | None = None,
        extrinsics: str | ArrayLike | None = None,
        rig: str | Path | None = None,
        contact_height: float | None = None,
        object_mesh: str | Path | ObjectMesh | None = None,
        calibration: str | Path | Calibration | None = None,
        sides: Sequence[str] = SIDES,
        detector: Mapping[str, Any] | None = None,
        settings: EstimatorSettings | Mapping[str, Any] | None = None,
        is_video: bool = False,
    ) -> None:
        if (contact_height is None) == (object_mesh is None):
            raise OptionError("expected contact_height [m] or object_mesh, one of the two")
        if (rig is None) == (camera is None) or (rig is None) == (extrinsics is None):
            raise OptionError("expected rig, or camera and extrinsics, one of the two")
        if rig is not None:
            found = read_rig(rig)
            parameters = found.detector_parameters()
            jaw, camera = jaw or found.jaw, found.intrinsics
        else:
            parameters = {"T_gripper_camera": pose_numbers(read_extrinsics(extrinsics))}
        self.camera = camera
        jaws = {side: load_jaw(jaw or "bench", side) for side in sides}
        records = build_records({**parameters, **(detector or {})})
        self._detector, self._is_video = build_detector(jaws, *records), is_video
        whole = settings if isinstance(settings, EstimatorSettings) else EstimatorSettings(**(settings or {}))
        settings = whole.resolve_held(both=len(sides) == len(SIDES))
        mesh = None if object_mesh is None else load_object_mesh(object_mesh)
        self._loops: dict[str, ForceLoop] = {}
        self._payload, self._may_be_held = Payload(), settings.may_be_held
        for side, own in jaws.items():
            force = ForceEstimator(own, settings=settings, calibration=calibration)
            fixed = mesh is None and GivenContact(Contact.fixed(force.jaw, contact_height))
            self._loops[side] = ForceLoop(fixed or ContactEstimator(force.jaw, mesh=mesh), force)

    def update(
        self,
        rgb: NDArray,
        depth: NDArray | None,
        stamp: float,
        T_camera_object: ArrayLike | None = None,
        gravity: ArrayLike | None = None,
        elevation: float = np.nan,
    ) -> GripperForces:
        """Return the forces in an image.

        The jaws must be unloaded in the first images, 45 by default, which give no force.

        Args:
            rgb: (h, w, 3) uint8.
            depth: (h, w) depth aligned to the colour image: floats in metres or integers in millimetres; None if there
                is none.
            stamp: image capture time [s], a float that rises from image to image. Divide frame numbers by the frame
                rate.
            T_camera_object: (4, 4) pose of the object's mesh in this image, if it is known.
            gravity: (3,) direction in which things fall, of any length, in `gripper_base`, if it is known. With it, a
                turn of the gripper tells what hangs from the jaws alone, and its weight; see `Payload`.
            elevation: of the gripper above any level [m], if it is known. With it and gravity, what was grasped is
                still where it lay until it is lifted or turned.

        Raises:
            ImageError: the image has another shape, shows nothing, or its stamp does not rise.
            ObservationError: the stamps are not in seconds, or gravity is no direction.
            PoseError: the matrix is no pose.
        """
        check_stamp(stamp)
        gravity = None if gravity is None else check_direction(gravity, "gravity")
        posture = None if gravity is None or not self._may_be_held else check_posture(WristPosture(gravity, elevation))
        if not isinstance(self.camera, CameraIntrinsics):
            self.camera = read_intrinsics(self.camera, rgb.shape[:2])
        if depth is not None:
            depth = decode_depth(depth, "16UC1" if np.asarray(depth).dtype.kind in "iu" else "32FC1")
        image = RgbdImage(stamp=stamp, color=rgb, depth=depth, camera=self.camera, is_video=self._is_video)
        seen = self._detector.detect(image)
        T = None if T_camera_object is None else check_pose(T_camera_object, "T_camera_object")
        found = {
            side: self._solve(loop, seen.get(side), stamp, T, to_jaw(posture, side))
            for side, loop in self._loops.items()
        }
        known = {side: found[side] if side in seen else None for side in found}
        return combine_solutions(stamp, known, self._payload, posture)

    def skip(self, stamp: float, reason: str) -> GripperForces:
        """Let time pass for an image at `stamp` [s] that `update` has rejected, and return a result without forces."""
        for loop in self._loops.values():
            with suppress(ObservationError):  # of a jaw that has taken the image before the other one rejected it
                self._solve(loop, None, stamp, None)
        return GripperForces(stamp=stamp, jaws={}, status=reason)

    def reset(self) -> None:
        """Forget all images, including the tare, before a new recording or episode."""
        self._detector.reset()
        self._payload.reset()
        for loop in self._loops.values():
            loop.force.forget()
            loop.contact.reset()

    def warm_up(self) -> None:
        """Compile and load everything ahead of the first image, and forget all images."""
        self._detector.warm_up()
        for loop in self._loops.values():
            loop.force.warm_up()
        self.reset()

    def _solve(
        self,
        loop: ForceLoop,
        seen: JawKeypoints | None,
        stamp: float,
        T_camera_object: NDArray | None,
        posture: WristPosture | None = None,
    ) -> Solution:
        """Return the force on one jaw, which may not have been found."""
        observation = replace(observe_jaw(seen, stamp, len(loop.force.jaw.keypoints)), posture=posture)
        if seen is None:
            return loop.update(observation)
        loop.follow_jaw(seen.T_camera_jaw)
        known = T_camera_object is not None
        return loop.update(observation, [(stamp, invert_pose(seen.T_camera_jaw) @ T_camera_object)] if known else ())


def observe_jaw(seen: JawKeypoints | None, stamp: float, count: int) -> Observation:
    """Return what an estimator is given of a jaw of so many key points in an image [s]; None: it was not found.

    Coordinates have single precision, as in the nodes' messages.
    """
    if seen is None:
        nothing = np.full((count, 3), np.nan)
        return Observation(stamp=stamp, points=nothing, likelihood=np.zeros(count), stddev=nothing)
    points = np.where(seen.valid[:, None], seen.points, np.nan).astype(np.float32).astype(np.float64)
    stddev = np.where(np.isfinite(points), seen.stddev, np.nan)
    return Observation(stamp=stamp, points=points, likelihood=seen.likelihood, stddev=stddev, shared=seen.shared)


def combine_solutions(
    stamp: float,
    found: Mapping[str, Solution | None],
    payload: Payload | None = None,
    posture: WristPosture | None = None,
) -> GripperForces:
    """Return what the solutions of one jaw or two in one image, None where a jaw was not seen, say of the gripper."""
    jaws = {side: solution for side, solution in found.items() if solution is not None}
    wrong = [
        f"{side} jaw {f'{each.status}: {each.message}' if each else 'not seen'}"
        for side, each in found.items()
        if each is None or not each.trusted
    ]
    if wrong:
        return GripperForces(stamp=stamp, jaws=jaws, status="; ".join(wrong))
    wrenches = {side: Wrench(each.force, each.torque) for side, each in jaws.items()}
    side, weakest = min(jaws.items(), key=lambda jaw: float(np.linalg.norm(jaw[1].force)))
    both = len(jaws) == len(SIDES)
    stddevs = [each.force_stddev for each in jaws.values()]
    if both:
        grasp = combine_wrenches(**wrenches, distance=None, stddevs=stddevs)
        grasp = grasp if payload is None else payload.update(grasp, stamp, posture)
    else:
        grasp = single_jaw_grasp(wrenches[side], side)
    return GripperForces(
        stamp=stamp,
        jaws=jaws,
        status="ok",
        grasp=float(grasp.grasp[0]),
        grasp_stddev=weakest.magnitude_stddev,
        manipulation=grasp.manipulation,
        manipulation_stddev=grasp.stddev if both else stddevs[0],
    )


def read_intrinsics(camera: str | Path | ArrayLike, shape: tuple[int, int]) -> CameraIntrinsics:
    """Return the camera of a file, a matrix or of numbers for images of some height and width."""
    if isinstance(camera, str | Path):
        return read_camera(camera, shape)
    return build_camera(camera_numbers(np.asarray(camera, dtype=float).ravel().tolist()), shape)
