"""What a force-controlled grasp is asked for and what can be set on it."""

from __future__ import annotations

from dataclasses import dataclass

from finforce.settings import check_bounds, setting
from finforce_driver.errors import TargetError


@dataclass(frozen=True, kw_only=True)
class GraspGoal:
    """One grasp.

    Attributes:
        force: to be reached and held, by vision [N].
        speed: greatest of the opening while closing [m/s].
        least_opening: below which the jaws never go [m].
        time_limit: to reach the force in [s]; holding has none.
    """

    force: float = setting(description="to be reached and held", unit="N", low=0.1, high=30.0)
    speed: float = setting(0.004, "greatest speed of the opening while closing", "m/s", 1e-4, 0.1)
    least_opening: float = setting(0.0, "opening below which the jaws never go", "m", 0.0, 0.5)
    time_limit: float = setting(20.0, "to reach the force in; holding has none", "s", 0.1, 3600.0)

    def __post_init__(self) -> None:
        """Refuses what no grasp can be.

        Raises:
            TargetError: a value is no number or out of bounds.
        """
        check_bounds(self, TargetError)


@dataclass(frozen=True, kw_only=True)
class GraspSettings:
    """Settings of `ForceGrasp`; each field's metadata says unit, bounds and meaning."""

    force_limit: float = setting(8.0, "force that ends a grasp; no goal may be above it", "N", 0.2, 30.0)
    tolerance: float = setting(0.08, "by which the set force may be passed to come nearer to it", "N", 0.0, 1.0)
    largest_stiffness: float = setting(
        1400.0,
        "of fingers and object per metre of opening, the greatest expected before it is learnt",
        "N/m",
        50.0,
        1e5,
    )
    approach_share: float = setting(
        0.7, "of the set force that may build up before an image can show the contact", "", 0.05, 1.0
    )
    onset_force: float = setting(0.25, "above what was seen without load, it says that jaws are loaded", "N", 0.05, 2.0)
    noise: float = setting(0.05, "standard deviation of the force that is expected at first", "N", 0.005, 1.0)
    jump: float = setting(1.0, "change of the force between two images that motion does not explain", "N", 0.1, 10.0)
    stale_after: float = setting(0.25, "age of the newest image with a force at which a grasp ends", "s", 0.05, 2.0)
    touch_timeout: float = setting(1.0, "wait for a force once the jaws are said to touch", "s", 0.1, 10.0)
    silence_timeout: float = setting(2.0, "wait for the first word of the camera", "s", 0.1, 60.0)
    relaxation: float = setting(0.4, "share of the force that holding may make up for by closing", "", 0.05, 1.0)
    motor_force: float = setting(
        20.0, "grip force by the maker's curve that the motor is limited to; 3 set forces if more", "N", 7.0, 62.0
    )

    def __post_init__(self) -> None:
        """Refuses values out of bounds.

        Raises:
            TargetError: a value is out of its bounds.
        """
        check_bounds(self, TargetError)

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
