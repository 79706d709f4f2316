"""The calibration of one finger, and its file."""

from collections.abc import Mapping
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BeforeValidator, Field, model_validator

from finforce.errors import suggest
from finforce.typed_yaml import FileModel, Number, parse_model, read_model
from finforce_ifea.errors import CalibrationError
from finforce_ifea.jaw.drawing import Band, Drawing
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.relaxation import RelaxationTerm

_MECHANICS = ("solid", "frame", "plane", "paper")
# Forces of the solid and the frame of one finger differ by 1 to 3 % up to 10 mm.
_MODELS_DIFFER = 0.03

_SOFT = (5e6, 200e6)  # [Pa], range of the modulus of printed TPU over all its hardnesses
_DATASHEET_FACTOR = 3.0  # [-], largest ratio of a modulus to that of its data sheet
WORST_MISFIT = 0.15  # [-] of a force: estimates of one finger differ by less, those of other times or holds by more
_UNIT_FACTOR = 100.0  # [-], ratio from which it is in another unit

Factor = Annotated[Number, Field(ge=0.3, le=3.0)]


Terms = Annotated[tuple[RelaxationTerm, ...], BeforeValidator(lambda value: () if value is None else value)]


class Calibration(FileModel):
    """A printed finger as it is, in place of as drawn."""

    young_modulus: Number = Field(ge=1e3, le=1e12, description="Young's modulus [Pa]")
    inner_thickness_factor: Factor = Field(1.0, description="Effective over drawn thickness of the inner band [-]")
    outer_thickness_factor: Factor = Field(1.0, description="Effective over drawn thickness of the outer band [-]")
    rib_thickness_factor: Factor = Field(1.0, description="Effective over drawn thickness of the ribs [-]")
    clamped_z: Number = Field(0.0, ge=0.0, le=0.05, description="Effective height of the clamp [m]")
    relaxation: Terms = Field((), description="Branches of the material's relaxation: share [-], time_constant [s]")
    force_error: Number = Field(0.02, ge=0.0, le=1.0, description="Relative standard deviation of forces left [-]")
    jaw: str = Field("", description="Name of the jaw that it belongs to; empty: any")
    finger: str = Field("", description="Digest of that jaw's shape; empty: not known")
    solver: Literal["", "solid", "frame", "plane", "paper"] = Field("", description="Mechanics identified with")
    comment: str = Field("", description="Remark for people")
    uncertainty: dict[str, float] = Field({}, description="Standard deviations, for people")

    @model_validator(mode="before")
    @classmethod
    def _leave_friction_out(cls, values: Any) -> Any:
        """Leave out the friction of the objects pressed, which older files have: it is the objects' own."""
        if not isinstance(values, Mapping):
            return values
        return {name: value for name, value in values.items() if name not in ("friction", "friction_stddev")}

    def changed(self, **values: Any) -> "Calibration":
        """Return a calibration with other values.

        Raises:
            CalibrationError: One of them no finger has.
        """
        return make_calibration(**{**dict(self), **values})

    @property
    def is_of_shape(self) -> bool:
        """True if it changes the shape of a finger, and not only the material."""
        factors = self.inner_thickness_factor, self.outer_thickness_factor, self.rib_thickness_factor
        return factors != (1.0, 1.0, 1.0) or self.clamped_z > 0.0

    def apply(self, jaw: Jaw) -> Jaw:
        """Return the jaw as it is.

        Raises:
            CalibrationError: The calibration belongs to another jaw, or its modulus is in another unit.
        """
        if self.jaw and self.jaw != jaw.name:
            raise CalibrationError(f"the calibration belongs to the jaw {self.jaw!r}, got {jaw.name!r}")
        if self.finger and self.finger != jaw.digest:
            raise CalibrationError(
                f"the calibration belongs to a finger of another shape ({self.finger}, the jaw {jaw.name!r} is "
                f"{jaw.digest}): calibrate this one"
            )
        if self.jaw and not self.finger and self.is_of_shape:
            raise CalibrationError(
                f"the calibration has thicknesses or a clamp and no `finger`, expected the shape that it belongs to; "
                f"add `finger: {jaw.digest}` to its file if that was this jaw {jaw.name!r}, else calibrate this one"
            )
        if not 1.0 / _UNIT_FACTOR < self.young_modulus / jaw.material.young_modulus < _UNIT_FACTOR:
            raise CalibrationError(
                f"young_modulus {self.young_modulus:.3g} Pa, the jaw file of {jaw.name!r} says "
                f"{jaw.material.young_modulus:.3g} Pa: expected Pa in both"
            )
        material = jaw.material.model_copy(update={"young_modulus": self.young_modulus})
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

    def check_plausible(self, jaw: Jaw) -> None:
        """Refuse a modulus that no part printed as the jaw file says has, and forces that did not fit the shapes.

        Raises:
            CalibrationError: It is off the jaw file's by more than a factor of 3, or not that of a soft material; or
                more than `WORST_MISFIT` is left.
        """
        drawn, found = jaw.material.young_modulus, self.young_modulus
        low, high = drawn / _DATASHEET_FACTOR, drawn * _DATASHEET_FACTOR
        if _SOFT[0] <= drawn <= _SOFT[1]:
            low, high = max(low, _SOFT[0]), min(high, _SOFT[1])
        if not low <= found <= high:
            raise CalibrationError(
                f"modulus {1e-6 * found:.4g} MPa, expected {1e-6 * low:.4g} to {1e-6 * high:.4g} MPa: the jaw file "
                f"of {jaw.name!r} says {1e-6 * drawn:.4g} MPa; check units, contact and finger, or give --force"
            )
        if self.force_error > WORST_MISFIT:
            raise CalibrationError(
                f"{100 * self.force_error:.0f} % of a force left over, expected at most {100 * WORST_MISFIT:.0f} %: do "
                "forces and images have one clock? Check contact and finger, or give --force"
            )

    def expect_error(self, jaw: Jaw, solver: str) -> float:
        """Return the relative standard deviation of forces that is left with a solver.

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


def make_calibration(**values: Any) -> Calibration:
    """Return a calibration; raises CalibrationError where no finger has one of its numbers."""
    return parse_model(values, Calibration, CalibrationError)


def name_mechanics(jaw: Jaw, solver: str) -> str:
    """Return the model behind the name of a solver: "solid", "frame", "plane" or "paper"."""
    return solver if solver in _MECHANICS else jaw.model


def _thicken(band: Band, factor: float, drawing: Drawing) -> Band:
    """Return a thicker band with its outer face where it was; where a rigid tip joins centre lines, those stay."""
    shift = 0.5 * band.inward * band.thickness * (1.0 - factor) if drawing.tip_z is None else 0.0
    base, tip = (band.base[0] + shift, band.base[1]), (band.tip[0] + shift, band.tip[1])
    return replace(band, base=base, tip=tip, thickness=band.thickness * factor)


def load_calibration(name_or_path: str | Path | Calibration) -> Calibration:
    """Load a calibration from its YAML file, or an included one by its name; a calibration is returned unchanged.

    Raises:
        CalibrationError: The file is missing, is no calibration, or has unknown keys.
    """
    if isinstance(name_or_path, Calibration):
        return name_or_path
    path = _find_file(name_or_path)
    try:
        return read_model(path, Calibration, CalibrationError)
    except CalibrationError as error:
        raise CalibrationError(f"{path.name}: {error}") from error


def _find_file(name_or_path: str | Path) -> Path:
    folder = resources.files("finforce_ifea.jaw").joinpath("calibrations")
    shipped = Path(str(folder.joinpath(f"{name_or_path}.yaml")))
    path = shipped if "/" not in str(name_or_path) and shipped.is_file() else Path(name_or_path)
    if not path.is_file():
        shipped = [file.name.removesuffix(".yaml") for file in folder.iterdir()]
        advice = suggest(str(name_or_path), sorted(shipped))
        raise CalibrationError(f"there is no calibration file {str(name_or_path)!r}, {advice} (or give a path)")
    return path


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration as YAML."""
    unsaid = {name for name in ("comment", "uncertainty") if not getattr(calibration, name)}
    table = calibration.model_dump(mode="json", exclude=unsaid)
    Path(path).write_text(yaml.safe_dump(table, sort_keys=False), encoding="utf-8")
