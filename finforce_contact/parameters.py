"""The parameters of a contact estimator node, and what they ask for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from finforce.settings import TimeParameters, setting
from finforce_contact.pose.source import ORIGINS

if TYPE_CHECKING:
    from finforce_contact.reconstruction.result import GeneratedMesh
    from finforce_ifea.jaw.jaw import Jaw

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class ContactParameters(TimeParameters):
    """Parameters of a contact estimator node, in addition to the settings of its parts; metadata holds units."""

    jaws: str = setting("left", "Jaws whose contacts are estimated", choices=("left", "right", "both"))
    jaw_file: str = setting("bench", "Jaw file, or name of a shipped jaw")
    calibration_file: str = setting("", "Calibration file or name of a shipped one, as for the solvers; empty for none")
    camera_frame: str = setting("camera_color_optical_frame", "Frame of poses and images")
    object_mesh: str = setting(
        "", "Mesh file of the object, read again by load_mesh; empty when it is unknown", settable=True
    )
    object_mesh_unit: str = setting("m", "Unit of the object mesh", choices=("m", "cm", "mm", "inch"), settable=True)
    pose_source: str = setting(
        "topic",
        "Source of object poses: PoseStamped on object_pose, Detection3DArray on object_detections, or the built-in "
        "tracker",
        choices=("topic", "detections", "tracker"),
    )
    pose_origin: str = setting(
        "mesh",
        "Origin of poses from other programs: that of the mesh, the middle of its box, or the origin with the middle "
        "added where it should be subtracted, as isaac_ros_foundationpose does up to release 4.4",
        choices=tuple(ORIGINS),
    )
    pose_tolerance: float = setting(
        0.017, "Maximum stamp difference between a jaw pose and its object pose", "s", 0.0, 1.0
    )
    depth_scale: float = setting(0.001, "Unit of 16-bit depth images", "m", 1e-6, 0.01)
    reconstruct_method: str = setting(
        "",
        "Method of reconstruct; empty for robust with a generated mesh, else a primitive where it fits, else "
        "completion",
        choices=("", "robust", "paper", "primitive", "completion"),
        settable=True,
    )
    generated_mesh: str = setting("", "Mesh file from a generator, for reconstruct; empty for none", settable=True)
    generated_pose: tuple[float, ...] = setting(
        IDENTITY, "Pose of the generated mesh in the camera frame: x, y, z [m], qx, qy, qz, qw", settable=True
    )
    generated_scale: float = setting(1.0, "Length of the generated mesh's unit", "m", 1e-6, 1e6, settable=True)
    skip_off: tuple[str, ...] = setting(("",), "Skip rules that are not applied, as named in the diagnostics, or all")

    @property
    def sides(self) -> tuple[str, ...]:
        """The jaws by name."""
        return ("left", "right") if self.jaws == "both" else (self.jaws,)

    @property
    def tracks(self) -> bool:
        """Whether the object's pose is found here, from depth images."""
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
    from finforce_contact.reconstruction.generated import read_generated
    from finforce_contact.reconstruction.result import GeneratedMesh

    if not parameters.generated_mesh:
        return None
    vertices, triangles = read_generated(parameters.generated_mesh)
    affine = pose_from_quaternion(parameters.generated_pose[:3], parameters.generated_pose[3:])
    affine[:3, :3] *= parameters.generated_scale
    name = Path(parameters.generated_mesh).name
    return GeneratedMesh(vertices=vertices, triangles=triangles, affine=affine, name=name)
