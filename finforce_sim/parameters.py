"""The parameters of a twin camera node, and the scene that they name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from finforce.settings import setting

if TYPE_CHECKING:
    from finforce_sim.scenes.scenarios import Scenario


@dataclass(frozen=True, kw_only=True)
class TwinParameters:
    """What a twin camera node is told; units stand in the metadata."""

    scene: str = setting("grasp_cylinder", "a name that `finforce twin list` prints")
    seed: int = setting(0, "of textures, light and noise", "", 0, 2**31 - 1)
    finger: int = setting(0, "seed of the jaws' material", "", 0, 2**31 - 1)
    light: str = setting("", "bright, dim or any; empty: that of the scene")
    object: str = setting("", "a shape by name, or a mesh file; empty: that of the scene")
    jaw_file: str = setting("", "jaw file, or the name of a shipped jaw; empty: that of the scene, bench")
    size: str = setting("640x480", "of the images, WIDTHxHEIGHT [px]")
    depth_step: float = setting(0.001, "of the depth image", "m", 1e-5, 0.01)
    loop: bool = setting(True, "begin again at the end; else the node ends with the scene")
    gripper_link: str = setting(
        "", "where an emulated gripper shall wait for its driver: the scene is what it grasps; empty: as scripted"
    )
    gripper_firmware: str = setting("new", "of the emulated gripper", choices=("new", "old"))
    detects: bool = setting(
        False, "publish the true key points and poses of the jaws as a detector without errors would"
    )
    camera_frame: str = setting("camera_color_optical_frame", "frame of the images")

    @property
    def scenario(self) -> Scenario:
        """The scene with what is changed in it.

        Raises:
            ScenarioError: there is no such scene, light or object.
            JawFileError: there is no such jaw.
        """
        from finforce_sim.scenes.scenarios import build_scenario

        changes = {"light": self.light, "object": self.object, "jaw": self.jaw_file}
        return build_scenario(self.scene, **{name: value for name, value in changes.items() if value})
