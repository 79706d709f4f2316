"""What can be set on a contact estimator: defaults, units, bounds and meanings.

What can be set on the tracker of object poses: defaults, units, bounds and meanings.
"""

from dataclasses import dataclass

from finforce.errors import PoseError
from finforce.settings import check_bounds, choice, setting
from finforce_ifea.errors import ContactError

MODES = ("estimate", "paper", "closest")
MESHES = ("coarse", "default", "fine")


@dataclass(frozen=True, kw_only=True)
class ContactSettings:
    """Settings of `ContactEstimator`; each field's metadata says unit, bounds and meaning."""

    mode: str = choice("estimate", MODES, "how the place is found: this package's way, the paper's, or nearest point")
    mesh: str = choice("default", MESHES, "mesh density of a drawing, the one that the solver's surface has")
    offset: float = setting(
        1e-3, "m", 1e-5, 0.01, "mode paper: how far the object is pushed into the surface before contact"
    )
    overlap: float = setting(
        0.2e-3, "m", 1e-6, 5e-3, "the object is brought into this overlap with the deformed surface"
    )
    row_spacing: float = setting(2.5e-3, "m", 1e-4, 0.05, "greatest height of the surface that one row stands for")
    narrow: float = setting(5e-3, "m", 1e-4, 0.05, "a contact not higher than this is one row")
    wrench_slack: float = setting(
        1e-3, "m", 0.0, 0.05, "a line of action is believed where the object is no farther off the surface than this"
    )
    wrench_reach: float = setting(3e-3, "m", 0.0, 0.05, "and where it misses the overlap by no more than this")
    wrench_gain: float = setting(0.93, "1", 0.0, 1.0, "share of the line of action in the mean place; the rest: shape")
    wrench_force: float = setting(0.2, "N", 1e-3, 100.0, "a weaker force has no line of action")
    reach: float = setting(
        4e-3, "m", 1e-4, 0.1, "a bent jaw farther from the object than this, and what the pose may err, touches it not"
    )
    deflection_noise: float = setting(
        0.035e-3, "m", 1e-6, 5e-3, "standard deviation of the solver's surface while the jaw is at rest"
    )
    touch_probability: float = setting(0.93, "1", 0.5, 0.9999, "probability of contact from which it is believed")
    release_probability: float = setting(0.5, "1", 0.0001, 0.9, "probability of contact below which it is over")
    release_frames: int = setting(3, "frames", 1, 100, "consecutive images without contact before it is over")
    pose_noise: float = setting(0.3e-3, "m", 1e-6, 0.05, "noise of positions until the poses have shown theirs")
    rotation_noise: float = setting(6e-3, "rad", 1e-5, 0.5, "noise of rotations until the poses have shown theirs")
    pose_bias: float = setting(0.5e-3, "m", 0.0, 0.05, "constant error of positions that no average removes")
    rotation_bias: float = setting(5e-3, "rad", 0.0, 0.5, "constant error of rotations that no average removes")
    drift: float = setting(
        0.1e-3, "m/s^0.5", 1e-7, 0.1, "random walk of the object along the jaw; what is more is noticed and followed"
    )
    rotation_drift: float = setting(2e-3, "rad/s^0.5", 1e-6, 1.0, "random walk of the object's rotation in the jaw")
    acceleration: float = setting(
        2e-3, "m/s^1.5", 1e-6, 10.0, "random walk of the closing speed; what is more is noticed and followed"
    )
    gate: float = setting(5.0, "sigma", 2.0, 100.0, "a pose farther off than this is not believed at once")
    jump_samples: int = setting(3, "poses", 2, 20, "consecutive consistent poses off the course that are believed")
    pose_timeout: float = setting(1.0, "s", 0.01, 60.0, "a pose older than this is none, unless the grasp rests")
    rest_time: float = setting(1.0, "s", 0.1, 60.0, "a grasp that was still for this long needs no new pose")
    rest_motion: float = setting(
        0.2e-3, "m", 1e-5, 5e-3, "a surface that moves by more than this ends the rest of the grasp"
    )
    still: float = setting(0.02e-3, "m", 0.0, 1e-3, "motion of object or surface that is not worth a new place")
    margin: float = setting(
        5e-3, "m", 1e-4, 0.1, "an object farther off the jaw than this keeps its place while it nears"
    )
    recut_angle: float = setting(0.0175, "rad", 1e-4, 0.5, "turn out of the finger's plane that needs a new outline")
    recut_shift: float = setting(1e-3, "m", 1e-5, 0.05, "shift along the finger's width that needs a new outline")

    def __post_init__(self) -> None:
        """Refuses values out of bounds.

        Raises:
            ContactError: A setting is not among its choices or outside its bounds.
        """
        check_bounds(self, ContactError)


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
