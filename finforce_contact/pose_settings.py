"""What can be set on the tracker of object poses: defaults, units, bounds and meanings; knows no ROS and no file."""

from dataclasses import dataclass

from finforce_bounded import check_bounds, setting
from finforce_contact.errors import PoseError


@dataclass(frozen=True, kw_only=True)
class TrackerSettings:
    """Settings of `PoseTracker`; each field's metadata says unit, bounds and meaning."""

    points: int = setting(1000, "1", 100, 20000, "pixels of the object that are compared per image")
    edge_points: int = setting(200, "1", 20, 5000, "points of the outline that are compared per image")
    wide_gate: float = setting(0.006, "m", 0.002, 0.05, "depth farther off than this is not the object, at first")
    gate: float = setting(0.003, "m", 0.0005, 0.02, "depth farther off than this is not the object, in the end")
    noise: float = setting(0.3e-3, "m", 1e-5, 0.01, "least standard deviation that a depth can have")
    noise_width: float = setting(5.0, "px", 1.0, 50.0, "pixels over which the errors of the depth are alike")
    normal_error: float = setting(
        0.035, "rad", 0.001, 0.5, "error of the mesh's normals: a motion along its surface up to this is not seen"
    )
    edge_error: float = setting(0.15, "rad", 0.001, 0.5, "the same of the normals of its outline")
    least_fitness: float = setting(0.6, "1", 0.1, 1.0, "least share of what should be seen that is where it should be")
    least_visible: float = setting(0.1, "1", 0.01, 1.0, "least share of the object in view that nothing hides")
    speed: float = setting(0.2, "m/s", 0.001, 5.0, "speed of the object that surprises nobody")
    turn_rate: float = setting(1.0, "rad/s", 0.01, 20.0, "turn rate of the object that surprises nobody")

    def __post_init__(self) -> None:
        """Refuses values out of bounds.

        Raises:
            PoseError: A setting is outside its bounds, or the wide gate is the narrower one.
        """
        check_bounds(self, PoseError)
        if self.wide_gate < self.gate:
            raise PoseError(f"wide_gate: got {self.wide_gate:g} m, expected no less than gate, {self.gate:g} m")
