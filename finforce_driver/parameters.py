"""The parameters of a gripper driver node, and the gripper that they ask for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from finforce.settings import ParameterError, TimeParameters, setting
from finforce_driver.grasp.settings import GraspGoal

if TYPE_CHECKING:
    from finforce_driver.gripper import Gripper
    from finforce_driver.settings import GripperSettings


@dataclass(frozen=True, kw_only=True)
class DriverParameters(TimeParameters):
    """Parameters of a gripper driver node besides the settings of gripper and grasp; the metadata have units."""

    port: str = setting("/dev/ttyACM0", "Serial port of the CAN adapter, python-can channel, or topic or action name")
    interface: str = setting(
        "slcan",
        "Link to the gripper: slcan (serial adapter); joint_command, parallel_gripper_command or gripper_command "
        "(another gripper by the topic or action that `port` names); or a python-can interface",
    )
    baud_rate: int = setting(115200, "Baud rate of the serial port; without effect on USB", "1/s", 1200, 10_000_000)
    joint_names: tuple[str, ...] = setting(
        ("left_jaw_joint", "right_jaw_joint"), "Names of the jaw joints; the value of each is half the opening"
    )
    joint_effort: str = setting(
        "vision",
        "Source of the effort in joint_states: vision (fresh grasp_wrench), motor (motor current) or none",
        choices=("vision", "motor", "none"),
    )
    gripper_frame: str = setting("gripper_base", "Frame of grasp_wrench")
    grasp_force: float = setting(1.0, "Set force until grasp_goal names another", "N", 0.1, 30.0)
    grasp_speed: float = setting(0.004, "Maximum speed of the opening in a grasp", "m/s", 1e-4, 0.1)
    grasp_time_limit: float = setting(20.0, "Maximum time for a grasp to reach its force", "s", 0.1, 3600.0)
    motor_force: float = setting(10.0, "Grip force of grasp_without_vision, by the motor current", "N", 1.0, 100.0)
    release_opening: float = setting(math.nan, "Opening of release; NaN: fully open", "m", 0.0, 0.5)

    def __post_init__(self) -> None:
        """Refuses names that are none, and joints that are not two.

        Raises:
            ParameterError: these are.
        """
        for name in ("port", "interface", "gripper_frame"):
            if not getattr(self, name):
                raise ParameterError(f"{name} is empty; expected a name, as {self.__dataclass_fields__[name].default}")
        if len(self.joint_names) != 2 or len(set(self.joint_names)) != 2:
            raise ParameterError(f"joint_names: got {self.joint_names!r}, expected two names, left and right")

    @property
    def goal(self) -> GraspGoal:
        """The first goal of a grasp."""
        names = ("force", "speed", "time_limit")
        return GraspGoal(**{name: getattr(self, f"grasp_{name}") for name in names})


def build_gripper(parameters: DriverParameters, settings: GripperSettings) -> Gripper:
    """Make the driver of the gripper that the parameters name; nothing is opened before it starts.

    Raises:
        TargetError: the baud rate is none that ports know, or release_opening is beyond the stroke.
    """
    from finforce_driver.can.build import build_bus
    from finforce_driver.gripper import Gripper

    if not math.isnan(parameters.release_opening):
        settings.check_opening("release_opening", parameters.release_opening)
    return Gripper(build_bus(parameters.port, parameters.interface, baud_rate=parameters.baud_rate), settings)
