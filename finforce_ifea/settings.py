"""Settings of an estimator: defaults, units, bounds and meanings."""

from dataclasses import dataclass, replace
from math import isnan, nan
from typing import TYPE_CHECKING

from finforce.errors import ObservationError
from finforce.settings import check_bounds, setting

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw_file import Material

SOLVERS = ("default", "reduced", "solid", "frame", "plane", "paper")
MESHES = ("coarse", "default", "fine")
_SOLVER_MEANING = (
    "mechanics: reduced (default), stored equilibria of the model that the jaw file recommends; solid, plane or frame, "
    "a full model; paper, the published setting"
)


@dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """Settings of `ForceEstimator`; each field's metadata says unit, bounds and meaning.

    Those with `parameter=False` are no ROS parameters: they are for experiments.
    """

    solver: str = setting("default", _SOLVER_MEANING, choices=SOLVERS)
    mesh: str = setting("default", "mesh density of a drawing", choices=MESHES)
    likelihood_threshold: float = setting(0.6, "minimum likelihood of a used key point", "1", 0.0, 1.0)
    ignored_keypoints: str = setting("", "names of unused key points, comma-separated")
    minimum_keypoints: int = setting(3, "minimum number of used key points for a force", "1", 1, 100)
    gate: float = setting(
        4.5,
        "residual at which a key point has a quarter of its weight at a given contact",
        "sigma",
        1.0,
        100.0,
        parameter=False,
    )
    largest_stddev: float = setting(
        1.0,
        "largest standard deviation of a force that is reported; of forces above four times that, a quarter",
        "N",
        0.01,
        100.0,
    )
    friction: float = setting(
        nan, "expected coefficient of friction of an object; NaN: that of the finger's material", "1", 0.0, 2.0
    )
    friction_stddev: float = setting(
        nan, "standard deviation of that coefficient (1 sigma); NaN: that of the finger's material", "1", 1e-3, 2.0
    )
    held: str = setting(
        "auto",
        "whether only the jaws hold the object, so that friction balances the inclination of their faces; either: "
        "weighed by the key points; auto: either with two jaws, else no",
        choices=("auto", "yes", "no", "either"),
    )
    tare_frames: int = setting(45, "number of unloaded images for the tare; below 30 Hz, fewer", "images", 5, 10000)
    automatic_tare: bool = setting(True, "automatic tare at the start, while unloaded")
    height_stddev: float = setting(0.5e-3, "uncertainty of the stated height of first touch (1 sigma)", "m", 1e-6, 0.05)
    radius: float = setting(0.012, "expected radius of curvature of the object at the contact", "m", 0.002, 0.5)
    radius_stddev: float = setting(0.008, "uncertainty of that radius (1 sigma)", "m", 1e-5, 0.5, parameter=False)
    iterations: int = setting(12, "maximum Newton iterations per image", "1", 1, 50, parameter=False)
    energy_weight: float = setting(1e-3, "energy weight epsilon of solver paper", "1", 0.0, 1e9)
    energy_form: str = setting(
        "sofa", "energy term as printed in the paper, or as scaled in SOFA", choices=("paper", "sofa"), parameter=False
    )
    force_axes: str = setting(
        "normal",
        "axes of the force at a given contact: along the normal of the deformed surface, or three",
        choices=("normal", "three"),
    )

    def __post_init__(self) -> None:
        """Refuse values out of bounds.

        Raises:
            ObservationError: A setting is not among its choices or outside its bounds.
        """
        check_bounds(self, ObservationError)

    def resolve_friction(self, material: "Material") -> "EstimatorSettings":
        """Return settings whose expected friction is that on a finger of this material, where they state none."""
        given = self.friction, self.friction_stddev
        friction, stddev = (one if isnan(own) else own for own, one in zip(given, material.friction, strict=True))
        return replace(self, friction=friction, friction_stddev=stddev)

    def resolve_held(self, *, both: bool) -> "EstimatorSettings":
        """Return settings in which `held` is no longer `auto`; `both` where another jaw presses the same object."""
        return self if self.held != "auto" else replace(self, held="either" if both else "no")

    @property
    def may_be_held(self) -> bool:
        """True if only the jaws hold the object, as far as that is known."""
        return self.held in ("yes", "either")
