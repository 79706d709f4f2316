"""The parameters of a key point detector node and its settings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC, OLD_COLOR_TOPIC, TRANSPORTS, relative
from finforce.gripper_frames import ROBOT_CAMERA, check_camera
from finforce.settings import GripperParameters, check_bounds, setting
from finforce.transforms import pose_from_quaternion, pose_numbers
from finforce_keypoints.errors import DetectorSettingsError, GeometryError
from finforce_keypoints.tags import FAMILIES, Tag, read_tag

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

REFERENCE = "reference"  # the name of the reference point, the last row of every detection
LARGEST_TURN = 0.3  # [rad]
DEPTHS = ALIGNED, AUTO, NO_DEPTH = ("aligned", "auto", "none")


@dataclass(frozen=True, kw_only=True)
class DetectorParameters(GripperParameters):
    """Parameters of a key point detector node, in addition to the settings of its parts."""

    jaws: str = setting("both", "Jaws to detect", choices=("left", "right", "both"))
    jaw_file: str = setting("bench", "Jaw file, or name of an included jaw")
    camera_frame: str = setting("", "Frame of the images and jaw poses; empty: that of the first image")
    T_gripper_camera: tuple[float, ...] = setting(
        pose_numbers(ROBOT_CAMERA),
        "Pose of the colour camera in the gripper frame: x, y, z [m], qx, qy, qz, qw; if not set, from /tf if possible",
    )
    left_stddev: tuple[float, ...] = setting(
        (0.0, 0.0),
        "Standard deviations of the left jaw's place along its z [m] and of the scale at which it is seen [-], as in a "
        "rig file",
    )
    right_stddev: tuple[float, ...] = setting((0.0, 0.0), "Standard deviations of the right jaw, likewise")
    left_turn: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "Rotation vector of the left jaw against the gripper axes, in the jaw frame [rad]"
    )
    right_turn: tuple[float, ...] = setting((0.0, 0.0, 0.0), "Rotation vector of the right jaw, likewise [rad]")
    covered: tuple[str, ...] = setting(
        ("",), "Key points hidden by the holder, each as SIDE/NAME, such as left/outer_1 or left/reference"
    )
    left_tag: tuple[float, ...] = setting(
        (math.nan,),
        "Tag fixed to the left jaw: number, then x, y, z of its four corners in the jaw frame [m]; NaN: none",
    )
    right_tag: tuple[float, ...] = setting((math.nan,), "Tag fixed to the right jaw, likewise [m]")
    tag_family: str = setting("4x4_50", "Family of the tags", choices=FAMILIES)
    likelihood_odds: float = setting(
        1.0, "Factor on the odds of likelihoods of small or unusual fingers, as a rig file has it", "1", 1.0, 20.0
    )
    publish_tf: bool = setting(True, "Whether jaw poses are published on /tf, if tf2_ros is installed")
    image_transport: str = setting(
        AUTO,
        "Transport of images: raw, compressed (topics .../compressed and .../compressedDepth), or auto (compressed if "
        "there are no raw images)",
        choices=TRANSPORTS,
    )
    color_topics: tuple[str, ...] = setting(
        (relative(COLOR_TOPIC), relative(OLD_COLOR_TOPIC)),
        "Colour image topics; the first one with an image is used until it is silent; .../compressed: jpeg, png, H.264",
        topic=True,
    )
    depth_topic: str = setting(relative(DEPTH_TOPIC), "Topic of depth images aligned to the colour images", topic=True)
    depth: str = setting(
        AUTO,
        "Use of depth: auto (if available), aligned (required for every colour image), none",
        choices=DEPTHS,
    )
    info_topic: str = setting(relative(INFO_TOPIC), "Topic of the colour camera's intrinsics", topic=True)
    detection_method: str = setting(
        "network",
        "Pixel detector: network (on rectified side planes), frame (a DeepLabCut network on the whole image), dots "
        "(printed dots, no network)",
        choices=("network", "frame", "dots"),
    )
    model: str = setting("", "Folder of the network; empty: the included one for the finger")
    names: tuple[str, ...] = setting(
        ("",),
        "Body parts of a frame network, each as BODYPART=NAME, such as 'finger one=left_inner_1'; NAME '-' ignores it",
    )
    allow_resize: bool = setting(False, "Whether images of another size than in training are scaled for the network")
    threads: int = setting(2, "Number of network threads", "1", 1, 64)
    depth_scale: float = setting(0.001, "Unit of 16-bit depth images", "m", 1e-6, 0.01)
    sync_tolerance: float = setting(
        math.nan,
        "Maximum stamp difference between a colour image and its depth image; NaN: half the camera's period",
        "s",
        0.0,
        0.1,
    )
    skip_off: tuple[str, ...] = setting(("",), "Disabled skip rules, as named in the diagnostics, or all")

    def __post_init__(self) -> None:
        """Refuse values that are not among their choices or out of their bounds.

        Raises:
            DetectorSettingsError: there is one, or no colour topic is named.
        """
        check_bounds(self, DetectorSettingsError)
        if not any(self.color_topics):
            raise DetectorSettingsError(f"color_topics: got {self.color_topics}, expected at least one topic")

    @property
    def sides(self) -> tuple[str, ...]:
        """The jaws by name."""
        return ("left", "right") if self.jaws == "both" else (self.jaws,)

    @property
    def camera_pose(self) -> NDArray:
        """T_gripper_camera (4, 4); raises PoseError unless it is seven finite numbers with a unit quaternion."""
        return check_camera(pose_from_quaternion(self.T_gripper_camera[:3], self.T_gripper_camera[3:]))


@dataclass(frozen=True, kw_only=True, eq=False)
class JawMount:
    """The mounting of one jaw in the gripper, and the part that its holder covers.

    Attributes:
        turn: rotation vector (3,) against the gripper's axes, jaw frame [rad].
        covered: names of the key points that are never seen, "reference" for the reference point.
        odds: factor on the odds of likelihoods: a network is less sure of small fingers than it could be.
        tag: that is fixed to its holder; None without one.
        stddev: standard deviations (2,) of its place along its z [m] and of the scale at which it is seen [-].
    """

    turn: NDArray = field(default_factory=lambda: np.zeros(3))
    covered: frozenset[str] = frozenset()
    odds: float = 1.0
    tag: Tag | None = None
    stddev: tuple[float, ...] = (0.0, 0.0)

    def seen_points(self, jaw: Jaw) -> NDArray[np.bool_]:
        """Return which of a jaw's key points, the reference point last, are not covered (K + 1,)."""
        return np.array([name not in self.covered for name in (*jaw.keypoint_names, REFERENCE)])

    @property
    def is_held(self) -> bool:
        """True if a jaw's place is told by its tag and all points that are seen, as its reference point is covered."""
        return self.tag is not None or REFERENCE in self.covered

    def believe(self, likelihood: NDArray) -> NDArray:
        """Return likelihoods whose odds are multiplied."""
        return self.odds * likelihood / (1.0 - likelihood + self.odds * likelihood)


def find_mounts(parameters: DetectorParameters, jaws: Mapping[str, Jaw]) -> dict[str, JawMount]:
    """Return how the jaws, by side, are mounted.

    Raises:
        DetectorSettingsError: a turn is no three numbers, a deviation no two, a tag none, or `covered` names a point
            that the jaw does not have.
    """
    mounts = {}
    stated = {
        "left": (parameters.left_turn, parameters.left_tag, parameters.left_stddev),
        "right": (parameters.right_turn, parameters.right_tag, parameters.right_stddev),
    }
    for side, jaw in jaws.items():
        turn, tag, stddev = stated[side]
        turn = np.array(turn, dtype=float)
        if turn.shape != (3,) or not np.linalg.norm(turn) <= LARGEST_TURN:
            raise DetectorSettingsError(
                f"{side}_turn: got {turn.tolist()}, expected a rotation vector of three numbers, at most "
                f"{LARGEST_TURN:g} rad long"
            )
        covered = frozenset(name.partition("/")[2] for name in parameters.covered if name.startswith(f"{side}/"))
        unknown = sorted(covered - {*jaw.keypoint_names, REFERENCE})
        if unknown:
            raise DetectorSettingsError(
                f"covered: got {', '.join(unknown)} of the {side} jaw, expected names of key points of the jaw "
                f"'{jaw.name}' or {REFERENCE}"
            )
        try:
            tag = read_tag(tag)
        except GeometryError as error:
            raise DetectorSettingsError(f"{side}_tag: {error}") from error
        if len(stddev) != 2 or not all(0.0 <= each < np.inf for each in stddev):
            raise DetectorSettingsError(f"{side}_stddev: got {stddev}, expected two numbers from zero up")
        mounts[side] = JawMount(turn=turn, covered=covered, odds=parameters.likelihood_odds, tag=tag, stddev=stddev)
    return mounts


@dataclass(frozen=True, kw_only=True)
class DetectorSettings:
    """Settings of `KeypointDetector`."""

    likelihood: float = setting(0.6, "Minimum likelihood of a key point", "1", 0.0, 1.0, settable=True)
    plane_depth: bool = setting(False, "Whether key points without depth are placed on the plane of the jaw's side")
    quantum: float = setting(1e-3, "Step of the depth image", "m", 0.0, 0.01)
    scale_stddev: float = setting(0.015, "Common relative error of all depths of a camera (1 sigma)", "1", 0.0, 0.1)
    workspace_closing: float = setting(
        0.025, "Maximum displacement of a key point along the closing axis", "m", 1e-3, 0.5
    )
    workspace_width: float = setting(4e-3, "Maximum displacement of a key point along the jaw's y", "m", 1e-4, 0.5)
    workspace_length: float = setting(0.012, "Maximum displacement of a key point along the jaw's z", "m", 1e-3, 0.5)
    readout: float = setting(
        0.0,
        "Readout time of a rolling shutter, from the exposure of the first row to that of the last, the stamp",
        "s",
        0.0,
        0.1,
    )
    opening_min: float = setting(0.010, "Minimum distance of a jaw from the middle of the grasp", "m", 0.0, 0.5)
    opening_max: float = setting(0.080, "Maximum distance of a jaw from the middle of the grasp", "m", 1e-3, 0.5)
    largest_speed: float = setting(0.3, "Maximum closing speed of a jaw", "m/s", 1e-3, 10.0)
    reference_tolerance: float = setting(
        5e-3, "Maximum distance of a reference point from its line of motion", "m", 1e-4, 0.1
    )
    largest_offset: float = setting(
        0.015,
        "Maximum distance of the middle between two jaws from the gripper's",
        "m",
        1e-3,
        1.0,
    )
    rest_tolerance: float = setting(
        1.1e-3,
        "Maximum distance of key points at rest from the jaw file (RMS) without a warning",
        "m",
        1e-4,
        0.1,
        settable=True,
    )
    lost_images: int = setting(5, "Number of images without a jaw or its key points until it is lost", "1", 1, 1000)

    def __post_init__(self) -> None:
        """Refuse values out of bounds.

        Raises:
            DetectorSettingsError: a setting is outside its bounds, or a lower bound is above its upper one.
        """
        check_bounds(self, DetectorSettingsError)
        if self.opening_max <= self.opening_min:
            raise DetectorSettingsError(
                f"opening_max: got {self.opening_max:g} m, expected more than opening_min, {self.opening_min:g} m"
            )


def load_jaws(parameters: DetectorParameters) -> dict[str, Jaw]:
    """Load the jaws that the parameters name, by side.

    Raises:
        JawFileError: the file cannot be a jaw.
    """
    from finforce_ifea.jaw.jaw import load_jaw

    return {side: load_jaw(parameters.jaw_file, side) for side in parameters.sides}
