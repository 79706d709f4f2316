"""Settings of a gripper, its grasps and its driver node; SI units into the gripper's bytes and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

from finforce.settings import Bounded, GripperParameters, ParameterError, setting
from finforce_driver.can.protocol import LARGEST_BYTE
from finforce_driver.errors import TargetError

LEAST_WATCHDOG = 0.2  # [s]
LEAST_CURRENT = 0.15  # [A] below which the gripper is unstable
PINION_RADIUS = 0.006  # [m] of the pinion between the two racks
TICKS_PER_TURN = 16384  # of the encoder
OPENING_PER_TICK = 4.0 * math.pi * PINION_RADIUS / TICKS_PER_TURN  # [m]: both racks move by the pinion's circumference
SLOWEST_TICKS = 40  # per second, at speed byte 0
TICKS_SPAN = 79960  # per second, from speed byte 0 to 255
SLOWEST_BYTE = 3  # below it the gripper mistakes slow motion for contact
LEAST_SPEED = 1e-5  # [m/s] of the opening: a stroke in 80 minutes
MOST_EXCESS = 2.0  # times the fastest speed; more is not limited but rejected
ROUNDING = 1e-9  # [m], [N]: what a value may lie out of bounds by arithmetic alone


def is_number(value: object) -> bool:
    """Return whether a value is a number that is one: no truth value, no text, not NaN."""
    return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)


def check_numbers(**values: object) -> None:
    """Reject what is no number among the values of a move, by name; None stands for a default.

    Raises:
        TargetError: a value is none.
    """
    for name, value in values.items():
        if value is not None and not is_number(value):
            raise TargetError(f"{name}: got {value!r}, expected a number; the gripper stays as it was")


class _Bounded(Bounded):
    """Settings that raise TargetError for a value out of bounds."""

    error = TargetError


@dataclass(frozen=True, kw_only=True)
class GripperSettings(_Bounded):
    """Settings of `Gripper`; each field's metadata says unit, bounds and meaning.

    Attributes:
        telemetry_period: between two questions for temperature, supply or errors [s]; no ROS parameter.
    """

    node_id: int = setting(0, "CAN node of the gripper", "", 0, 15)
    poll_rate: float = setting(50.0, "Rate of state requests", "Hz", 5.0, 200.0, parameter=False)
    reply_timeout: float = setting(0.05, "Maximum wait for a reply", "s", 0.005, 1.0)
    stroke: float = setting(0.048, "Stroke of the opening between the end stops", "m", 0.001, 0.5)
    closed_opening: float = setting(0.0, "Opening between the jaws' inner faces at the closed stop", "m", 0.0, 0.2)
    largest_current: float = setting(1.3, "Maximum current limit of a command", "A", 0.15, 1.5)
    force_per_current: float = setting(
        47.7, "Grip force per motor current; as measured, or the maker's", "N/A", 5.0, 500.0
    )
    default_speed: float = setting(0.02, "Speed of the opening, if a command has none", "m/s", 1e-4, 0.37)
    default_current: float = setting(0.5, "Current limit, if a command has no force", "A", 0.15, 1.5)
    watchdog: float = setting(0.0, "Silence of the driver after which the gripper goes limp; 0: never", "s", 0, 60)
    release_on_stop: bool = setting(False, "Whether the jaws go limp when the driver exits", "")
    telemetry_period: float = 1.0

    def __post_init__(self) -> None:
        """Reject values out of bounds.

        Raises:
            TargetError: a value is out of its bounds, the watchdog too short, or the default current lies outside the
                currents' range.
        """
        super().__post_init__()
        if 0.0 < self.watchdog < LEAST_WATCHDOG:
            raise TargetError(
                f"watchdog: got {self.watchdog:g} s, expected 0 for none, or {LEAST_WATCHDOG:g} s at least: a computer "
                "stands still for a moment now and then"
            )
        if not LEAST_CURRENT <= self.default_current <= self.largest_current:
            raise TargetError(
                f"default_current: got {self.default_current:g} A, expected {LEAST_CURRENT:g} to "
                f"{self.largest_current:g} A, up to largest_current"
            )

    @property
    def largest_opening(self) -> float:
        """Opening at the open stop [m]."""
        return self.closed_opening + self.stroke

    @property
    def resolution(self) -> float:
        """Opening per count of the position byte [m]."""
        return self.stroke / LARGEST_BYTE

    @property
    def fastest(self) -> float:
        """Fastest speed of the opening [m/s]."""
        return self.speed_of(LARGEST_BYTE)

    def check_opening(self, name: str, opening: float) -> None:
        """Reject an opening [m] at which the jaws can never be.

        Raises:
            TargetError: it is no number, or outside the stroke.
        """
        low, high = self.closed_opening, self.largest_opening
        if not low - ROUNDING <= opening <= high + ROUNDING:
            raise TargetError(f"{name}: got {opening:g} m, expected {low:g} to {high:g} m, the gripper's stroke")

    def opening_of(self, position: float) -> float:
        """Return the opening [m] of a position [counts]: closed + stroke (1 - position / 255)."""
        return self.closed_opening + self.stroke * (1.0 - position / LARGEST_BYTE)

    def counts_of(self, opening: float) -> float:
        """Return the position [counts] of an opening [m], neither rounded nor bounded."""
        return LARGEST_BYTE * (1.0 - (opening - self.closed_opening) / self.stroke)

    def position_of(self, opening: float) -> int:
        """Return the position byte next to an opening [m].

        Raises:
            TargetError: it is no number, or outside the stroke.
        """
        self.check_opening("opening", opening)
        return round(min(max(self.counts_of(opening), 0.0), float(LARGEST_BYTE)))

    def speed_of(self, byte: int) -> float:
        """Return the speed of the opening [m/s] of a speed byte."""
        return (SLOWEST_TICKS + byte * TICKS_SPAN // LARGEST_BYTE) * OPENING_PER_TICK

    def speed_byte(self, speed: float) -> int:
        """Return the byte of the fastest speed up to a speed of the opening [m/s], and no slower than `SLOWEST_BYTE`.

        Raises:
            TargetError: it is no number, not positive, below 0.01 mm/s, or far beyond the gripper: another unit.
        """
        if not LEAST_SPEED <= speed <= MOST_EXCESS * self.fastest:
            raise TargetError(f"speed: got {speed:g} m/s, expected {LEAST_SPEED:g} to {self.fastest:.3g} m/s")
        limit = speed * (1.0 + ROUNDING)
        byte = int((limit / OPENING_PER_TICK - SLOWEST_TICKS) * LARGEST_BYTE / TICKS_SPAN) + 1
        byte -= self.speed_of(byte) > limit
        return min(max(byte, SLOWEST_BYTE), LARGEST_BYTE)

    def force_of(self, current: float) -> float:
        """Return the grip force [N] of a current [A]; both positive when driving closed."""
        return self.force_per_current * current

    @property
    def forces(self) -> tuple[float, float]:
        """The least and the largest grip force of a command [N]."""
        return self.force_of(LEAST_CURRENT), self.force_of(self.largest_current)

    def current_of(self, force: float) -> int:
        """Return the current limit [mA] of a grip force [N].

        Raises:
            TargetError: it is no number, or outside the range of the current limit.
        """
        low, high = self.forces
        if not low - ROUNDING <= force <= high + ROUNDING:
            raise TargetError(
                f"force: got {force:g} N, expected {low:.3g} to {high:.3g} N, the range of the current limit; "
                "a smaller force needs vision"
            )
        return round(1e3 * force / self.force_per_current)


@dataclass(frozen=True, kw_only=True)
class JointSettings(_Bounded):
    """The relation of a joint's value to the opening and to its commands; units stand in the metadata.

    The opening is linear between the two ends: `gripper.closed_opening` at `closed`, that and `gripper.stroke` at
    `open`.
    """

    names: tuple[str, ...] = setting(("gripper_joint",), "Names of the commanded joints; the first is read")
    closed: float = setting(0.0, "Joint value of the closed gripper, in the joint's unit", "", -1e4, 1e4)
    open: float = setting(1.0, "Joint value of the open gripper, in the joint's unit", "", -1e4, 1e4)
    resolution: float = setting(0.0002, "Smallest step of the opening that the joint follows", "m", 1e-6, 0.01)
    rate: float = setting(
        25.0, "Rate of setpoints during a move; 0: one command, and the joint controls the speed", "Hz", 0.0, 500.0
    )
    largest_speed: float = setting(0.1, "Maximum speed of the opening", "m/s", 1e-4, 2.0)
    largest_force: float = setting(0.0, "Maximum effort of a command; 0: no effort", "N", 0.0, 1000.0)
    effort_is_force: bool = setting(
        False, "Whether the joint's effort is its grip force [N], as a check of the camera's", ""
    )

    def __post_init__(self) -> None:
        """Reject what no joint is.

        Raises:
            TargetError: a value is out of bounds, there is no joint, or both ends are the same.
        """
        super().__post_init__()
        if not self.names or not all(self.names) or len(set(self.names)) != len(self.names):
            raise TargetError(f"joint.names: got {self.names!r}, expected one name or more, each once")
        if self.closed == self.open:
            raise TargetError(f"joint.closed and joint.open: both are {self.open:g}, expected two values")


@dataclass(frozen=True, kw_only=True)
class GraspGoal(_Bounded):
    """One grasp by vision; each field's metadata says unit, bounds and meaning. Holding has no time limit."""

    force: float = setting(description="Set force", unit="N", low=0.1, high=30.0)
    speed: float = setting(0.004, "Maximum speed of the opening while closing", "m/s", 1e-4, 0.1)
    least_opening: float = setting(0.0, "Minimum opening of the jaws", "m", 0.0, 0.5)
    time_limit: float = setting(20.0, "Maximum time to reach the set force", "s", 0.1, 3600.0)


@dataclass(frozen=True, kw_only=True)
class GraspSettings(_Bounded):
    """Settings of `ForceGrasp`; each field's metadata says unit, bounds and meaning."""

    force_limit: float = setting(8.0, "Force that ends a grasp; also the maximum set force", "N", 0.2, 30.0)
    largest_stiffness: float = setting(
        1400.0, "Maximum stiffness of jaws and object per opening, assumed until it is learned", "N/m", 50.0, 1e5
    )
    approach_speed: float = setting(0.004, "Maximum speed of the opening before contact", "m/s", 1e-4, 0.1)
    probe: float = setting(
        0.0, "Way back at half of the set force, from which friction shows in the first grasp; 0: none", "m", 0.0, 0.01
    )
    reaction: float = setting(0.05, "Delay from a command to the motion of the gripper", "s", 0.0, 1.0)
    stale_after: float = setting(0.25, "Maximum age of the newest force; a grasp ends beyond it", "s", 0.05, 2.0)
    force_timeout: float = setting(
        1.0,
        "Maximum wait for a force after contact; doubled before contact",
        "s",
        0.1,
        10.0,
    )
    motor_friction: float = setting(
        0.4,
        "Grip force at rest that the motor current may show too much or too little by friction",
        "N",
        0.0,
        10.0,
    )
    motor_force: float = setting(
        7.5,
        "Motor limit as grip force, at least 1.5 times the set force, within what the currents of the gripper give",
        "N",
        7.0,
        62.0,
    )

    def check_force(self, force: float) -> float:
        """Return a set force [N] that may be held.

        Raises:
            TargetError: it is no number, not above zero, or above the force limit.
        """
        if not 0.1 <= force <= self.force_limit:
            raise TargetError(
                f"set force: got {force:g} N, expected 0.1 to {self.force_limit:g} N, the force limit of the grasp"
            )
        return float(force)


@dataclass(frozen=True, kw_only=True)
class DriverParameters(GripperParameters):
    """Parameters of a gripper driver node besides the settings of gripper and grasp; the metadata have units."""

    port: str = setting("/dev/ttyACM0", "Serial port of the CAN adapter, python-can channel, or topic or action name")
    interface: str = setting(
        "slcan",
        "Link to the gripper: slcan (serial adapter); joint_command, parallel_gripper_command or gripper_command "
        "(another gripper by the topic or action that `port` names); or a python-can interface",
    )
    baud_rate: int = setting(115200, "Baud rate of the serial port; no effect on USB", "1/s", 1200, 10_000_000)
    joint_names: tuple[str, ...] = setting(
        ("left_jaw_joint", "right_jaw_joint"), "Names of the jaw joints; each value is half the opening"
    )
    joint_effort: str = setting(
        "vision",
        "Source of the effort in joint_states: vision (fresh grasp_wrench), motor (motor current) or none",
        choices=("vision", "motor", "none"),
    )
    grasp_force: float = setting(1.0, "Set force until a grasp_goal changes it", "N", 0.1, 30.0)
    grasp_speed: float = setting(0.004, "Maximum speed of the opening in a grasp", "m/s", 1e-4, 0.1)
    grasp_time_limit: float = setting(20.0, "Maximum time for a grasp to reach its force", "s", 0.1, 3600.0)
    motor_force: float = setting(10.0, "Grip force of grasp_without_vision, from the motor current", "N", 1.0, 100.0)
    release_opening: float = setting(math.nan, "Opening of release; NaN: fully open", "m", 0.0, 0.5)

    def __post_init__(self) -> None:
        """Refuse names that are none, and joints that are not two.

        Raises:
            ParameterError: these are.
        """
        for name in ("port", "interface", "gripper_frame"):
            if not getattr(self, name):
                raise ParameterError(f"{name} is empty; expected a name, as {self.__dataclass_fields__[name].default}")
        if len(self.joint_names) != 2 or len(set(self.joint_names)) != 2:
            raise ParameterError(f"joint_names: got {self.joint_names!r}, expected two names, left and right")
