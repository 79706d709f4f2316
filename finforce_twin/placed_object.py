"""An object and how it lies between the jaws; knows no jaw."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce_contact.object_mesh import FORMATS, ObjectMesh, load_object_mesh
from finforce_twin.objects import build_object
from finforce_twin.scenarios import Scenario


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedObject:
    """An object that is turned about the middle of its bounding box.

    Attributes:
        mesh: in its own frame.
        centred: turned to the axes of `gripper_base`, the middle of its bounding box at the origin.
        R_gripper_object: (3, 3) by which it is turned.
        middle: of the bounding box, in the object's own frame (3,) [m].
    """

    mesh: ObjectMesh
    centred: ObjectMesh
    R_gripper_object: NDArray
    middle: NDArray

    def pose_at(self, position: NDArray, tilt: float) -> NDArray:
        """Returns T_gripper_object (4, 4) with the middle at a position (3,) [m], tilted from x to z [rad]."""
        T = np.eye(4)
        # the right-hand rule about y turns z to x
        T[:3, :3] = Rotation.from_rotvec([0.0, -tilt, 0.0]).as_matrix() @ self.R_gripper_object
        T[:3, 3] = position - T[:3, :3] @ self.middle
        return T


def place_object(scenario: Scenario) -> PlacedObject:
    """Returns a scenario's object, scaled and turned.

    Raises:
        ObjectMeshError: There is no such object, or the file holds none.
        MissingDependencyError: A library that builds or reads it is not installed.
    """
    if scenario.object.lower().endswith(FORMATS):
        mesh = load_object_mesh(scenario.object, unit=scenario.unit)
    else:
        mesh = build_object(scenario.object)
    mesh = replace(mesh, vertices=scenario.scale * mesh.vertices)
    R = Rotation.from_euler("xyz", [scenario.turn_x, scenario.turn_y, scenario.turn_z]).as_matrix()
    turned = mesh.vertices @ R.T
    middle = 0.5 * (turned.min(0) + turned.max(0))
    centred = replace(mesh, vertices=turned - middle)
    return PlacedObject(mesh=mesh, centred=centred, R_gripper_object=R, middle=R.T @ middle)
