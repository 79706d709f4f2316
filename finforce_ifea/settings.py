"""What can be set on an estimator: defaults, units, bounds and meanings; knows no ROS and no file."""

from dataclasses import dataclass, field, fields
from typing import Any

from finforce_ifea.errors import ObservationError

SOLVERS = ("default", "solid", "frame", "paper")


def _setting(default: Any, unit: str, low: float | None, high: float | None, description: str) -> Any:
    return field(default=default, metadata={"unit": unit, "min": low, "max": high, "description": description})


def _choice(default: str, choices: tuple[str, ...], description: str) -> Any:
    return field(default=default, metadata={"unit": "", "choices": choices, "description": description})


@dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """Settings of `JawEstimator`; each field's metadata says unit, bounds and meaning."""

    solver: str = _choice("default", SOLVERS, "mechanics: what the jaw file recommends, solid, frame, or the paper's")
    mesh: str = _choice("default", ("coarse", "default", "fine"), "mesh density of a drawing")
    likelihood_threshold: float = _setting(0.6, "1", 0.0, 1.0, "a key point below it is hidden")
    workspace_margin: float = _setting(0.03, "m", 0.001, 1.0, "a key point farther from its place at rest is refused")
    ignored_keypoints: str = _setting("", "", None, None, "comma-separated names of key points never to be used")
    minimum_keypoints: int = _setting(3, "1", 1, 100, "fewer used key points give no force")
    gate: float = _setting(
        4.5, "sigma", 1.0, 100.0, "residual at which a key point has lost three quarters of its weight"
    )
    noise: float = _setting(0.35e-3, "m", 1e-6, 0.01, "key point noise assumed until a tare has measured it")
    offset_stddev: float = _setting(0.4e-3, "m", 0.0, 0.01, "constant offset of a key point that no tare has seen")
    model_error: float = _setting(0.01, "1", 0.0, 1.0, "error of the mechanics as a share of a key point's way")
    tare_frames: int = _setting(45, "frames", 5, 10000, "unloaded frames before the first force is reported")
    tare_memory: int = _setting(300, "frames", 5, 100000, "unloaded frames over which offsets are averaged")
    automatic_tare: bool = _setting(True, "", None, None, "tare by itself at the start while nothing presses")
    height_stddev: float = _setting(0.5e-3, "m", 1e-6, 0.05, "uncertainty of the given height of first touch")
    radius: float = _setting(0.012, "m", 0.002, 0.5, "expected radius of curvature of the object where it touches")
    radius_log_stddev: float = _setting(0.7, "1", 0.01, 3.0, "uncertainty of the logarithm of that radius")
    tilt_stddev: float = _setting(
        0.02, "rad", 1e-4, 0.5, "uncertainty of a known outline's tilt beside that of its pose"
    )
    acceleration: float = _setting(0.02, "m/s^2", 1e-4, 10.0, "expected acceleration of the object into the jaw")
    memory: int = _setting(45, "frames", 1, 1000, "frames over which the place is averaged while it holds still")
    iterations: int = _setting(12, "1", 1, 50, "most Newton iterations per frame")
    energy_weight: float = _setting(1e-3, "1", 0.0, 1e9, "the paper's epsilon, used by solver 'paper' alone")
    energy_weights: str = _setting(
        "", "1", None, None, "epsilon of each candidate, comma-separated; empty: energy_weight"
    )
    energy_form: str = _choice("sofa", ("paper", "sofa"), "epsilon as the paper prints it or as SOFA scales it")
    force_axes: str = _choice(
        "normal",
        ("normal", "three"),
        "given contacts: force along the normal of the deformed surface, or in three axes",
    )

    def __post_init__(self) -> None:
        """Refuses values out of bounds.

        Raises:
            ObservationError: A setting is not among its choices or outside its bounds.
        """
        for item in fields(self):
            value, rule = getattr(self, item.name), item.metadata
            if "choices" in rule and value not in rule["choices"]:
                raise ObservationError(f"{item.name}: got {value!r}, expected one of {', '.join(rule['choices'])}")
            low, high = rule.get("min"), rule.get("max")
            if low is not None and not low <= value <= high:
                raise ObservationError(f"{item.name}: got {value!r}, expected {low:g} to {high:g} {rule['unit']}")
