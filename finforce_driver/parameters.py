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
    """What a gripper driver node is told beside the settings of gripper and grasp; units stand in the metadata."""

    port: str = setting("/dev/ttyACM0", "serial port of the CAN adapter, or python-can's channel, such as can0")
    interface: str = setting(
        "slcan",
        "slcan: a serial adapter; joint_command, parallel_gripper_command, gripper_command: another gripper, by the "
        "topic or action that `port` names; any other word: python-can's interface of that name",
    )
    baud_rate: int = setting(115200, "of the serial port; of no effect on USB", "1/s", 1200, 10_000_000)
    bit_rate: int = setting(1_000_000, "of the CAN bus", "bit/s", 10_000, 1_000_000)
    joint_names: tuple[str, ...] = setting(
        ("left_jaw_joint", "right_jaw_joint"), "of the two jaws in joint_states; the value of each is half the opening"
    )
    joint_effort: str = setting(
        "vision",
        "effort in joint_states: vision: grasp_wrench while it is fresh; motor: by the motor's current; none: empty",
        choices=("vision", "motor", "none"),
    )
    gripper_frame: str = setting("gripper_base", "frame of grasp_wrench")
    grasp_force: float = setting(1.0, "that grasp holds until grasp_goal says another", "N", 0.1, 30.0)
    grasp_speed: float = setting(0.004, "of the opening while a grasp closes", "m/s", 1e-4, 0.1)
    grasp_least_opening: float = setting(0.0, "at which a grasp that has met nothing gives up", "m", 0.0, 0.5)
    grasp_time_limit: float = setting(20.0, "for a grasp to reach its force", "s", 0.1, 3600.0)
    motor_force: float = setting(10.0, "grip force by the motor's current, of grasp_without_vision", "N", 1.0, 100.0)
    release_opening: float = setting(math.nan, "to which release opens; NaN: as far as it goes", "m", 0.0, 0.5)
    release_speed: float = setting(0.02, "of the opening while release opens", "m/s", 1e-4, 0.37)

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
        names = ("force", "speed", "least_opening", "time_limit")
        return GraspGoal(**{name: getattr(self, f"grasp_{name}") for name in names})


def build_gripper(parameters: DriverParameters, settings: GripperSettings) -> Gripper:
    """Make the driver of the gripper that the parameters name; nothing is opened before it starts.

    Raises:
        TargetError: a rate is none that ports or SLCAN know, or release_opening is beyond the stroke.
    """
    from finforce_driver.can.build import build_bus
    from finforce_driver.gripper import Gripper

    if not math.isnan(parameters.release_opening):
        settings.check_opening("release_opening", parameters.release_opening)
    rates = {"baud_rate": parameters.baud_rate, "bit_rate": parameters.bit_rate}
    bus = build_bus(parameters.port, parameters.interface, **rates)
    return Gripper(bus, settings)
