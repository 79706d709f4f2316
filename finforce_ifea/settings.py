"""What can be set on an estimator: defaults, units, bounds and meanings."""

from dataclasses import dataclass

from finforce.errors import ObservationError
from finforce.settings import check_bounds, choice, setting

SOLVERS = ("default", "reduced", "solid", "frame", "linear", "paper")
_SOLVER_MEANING = (
    "mechanics: default is reduced, the stored equilibria of what the jaw file recommends (solid or frame); these in "
    "full, the compliance at rest alone (linear), or the paper's"
)


@dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """Settings of `JawEstimator`; each field's metadata says unit, bounds and meaning."""

    solver: str = choice("default", SOLVERS, _SOLVER_MEANING)
    mesh: str = choice("default", ("coarse", "default", "fine"), "mesh density of a drawing")
    likelihood_threshold: float = setting(0.6, "1", 0.0, 1.0, "a key point below it is hidden")
    workspace_margin: float = setting(0.03, "m", 0.001, 1.0, "a key point farther from its place at rest is refused")
    ignored_keypoints: str = setting("", "", None, None, "comma-separated names of key points never to be used")
    minimum_keypoints: int = setting(3, "1", 1, 100, "fewer used key points give no force")
    gate: float = setting(
        4.5, "sigma", 1.0, 100.0, "residual at which a key point has lost three quarters of its weight"
    )
    noise: float = setting(0.35e-3, "m", 1e-6, 0.01, "key point noise assumed until a tare has measured it")
    offset_stddev: float = setting(0.4e-3, "m", 0.0, 0.01, "constant offset of a key point that no tare has seen")
    model_error: float = setting(0.01, "1", 0.0, 1.0, "error of the mechanics as a share of a key point's way")
    tare_frames: int = setting(45, "frames", 5, 10000, "unloaded frames before the first force is reported")
    tare_memory: int = setting(300, "frames", 5, 100000, "unloaded frames over which offsets are averaged")
    automatic_tare: bool = setting(True, "", None, None, "tare by itself at the start while nothing presses")
    height_stddev: float = setting(0.5e-3, "m", 1e-6, 0.05, "uncertainty of the given height of first touch")
    radius: float = setting(0.012, "m", 0.002, 0.5, "expected radius of curvature of the object where it touches")
    radius_log_stddev: float = setting(0.7, "1", 0.01, 3.0, "uncertainty of the logarithm of that radius")
    tilt_stddev: float = setting(
        0.02, "rad", 1e-4, 0.5, "uncertainty of a known outline's tilt beside that of its pose"
    )
    acceleration: float = setting(0.02, "m/s^2", 1e-4, 10.0, "expected acceleration of the object into the jaw")
    memory: int = setting(45, "frames", 1, 1000, "frames over which the place is averaged while it holds still")
    iterations: int = setting(12, "1", 1, 50, "most Newton iterations per frame")
    energy_weight: float = setting(1e-3, "1", 0.0, 1e9, "the paper's epsilon, used by solver 'paper' alone")
    energy_weights: str = setting(
        "", "1", None, None, "epsilon of each candidate, comma-separated; empty: energy_weight"
    )
    energy_form: str = choice("sofa", ("paper", "sofa"), "epsilon as the paper prints it or as SOFA scales it")
    force_axes: str = choice(
        "normal",
        ("normal", "three"),
        "given contacts: force along the normal of the deformed surface, or in three axes",
    )

    def __post_init__(self) -> None:
        """Refuses values out of bounds.

        Raises:
            ObservationError: A setting is not among its choices or outside its bounds.
        """
        check_bounds(self, ObservationError)
