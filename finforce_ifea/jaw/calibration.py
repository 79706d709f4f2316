"""What was identified on one finger, and its file."""

from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np
import yaml

from finforce.files import FileError, read_yaml
from finforce_ifea.errors import CalibrationError
from finforce_ifea.jaw.drawing import Band, Drawing
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.relaxation import RelaxationTerm

_KEYS = {
    "young_modulus",
    "inner_thickness_factor",
    "outer_thickness_factor",
    "rib_thickness_factor",
    "clamped_z",
    "relaxation",
    "force_error",
    "friction",
    "friction_stddev",
    "jaw",
    "finger",
    "solver",
    "comment",
    "uncertainty",
}
_MECHANICS = ("solid", "frame", "plane", "paper")
# Forces of the solid and the frame of one finger differ by 1 to 3 % up to 10 mm.
_MODELS_DIFFER = 0.03


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A printed finger as it is, beside its drawing.

    Attributes:
        young_modulus: [Pa].
        inner_thickness_factor: effective over drawn thickness of the inner band.
        outer_thickness_factor: the same of the outer band.
        rib_thickness_factor: the same of the ribs.
        clamped_z: effective height of the clamp [m].
        relaxation: branches of the material's relaxation.
        force_error: relative standard deviation of forces that is left [-].
        friction: coefficient of the objects that the finger was calibrated on, 0 where they showed none.
        friction_stddev: standard deviation of that [-].
        jaw: name of the jaw that it belongs to, empty for any.
        finger: digest of that jaw's shape, empty where nobody knows; see `Jaw.digest`.
        solver: mechanics that it was identified with, "solid", "frame", "plane" or "paper"; empty where nobody knows.
    """

    young_modulus: float
    inner_thickness_factor: float = 1.0
    outer_thickness_factor: float = 1.0
    rib_thickness_factor: float = 1.0
    clamped_z: float = 0.0
    relaxation: tuple[RelaxationTerm, ...] = ()
    force_error: float = 0.02
    friction: float = 0.0
    friction_stddev: float = 0.02
    jaw: str = ""
    finger: str = ""
    solver: str = ""

    def __post_init__(self) -> None:
        """Refuses numbers that no finger has.

        Raises:
            CalibrationError: A number is not finite or out of bounds; the message names it.
        """
        bounds = {
            "young_modulus": (1e3, 1e12),
            "inner_thickness_factor": (0.3, 3.0),
            "outer_thickness_factor": (0.3, 3.0),
            "rib_thickness_factor": (0.3, 3.0),
            "clamped_z": (0.0, 0.05),
            "force_error": (0.0, 1.0),
            "friction": (0.0, 2.0),
            "friction_stddev": (1e-3, 2.0),
        }
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if not (isinstance(value, (int, float)) and np.isfinite(value) and low <= value <= high):
                raise CalibrationError(f"calibration: {name} = {value!r}, expected a number from {low:g} to {high:g}")
        for name in ("jaw", "finger"):
            if not isinstance(getattr(self, name), str):
                raise CalibrationError(f"calibration: {name} = {getattr(self, name)!r}, expected a text")
        if self.solver not in ("", *_MECHANICS):
            raise CalibrationError(f"calibration: solver = {self.solver!r}, expected one of {', '.join(_MECHANICS)}")
        for term in self.relaxation:
            if not (0.0 <= term.share <= 10.0 and 1e-3 <= term.time_constant <= 1e6):
                raise CalibrationError(f"calibration: {term}, expected a share from 0 to 10 and 1e-3 to 1e6 s")

    def apply(self, jaw: Jaw) -> Jaw:
        """Returns the jaw as it is.

        Raises:
            CalibrationError: The calibration belongs to another jaw.
        """
        if self.jaw and self.jaw != jaw.name:
            raise CalibrationError(f"the calibration belongs to the jaw {self.jaw!r}, got {jaw.name!r}")
        if self.finger and self.finger != jaw.digest:
            raise CalibrationError(
                f"the calibration belongs to a finger of another shape ({self.finger}, the jaw {jaw.name!r} is "
                f"{jaw.digest}): calibrate this one"
            )
        material = replace(jaw.material, young_modulus=float(self.young_modulus))
        if jaw.drawing is None:
            return replace(jaw, material=material)
        drawing = replace(
            jaw.drawing,
            inner=_thicken(jaw.drawing.inner, self.inner_thickness_factor, jaw.drawing),
            outer=_thicken(jaw.drawing.outer, self.outer_thickness_factor, jaw.drawing),
            ribs=tuple(replace(rib, thickness=rib.thickness * self.rib_thickness_factor) for rib in jaw.drawing.ribs),
            clamped_z=max(jaw.drawing.clamped_z, self.clamped_z),
        )
        return replace(jaw, drawing=drawing, material=material)

    def expect_error(self, jaw: Jaw, solver: str) -> float:
        """Returns the relative standard deviation of forces that is left with a solver.

        Another model than the one that was identified is off by what the two differ.

        Raises:
            CalibrationError: One of the two is the paper's, whose elements lock: its modulus is no other model's.
        """
        used = name_mechanics(jaw, solver)
        if self.solver in ("", used):
            return self.force_error
        if "paper" in (self.solver, used):
            raise CalibrationError(
                f"the calibration was identified with solver {self.solver!r}, which {used!r} cannot use; identify one "
                f"with `finforce calibrate --solver {solver}`"
            )
        return float(np.hypot(self.force_error, _MODELS_DIFFER))


def name_mechanics(jaw: Jaw, solver: str) -> str:
    """Returns the model behind the name of a solver: "solid", "frame", "plane" or "paper"."""
    return solver if solver in _MECHANICS else jaw.model


def _thicken(band: Band, factor: float, drawing: Drawing) -> Band:
    """Returns a thicker band with its outer face where it was; where a rigid tip joins centre lines, those stay."""
    shift = 0.5 * band.inward * band.thickness * (1.0 - factor) if drawing.tip_z is None else 0.0
    base, tip = (band.base[0] + shift, band.base[1]), (band.tip[0] + shift, band.tip[1])
    return replace(band, base=base, tip=tip, thickness=band.thickness * factor)


def load_calibration(name_or_path: str | Path) -> Calibration:
    """Loads a calibration from its YAML file or a shipped one by its name.

    Raises:
        CalibrationError: The file is missing, is no calibration, or has unknown keys.
    """
    path = _find_file(name_or_path)
    try:
        table = read_yaml(path)
    except FileError as error:
        raise CalibrationError(f"{path.name}: {error}") from error
    if not isinstance(table, dict) or "young_modulus" not in table:
        raise CalibrationError(f"{path.name}: expected a mapping with young_modulus, as `finforce calibrate` writes it")
    unknown = set(table) - _KEYS
    if unknown:
        raise CalibrationError(f"{path.name}: unknown key {sorted(unknown)[0]!r}; expected {', '.join(sorted(_KEYS))}")
    values = {key: value for key, value in table.items() if key not in ("comment", "uncertainty")}
    try:
        terms = tuple(RelaxationTerm(**term) for term in values.pop("relaxation", None) or ())
        return Calibration(relaxation=terms, **values)
    except (TypeError, CalibrationError) as error:
        raise CalibrationError(f"{path.name}: {error}") from error


def _find_file(name_or_path: str | Path) -> Path:
    folder = resources.files("finforce_ifea.jaw").joinpath("calibrations")
    shipped = Path(str(folder.joinpath(f"{name_or_path}.yaml")))
    path = shipped if "/" not in str(name_or_path) and shipped.is_file() else Path(name_or_path)
    if not path.is_file():
        raise CalibrationError(f"there is no calibration file {str(name_or_path)!r}")
    return path


def save_calibration(
    calibration: Calibration, path: str | Path, *, uncertainty: dict[str, float] | None = None
) -> None:
    """Writes a calibration as YAML, with the standard deviations of its numbers."""
    table = asdict(calibration)
    table["relaxation"] = [asdict(term) for term in calibration.relaxation]
    if uncertainty:
        table["uncertainty"] = {name: float(value) for name, value in uncertainty.items()}
    Path(path).write_text(yaml.safe_dump(table, sort_keys=False), encoding="utf-8")
