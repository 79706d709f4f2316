"""What can be set on a contact estimator and on the tracker of object poses: defaults, units, bounds and meanings."""

from dataclasses import dataclass

from finforce.errors import PoseError
from finforce.settings import check_bounds, setting
from finforce_ifea.errors import ContactError

MODES = ("estimate", "paper", "closest")
MESHES = ("coarse", "default", "fine")


@dataclass(frozen=True, kw_only=True)
class ContactSettings:
    """Settings of `ContactEstimator`; each field's metadata says unit, bounds and meaning."""

    mode: str = setting(
        "estimate", "how the place is found: this package's way, the paper's, or nearest point", choices=MODES
    )
    mesh: str = setting("default", "mesh density of a drawing, the one that the solver's surface has", choices=MESHES)
    offset: float = setting(
        1e-3, "mode paper: how far the object is pushed into the surface before contact", "m", 1e-5, 0.01
    )
    overlap: float = setting(
        0.2e-3, "the object is brought into this overlap with the deformed surface", "m", 1e-6, 5e-3
    )
    row_spacing: float = setting(2.5e-3, "greatest height of the surface that one row stands for", "m", 1e-4, 0.05)
    narrow: float = setting(5e-3, "a contact not higher than this is one row", "m", 1e-4, 0.05)
    wrench_slack: float = setting(
        1e-3, "a line of action is believed where the object is no farther off the surface than this", "m", 0.0, 0.05
    )
    wrench_reach: float = setting(3e-3, "and where it misses the overlap by no more than this", "m", 0.0, 0.05)
    wrench_gain: float = setting(0.93, "share of the line of action in the mean place; the rest: shape", "1", 0.0, 1.0)
    wrench_force: float = setting(0.2, "a weaker force has no line of action", "N", 1e-3, 100.0)
    reach: float = setting(
        4e-3, "a bent jaw farther from the object than this, and what the pose may err, touches it not", "m", 1e-4, 0.1
    )
    deflection_noise: float = setting(
        0.035e-3, "standard deviation of the solver's surface while the jaw is at rest", "m", 1e-6, 5e-3
    )
    touch_probability: float = setting(0.93, "probability of contact from which it is believed", "1", 0.5, 0.9999)
    release_probability: float = setting(0.5, "probability of contact below which it is over", "1", 0.0001, 0.9)
    release_frames: int = setting(3, "consecutive images without contact before it is over", "frames", 1, 100)
    pose_noise: float = setting(0.3e-3, "noise of positions until the poses have shown theirs", "m", 1e-6, 0.05)
    rotation_noise: float = setting(6e-3, "noise of rotations until the poses have shown theirs", "rad", 1e-5, 0.5)
    pose_bias: float = setting(0.5e-3, "constant error of positions that no average removes", "m", 0.0, 0.05)
    rotation_bias: float = setting(5e-3, "constant error of rotations that no average removes", "rad", 0.0, 0.5)
    slip_speed: float = setting(1.5e-3, "speed at which a held object is said to slide", "m/s", 1e-4, 0.1)
    slip_reach: float = setting(8e-3, "the contact may wander by this before its slip is followed anew", "m", 1e-3, 0.1)
    drift: float = setting(
        0.1e-3, "random walk of the object along the jaw; what is more is noticed and followed", "m/s^0.5", 1e-7, 0.1
    )
    rotation_drift: float = setting(2e-3, "random walk of the object's rotation in the jaw", "rad/s^0.5", 1e-6, 1.0)
    acceleration: float = setting(
        2e-3, "random walk of the closing speed; what is more is noticed and followed", "m/s^1.5", 1e-6, 10.0
    )
    gate: float = setting(5.0, "a pose farther off than this is not believed at once", "sigma", 2.0, 100.0)
    jump_samples: int = setting(3, "consecutive consistent poses off the course that are believed", "poses", 2, 20)
    symmetry: str = setting(
        "auto", "turns that map the object onto itself: auto, none, or words as x_180 z_full, axes of its mesh's frame"
    )
    pose_timeout: float = setting(1.0, "a pose older than this is none, unless the grasp rests", "s", 0.01, 60.0)
    rest_time: float = setting(1.0, "a grasp that was still for this long needs no new pose", "s", 0.1, 60.0)
    rest_motion: float = setting(
        0.2e-3, "a surface that moves by more than this ends the rest of the grasp", "m", 1e-5, 5e-3
    )
    recut_angle: float = setting(0.0175, "turn out of the finger's plane that needs a new outline", "rad", 1e-4, 0.5)
    recut_shift: float = setting(1e-3, "shift along the finger's width that needs a new outline", "m", 1e-5, 0.05)

    def __post_init__(self) -> None:
        """Refuses values out of bounds.

        Raises:
            ContactError: A setting is not among its choices or outside its bounds.
        """
        check_bounds(self, ContactError)


@dataclass(frozen=True, kw_only=True)
class TrackerSettings:
    """Settings of `PoseTracker`; each field's metadata says unit, bounds and meaning."""

    points: int = setting(1000, "pixels of the object that are compared per image", "1", 100, 20000)
    edge_points: int = setting(200, "points of the outline that are compared per image", "1", 20, 5000)
    wide_gate: float = setting(0.006, "depth farther off than this is not the object, at first", "m", 0.002, 0.05)
    gate: float = setting(0.003, "depth farther off than this is not the object, in the end", "m", 0.0005, 0.02)
    noise: float = setting(0.3e-3, "least standard deviation that a depth can have", "m", 1e-5, 0.01)
    noise_width: float = setting(5.0, "pixels over which the errors of the depth are alike", "px", 1.0, 50.0)
    normal_error: float = setting(
        0.035, "error of the mesh's normals: a motion along its surface up to this is not seen", "rad", 0.001, 0.5
    )
    edge_error: float = setting(0.15, "the same of the normals of its outline", "rad", 0.001, 0.5)
    least_fitness: float = setting(0.6, "least share of what should be seen that is where it should be", "1", 0.1, 1.0)
    least_visible: float = setting(0.1, "least share of the object in view that nothing hides", "1", 0.01, 1.0)
    speed: float = setting(0.2, "speed of the object that surprises nobody", "m/s", 0.001, 5.0)
    turn_rate: float = setting(1.0, "turn rate of the object that surprises nobody", "rad/s", 0.01, 20.0)

    def __post_init__(self) -> None:
        """Refuses values out of bounds.

        Raises:
            PoseError: A setting is outside its bounds, or the wide gate is the narrower one.
        """
        check_bounds(self, PoseError)
        if self.wide_gate < self.gate:
            raise PoseError(f"wide_gate: got {self.wide_gate:g} m, expected no less than gate, {self.gate:g} m")
