"""The parameters of a key point detector node, and what they name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from numpy.typing import NDArray

from finforce.gripper_frames import ROBOT_CAMERA
from finforce.settings import TimeParameters, check_bounds, setting
from finforce.transforms import pose_from_quaternion, pose_numbers
from finforce_keypoints.errors import DetectorSettingsError

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

# as the RealSense driver calls them; the colour images of a D405 have had both names
CAMERA = "/camera/camera"
COLOR_TOPIC, OLD_COLOR_TOPIC = f"{CAMERA}/color/image_raw", f"{CAMERA}/color/image_rect_raw"
DEPTH_TOPIC = f"{CAMERA}/aligned_depth_to_color/image_raw"
INFO_TOPIC = f"{CAMERA}/color/camera_info"
DEPTHS = ALIGNED, AUTO, NO_DEPTH = ("aligned", "auto", "none")


@dataclass(frozen=True, kw_only=True)
class DetectorParameters(TimeParameters):
    """What a key point detector node is told beside the settings of its parts; units stand in the metadata."""

    jaws: str = setting("both", "the jaws that are looked for", choices=("left", "right", "both"))
    jaw_file: str = setting("bench", "jaw file, or the name of a shipped jaw")
    camera_frame: str = setting("camera_color_optical_frame", "frame of the images and of the jaws' poses")
    T_gripper_camera: tuple[float, ...] = setting(
        pose_numbers(ROBOT_CAMERA), "x, y, z [m], qx, qy, qz, qw of the colour camera in the gripper's frame"
    )
    color_topics: tuple[str, ...] = setting(
        (COLOR_TOPIC, OLD_COLOR_TOPIC),
        "colour images; the first topic that brings one is used, until it is silent; .../compressed: jpeg or png",
        topic=True,
    )
    depth_topic: str = setting(DEPTH_TOPIC, "depth images, aligned to the colour images", topic=True)
    depth: str = setting(
        ALIGNED,
        "aligned: every colour image needs its depth image; auto: one without is used alone; none: colour alone",
        choices=DEPTHS,
    )
    info_topic: str = setting(INFO_TOPIC, "intrinsics of the colour camera", topic=True)
    finder: str = setting(
        "network",
        "what finds the key points: a network that sees the jaws' side planes (the shipped one), any DeepLabCut "
        "network that sees the image, or printed dots without a network",
        choices=("network", "frame", "dots"),
    )
    model: str = setting("", "folder of a network; empty: the shipped one for the finger")
    names: tuple[str, ...] = setting(
        ("",),
        "body parts of a frame network whose names are not those of key points, each as BODYPART=NAME, as in "
        "'finger one=left_inner_1'; '-' for what is on no jaw",
    )
    stride: int = setting(0, "image pixels per heatmap cell; 0: as the network's files say", "px", 0, 64)
    locref_std: float = setting(0.0, "scale of the network's offsets; 0: as the network's files say", "px", 0.0, 1000.0)
    apply_sigmoid: str = setting(
        "auto", "whether heatmaps go through a sigmoid; auto: as the files say", choices=("auto", "yes", "no")
    )
    normalize: str = setting(
        "auto", "whether pictures are normalised; auto: as the files say", choices=("auto", "yes", "no")
    )
    input_size: tuple[int, ...] = setting(
        (0, 0), "height and width of the training's images [px]; zeros: as the network's files say"
    )
    allow_resize: bool = setting(False, "let a network see images of another size than its training's, letterboxed")
    threads: int = setting(2, "threads of the network", "1", 1, 64)
    depth_scale: float = setting(0.001, "one step of a 16-bit depth image", "m", 1e-6, 0.01)
    sync_tolerance: float = setting(
        0.008, "greatest distance between the stamps of a colour and a depth image that belong together", "s", 0.0, 0.1
    )
    skip_off: tuple[str, ...] = setting(
        ("",), "rules that are not applied, by their names in the diagnostics after `skipped:`, or all"
    )
    frozen_after: int = setting(
        2, "repetitions of a picture, to the bit, after which the camera counts as frozen", "1", 1, 1000
    )

    def __post_init__(self) -> None:
        """Refuse values that are not among their choices or out of their bounds.

        Raises:
            DetectorSettingsError: there is one, or no colour topic is named, or `input_size` is not two sizes.
        """
        check_bounds(self, DetectorSettingsError)
        if not any(self.color_topics):
            raise DetectorSettingsError(f"color_topics: got {self.color_topics}, expected at least one topic")
        if len(self.input_size) != 2 or min(self.input_size) < 0:
            raise DetectorSettingsError(
                f"input_size: got {tuple(self.input_size)}, expected height and width [px], or two zeros"
            )

    @property
    def sides(self) -> tuple[str, ...]:
        """The jaws by name."""
        return ("left", "right") if self.jaws == "both" else (self.jaws,)

    @property
    def camera_pose(self) -> NDArray:
        """T_gripper_camera (4, 4); raises PoseError unless it is seven finite numbers with a unit quaternion."""
        return pose_from_quaternion(self.T_gripper_camera[:3], self.T_gripper_camera[3:])


def is_compressed(topic: str) -> bool:
    """Say whether a colour topic is one of pictures, as image transport calls them."""
    return topic.endswith("/compressed")


def load_jaws(parameters: DetectorParameters) -> dict[str, Jaw]:
    """Load the jaws that the parameters name, by side.

    Raises:
        JawFileError: the file cannot be a jaw.
    """
    from finforce_ifea.jaw.jaw import load_jaw

    return {side: load_jaw(parameters.jaw_file, side) for side in parameters.sides}
