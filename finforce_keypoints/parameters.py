"""The parameters of a key point detector node, and what they name; knows no ROS."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from finforce_contact.poses import pose_from_quaternion, quaternion_from_pose
from finforce_keypoints.gripper_geometry import ROBOT_CAMERA

if TYPE_CHECKING:
    from finforce_ifea.jaw import Jaw

CAMERA = "/camera/camera"


def _parameter(default: Any, description: str, **metadata: Any) -> Any:
    """Return a dataclass field that says what it is; `metadata` are unit, min, max and choices."""
    return field(default=default, metadata={"description": description, **metadata})


def pose_numbers(T: NDArray) -> tuple[float, ...]:
    """Return a pose (4, 4) as x, y, z [m], qx, qy, qz, qw."""
    return tuple(float(number) for number in (*T[:3, 3], *quaternion_from_pose(T)))


@dataclass(frozen=True, kw_only=True)
class DetectorParameters:
    """What a key point detector node is told beside the settings of its parts; units stand in the metadata."""

    jaws: str = _parameter("both", "the jaws that are looked for", choices=("left", "right", "both"))
    jaw_file: str = _parameter("bench", "jaw file, or the name of a shipped jaw")
    camera_frame: str = _parameter("camera_color_optical_frame", "frame of the images and of the jaws' poses")
    T_gripper_camera: tuple[float, ...] = _parameter(
        pose_numbers(ROBOT_CAMERA), "x, y, z [m], qx, qy, qz, qw of the colour camera in the gripper's frame"
    )
    color_topics: tuple[str, ...] = _parameter(
        (f"{CAMERA}/color/image_raw", f"{CAMERA}/color/image_rect_raw"),
        "colour images; the first topic that brings one is used, the D405 has had both names",
    )
    depth_topic: str = _parameter(
        f"{CAMERA}/aligned_depth_to_color/image_raw", "depth images, aligned to the colour images"
    )
    info_topic: str = _parameter(f"{CAMERA}/color/camera_info", "intrinsics of the colour camera")
    finder: str = _parameter(
        "network",
        "what finds the key points: a network that sees the jaws' side planes (the shipped one), any DeepLabCut "
        "network that sees the image, or printed dots without a network",
        choices=("network", "frame", "dots"),
    )
    model: str = _parameter("", "folder of a network and its pytorch_config.yaml; empty: the shipped network")
    names: tuple[str, ...] = _parameter(
        ("",),
        "body parts of a frame network whose names are not those of key points, each as BODYPART=NAME, as in "
        "'finger one=left_inner_1'; '-' for what is on no jaw",
    )
    stride: int = _parameter(
        0, "image pixels per heatmap cell; 0: as the network's files say", unit="px", min=0, max=64
    )
    locref_std: float = _parameter(
        0.0, "scale of the network's offsets; 0: as the network's files say", unit="px", min=0.0, max=1000.0
    )
    apply_sigmoid: str = _parameter(
        "auto", "whether heatmaps go through a sigmoid; auto: as the files say", choices=("auto", "yes", "no")
    )
    normalize: str = _parameter(
        "auto", "whether pictures are normalised; auto: as the files say", choices=("auto", "yes", "no")
    )
    input_size: tuple[int, ...] = _parameter(
        (0, 0), "height and width of the training's images [px]; zeros: as the network's files say"
    )
    allow_resize: bool = _parameter(False, "let a network see images of another size than its training's, letterboxed")
    threads: int = _parameter(2, "threads of the network", unit="1", min=1, max=64)
    depth_scale: float = _parameter(0.001, "one step of a 16-bit depth image", unit="m", min=1e-6, max=0.01)
    sync_tolerance: float = _parameter(
        0.008,
        "greatest distance between the stamps of a colour and a depth image that belong together",
        unit="s",
        min=0.0,
        max=0.1,
    )
    frozen_after: int = _parameter(
        2, "repetitions of a picture, to the bit, after which the camera counts as frozen", unit="1", min=1, max=1000
    )
    max_age: float = _parameter(0.2, "greatest age of data at the time of publishing", unit="s", min=0.001, max=60.0)
    restart_gap: float = _parameter(
        1.0, "stamps that go back by more than this begin a new recording", unit="s", min=0.001, max=3600.0
    )
    diagnostics_period: float = _parameter(1.0, "time between diagnostics", unit="s", min=0.05, max=60.0)

    @property
    def sides(self) -> tuple[str, ...]:
        """The jaws by name."""
        return ("left", "right") if self.jaws == "both" else (self.jaws,)

    @property
    def camera_pose(self) -> NDArray:
        """T_gripper_camera (4, 4); raises PoseError unless it is seven finite numbers with a unit quaternion."""
        return pose_from_quaternion(self.T_gripper_camera[:3], self.T_gripper_camera[3:])


def load_jaws(parameters: DetectorParameters) -> dict[str, Jaw]:
    """Load the jaws that the parameters name, by side.

    Raises:
        JawFileError: the file cannot be a jaw.
    """
    from finforce_ifea.jaw import load_jaw

    return {side: load_jaw(parameters.jaw_file, side) for side in parameters.sides}
