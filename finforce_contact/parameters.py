"""Parameters of a contact estimator node and settings of its parts: defaults, units, bounds and meanings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from finforce.camera_topics import AUTO, DEPTH_TOPIC, INFO_TOPIC, TRANSPORTS, relative
from finforce.errors import PoseError
from finforce.settings import Bounded, TimeParameters, setting
from finforce_ifea.errors import ContactError
from finforce_ifea.settings import MESHES

if TYPE_CHECKING:
    from finforce_contact.reconstruction.evidence import GeneratedMesh
    from finforce_ifea.jaw.jaw import Jaw


MODES = ("estimate", "paper", "closest")
# How many times the middle of the mesh's bounding box, in the mesh's axes, is taken off a pose: some trackers tell that
# of the middle, and isaac_ros_foundationpose up to release 4.4 adds the middle where it ought to be taken off.
ORIGINS = {"mesh": 0.0, "middle": 1.0, "added": 2.0}


@dataclass(frozen=True, kw_only=True)
class ContactSettings(Bounded):
    """Settings of `ContactEstimator`; each field's metadata says unit, bounds and meaning.

    Raises:
        ContactError: a setting is not among its choices or outside its bounds.
    """

    error = ContactError
    mode: str = setting(
        "estimate",
        "Method of finding the contact: estimate, paper (Algorithm 1) or closest (nearest point)",
        choices=MODES,
    )
    mesh: str = setting("default", "Mesh density of a drawn jaw, with mode paper as in the solver", choices=MESHES)
    pose_noise: float = setting(0.3e-3, "Initial noise of object positions (1 sigma)", "m", 1e-6, 0.05)
    rotation_noise: float = setting(6e-3, "Initial noise of object rotations (1 sigma)", "rad", 1e-5, 0.5)
    pose_bias: float = setting(0.5e-3, "Constant error of object positions (1 sigma)", "m", 0.0, 0.05)
    rotation_bias: float = setting(5e-3, "Constant error of object rotations (1 sigma)", "rad", 0.0, 0.5)
    slip_speed: float = setting(1.5e-3, "Minimum speed of a sliding object", "m/s", 1e-4, 0.1)
    symmetry: str = setting(
        "auto", "Object symmetry: auto, none, or turns such as 'x_180 z_full' about the axes of the mesh's frame"
    )
    pose_timeout: float = setting(1.0, "Maximum object pose age, a tenth of that of a held object", "s", 0.01, 60.0)


@dataclass(frozen=True, kw_only=True)
class TrackerSettings(Bounded):
    """Settings of `PoseTracker`; each field's metadata says unit, bounds and meaning.

    Raises:
        PoseError: a setting is outside its bounds.
    """

    error = PoseError
    points: int = setting(1000, "Object pixels compared per image", "1", 100, 20000)
    noise: float = setting(0.3e-3, "Minimum standard deviation of the depth", "m", 1e-5, 0.01)
    least_fitness: float = setting(0.6, "Minimum share of the visible object that agrees with the depth", "1", 0.1, 1.0)
    least_visible: float = setting(0.1, "Minimum share of the object in view that is not occluded", "1", 0.01, 1.0)
    speed: float = setting(0.2, "Expected object speed (1 sigma)", "m/s", 0.001, 5.0)
    turn_rate: float = setting(1.0, "Expected object turn rate (1 sigma)", "rad/s", 0.01, 20.0)


IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class ContactParameters(TimeParameters):
    """Parameters of a contact estimator node, in addition to the settings of its parts; metadata holds units."""

    jaws: str = setting("left", "Jaws to estimate contacts for", choices=("left", "right", "both"))
    jaw_file: str = setting("bench", "Jaw file, or name of an included jaw")
    calibration_file: str = setting("", "Calibration file, or name of an included one, as for the solvers; empty: none")
    camera_frame: str = setting("", "Frame of poses and images; empty: that of the first jaw pose or image")
    object_mesh: str = setting("", "Mesh file of the object, reread by load_mesh; empty: unknown", settable=True)
    object_mesh_unit: str = setting("m", "Unit of the object mesh", choices=("m", "cm", "mm", "inch"), settable=True)
    pose_source: str = setting(
        "topic",
        "Source of object poses: PoseStamped on object_pose, Detection3DArray on object_detections, or the built-in "
        "tracker",
        choices=("topic", "detections", "tracker"),
    )
    pose_origin: str = setting(
        "mesh",
        "Origin of external poses: mesh, middle (of the bounding box), or added (the middle is added instead of "
        "subtracted, as by isaac_ros_foundationpose up to release 4.4)",
        choices=tuple(ORIGINS),
    )
    compare_mesh: bool = setting(
        True, "Whether the mesh, in poses from outside, is compared with depth images; a contradiction gives no contact"
    )
    pose_tolerance: float = setting(
        0.017, "Maximum stamp difference between a jaw pose and its object pose", "s", 0.0, 1.0
    )
    depth_topic: str = setting(
        relative(DEPTH_TOPIC), "Topic of depth images for the tracker and the comparison", topic=True
    )
    info_topic: str = setting(relative(INFO_TOPIC), "Topic of the intrinsics of the depth images", topic=True)
    image_transport: str = setting(AUTO, "Transport of images, as for the detector", choices=TRANSPORTS)
    depth_scale: float = setting(0.001, "Unit of 16-bit depth images", "m", 1e-6, 0.01)
    reconstruct_method: str = setting(
        "",
        "Method of reconstruct; empty: robust with a generated mesh, else primitive if it fits, else completion",
        choices=("", "robust", "paper", "primitive", "completion"),
        settable=True,
    )
    generated_mesh: str = setting("", "Mesh file from a generator, for reconstruct; empty: none", settable=True)
    generated_pose: tuple[float, ...] = setting(
        IDENTITY, "Pose of the generated mesh in the camera frame: x, y, z [m], qx, qy, qz, qw", settable=True
    )
    generated_scale: float = setting(1.0, "Length of the generated mesh's unit", "m", 1e-6, 1e6, settable=True)
    skip_off: tuple[str, ...] = setting(("",), "Disabled skip rules, as named in the diagnostics, or all")

    @property
    def sides(self) -> tuple[str, ...]:
        """The jaws by name."""
        return ("left", "right") if self.jaws == "both" else (self.jaws,)

    @property
    def tracks(self) -> bool:
        """True if the object's pose is found here, from depth images."""
        return self.pose_source == "tracker"


def load_jaws(parameters: ContactParameters) -> dict[str, Jaw]:
    """Load the jaws that the parameters name, calibrated as the solvers' are, by side.

    Raises:
        JawFileError: the file cannot be a jaw.
        CalibrationError: the file is no calibration, or belongs to another jaw.
    """
    from finforce_ifea.jaw.calibration import load_calibration
    from finforce_ifea.jaw.jaw import load_jaw

    file = parameters.calibration_file
    apply = load_calibration(file).apply if file else lambda jaw: jaw
    return {side: apply(load_jaw(parameters.jaw_file, side)) for side in parameters.sides}


def load_generated(parameters: ContactParameters) -> GeneratedMesh | None:
    """Load the generated mesh that the parameters name, with its pose and scale; None without a name.

    Raises:
        ObjectMeshError: the file is no mesh.
        PoseError: the pose is not seven finite numbers with a unit quaternion.
    """
    from finforce.transforms import pose_from_quaternion
    from finforce_contact.reconstruction.evidence import GeneratedMesh
    from finforce_contact.reconstruction.generated import read_generated

    if not parameters.generated_mesh:
        return None
    vertices, triangles = read_generated(parameters.generated_mesh)
    affine = pose_from_quaternion(parameters.generated_pose[:3], parameters.generated_pose[3:])
    affine[:3, :3] *= parameters.generated_scale
    name = Path(parameters.generated_mesh).name
    return GeneratedMesh(vertices=vertices, triangles=triangles, affine=affine, name=name)
