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
        "estimate",
        "Method that finds the contact: this package's own, the paper's, or the nearest point",
        choices=MODES,
    )
    mesh: str = setting("default", "Mesh density of a drawn jaw, as the solver has it", choices=MESHES)
    pose_noise: float = setting(0.3e-3, "Initial noise of object positions (1 sigma)", "m", 1e-6, 0.05)
    rotation_noise: float = setting(6e-3, "Initial noise of object rotations (1 sigma)", "rad", 1e-5, 0.5)
    pose_bias: float = setting(0.5e-3, "Constant error of object positions (1 sigma)", "m", 0.0, 0.05)
    rotation_bias: float = setting(5e-3, "Constant error of object rotations (1 sigma)", "rad", 0.0, 0.5)
    slip_speed: float = setting(1.5e-3, "Minimum speed at which a held object counts as sliding", "m/s", 1e-4, 0.1)
    symmetry: str = setting(
        "auto", "Object symmetry: auto, none, or turns such as 'x_180 z_full' about the axes of the mesh's frame"
    )
    pose_timeout: float = setting(1.0, "Maximum object pose age, unless the grasp holds still", "s", 0.01, 60.0)

    def __post_init__(self) -> None:
        """Refuse values out of bounds.

        Raises:
            ContactError: a setting is not among its choices or outside its bounds.
        """
        check_bounds(self, ContactError)


@dataclass(frozen=True, kw_only=True)
class TrackerSettings:
    """Settings of `PoseTracker`; each field's metadata says unit, bounds and meaning."""

    points: int = setting(1000, "Object pixels compared per image", "1", 100, 20000)
    noise: float = setting(0.3e-3, "Minimum standard deviation of the depth", "m", 1e-5, 0.01)
    least_fitness: float = setting(0.6, "Minimum share of the visible object that agrees with the depth", "1", 0.1, 1.0)
    speed: float = setting(0.2, "Expected object speed (1 sigma)", "m/s", 0.001, 5.0)
    turn_rate: float = setting(1.0, "Expected object turn rate (1 sigma)", "rad/s", 0.01, 20.0)

    def __post_init__(self) -> None:
        """Refuse values out of bounds.

        Raises:
            PoseError: a setting is outside its bounds.
        """
        check_bounds(self, PoseError)
