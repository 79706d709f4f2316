"""The parameters of a twin camera node, and the scene that they name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from finforce.settings import parameter

if TYPE_CHECKING:
    from finforce_twin.scenes.scenarios import Scenario


@dataclass(frozen=True, kw_only=True)
class TwinParameters:
    """What a twin camera node is told; units stand in the metadata."""

    scene: str = parameter("grasp_cylinder", "a name that `finforce twin list` prints")
    seed: int = parameter(0, "of textures, light and noise", min=0, max=2**31 - 1)
    finger: int = parameter(0, "seed of the jaws' material", min=0, max=2**31 - 1)
    light: str = parameter("", "bright, dim or any; empty: that of the scene")
    object: str = parameter("", "a shape by name, or a mesh file; empty: that of the scene")
    size: str = parameter("640x480", "of the images, WIDTHxHEIGHT [px]")
    depth_step: float = parameter(0.001, "of the depth image", unit="m", min=1e-5, max=0.01)
    loop: bool = parameter(True, "begin again at the end; else the node ends with the scene")
    gripper_link: str = parameter(
        "", "where an emulated gripper shall wait for its driver: the scene is what it grasps; empty: as scripted"
    )
    gripper_firmware: str = parameter("new", "of the emulated gripper", choices=("new", "old"))
    camera_frame: str = parameter("camera_color_optical_frame", "frame of the images")

    @property
    def scenario(self) -> Scenario:
        """The scene with what is changed in it.

        Raises:
            ScenarioError: there is no such scene, light or object.
        """
        from finforce_twin.scenes.scenarios import build_scenario

        changes = {"light": self.light, "object": self.object}
        return build_scenario(self.scene, **{name: value for name, value in changes.items() if value})
