"""What can be set on an estimator: defaults, units, bounds and meanings."""

from dataclasses import dataclass, replace

from finforce.errors import ObservationError
from finforce.settings import check_bounds, setting

SOLVERS = ("default", "reduced", "solid", "frame", "plane", "linear", "paper")
_SOLVER_MEANING = (
    "mechanics: default is reduced, the stored equilibria of what the jaw file recommends (solid or frame); these in "
    "full, the compliance at rest alone (linear), or the paper's"
)


@dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """Settings of `JawEstimator`; each field's metadata says unit, bounds and meaning."""

    solver: str = setting("default", _SOLVER_MEANING, choices=SOLVERS)
    mesh: str = setting("default", "mesh density of a drawing", choices=("coarse", "default", "fine"))
    likelihood_threshold: float = setting(0.6, "a key point below it is hidden", "1", 0.0, 1.0)
    workspace_margin: float = setting(0.03, "a key point farther from its place at rest is refused", "m", 0.001, 1.0)
    ignored_keypoints: str = setting("", "comma-separated names of key points never to be used", "")
    minimum_keypoints: int = setting(3, "fewer used key points give no force", "1", 1, 100)
    gate: float = setting(
        4.5, "residual at which a key point has lost three quarters of its weight", "sigma", 1.0, 100.0
    )
    noise: float = setting(0.35e-3, "key point noise assumed until a tare has measured it", "m", 1e-6, 0.01)
    offset_stddev: float = setting(0.4e-3, "constant offset of a key point that no tare has seen", "m", 0.0, 0.01)
    model_error: float = setting(0.01, "error of the mechanics as a share of a key point's way", "1", 0.0, 1.0)
    friction: float = setting(0.4, "expected coefficient of friction of an object that is not smooth", "1", 0.0, 2.0)
    friction_stddev: float = setting(0.2, "uncertainty of that coefficient", "1", 1e-3, 2.0)
    smooth_share: float = setting(
        0.65, "probability that an object is no rougher than those that the finger was calibrated on", "1", 0.0, 1.0
    )
    held: str = setting(
        "auto",
        "whether the jaws alone hold the object, so that friction takes up what their faces lean; auto: yes where "
        "there are both, else no",
        choices=("auto", "yes", "no"),
    )
    tare_frames: int = setting(45, "unloaded frames before the first force is reported", "frames", 5, 10000)
    tare_memory: int = setting(300, "unloaded frames over which offsets are averaged", "frames", 5, 100000)
    automatic_tare: bool = setting(True, "tare by itself at the start while nothing presses", "")
    height_stddev: float = setting(0.5e-3, "uncertainty of the given height of first touch", "m", 1e-6, 0.05)
    radius: float = setting(0.012, "expected radius of curvature of the object where it touches", "m", 0.002, 0.5)
    radius_log_stddev: float = setting(0.7, "uncertainty of the logarithm of that radius", "1", 0.01, 3.0)
    tilt_stddev: float = setting(
        0.02, "uncertainty of a known outline's tilt beside that of its pose", "rad", 1e-4, 0.5
    )
    acceleration: float = setting(0.02, "expected acceleration of the object into the jaw", "m/s^2", 1e-4, 10.0)
    memory: int = setting(45, "frames over which the place is averaged while it holds still", "frames", 1, 1000)
    iterations: int = setting(12, "most Newton iterations per frame", "1", 1, 50)
    energy_weight: float = setting(1e-3, "the paper's epsilon, used by solver 'paper' alone", "1", 0.0, 1e9)
    energy_weights: str = setting("", "epsilon of each candidate, comma-separated; empty: energy_weight", "1")
    energy_form: str = setting("sofa", "epsilon as the paper prints it or as SOFA scales it", choices=("paper", "sofa"))
    force_axes: str = setting(
        "normal",
        "given contacts: force along the normal of the deformed surface, or in three axes",
        choices=("normal", "three"),
    )

    def __post_init__(self) -> None:
        """Refuses values out of bounds.

        Raises:
            ObservationError: A setting is not among its choices or outside its bounds.
        """
        check_bounds(self, ObservationError)

    def resolve_held(self, *, both: bool) -> "EstimatorSettings":
        """Return settings in which `held` is no longer `auto`; `both` where another jaw presses the same object."""
        return self if self.held != "auto" else replace(self, held="yes" if both else "no")
