"""Rig files: the camera of a gripper, its place, how the jaws are mounted, and what their holders cover."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import Field

from finforce.camera import CameraIntrinsics
from finforce.errors import PoseError, RigError
from finforce.transforms import pose_from_quaternion
from finforce.typed_yaml import FileModel, Length, Number, Text, read_model

HEAD = (
    "# A camera and the jaws before it, made by `finforce camera`. m, rad, px; T_gripper_camera: x y z qx qy qz qw.\n"
    "# covered: key points that the holder hides, or the picture's edge; add or remove names as you see fit.\n"
)


WIDER = 0.01  # [m] by which a jaw can be farther out than in the pictures of open jaws


class RigCamera(FileModel):
    """Intrinsics."""

    width: int = Field(gt=0, description="[px]")
    height: int = Field(gt=0, description="[px]")
    fx: Number = Field(gt=0.0, description="Focal length along the rows [px]")
    fy: Number = Field(gt=0.0, description="Focal length along the columns [px]")
    cx: Number = Field(description="Column of the principal point [px]")
    cy: Number = Field(description="Row of the principal point [px]")
    distortion: tuple[Number, ...] = Field((), description="Coefficients of the lens")
    model: Text = Field(description="Lens: plumb_bob, rational_polynomial or equidistant")


Corner = tuple[Number, Number, Number]


class RigTag(FileModel):
    """A tag that is fixed to a jaw's holder."""

    id: int = Field(ge=0, description="Its number")
    corners: tuple[Corner, Corner, Corner, Corner] = Field(description="x, y, z in the jaw frame [m]")


class RigJaw(FileModel):
    """The mounting of a jaw."""

    turn: tuple[Number, Number, Number] = Field((0.0, 0.0, 0.0), description="Rotation vector in its own frame [rad]")
    covered: tuple[Text, ...] = Field((), description="Names of key points that are never seen")
    tag: RigTag | None = Field(None, description="What tells where its holder is")
    stddev: tuple[Annotated[Number, Field(ge=0.0)], Annotated[Number, Field(ge=0.0)]] = Field(
        (0.0, 0.0), description="Standard deviations of its place along its z [m] and of the scale at which it is seen"
    )


class Rig(FileModel):
    """A camera and the jaws before it."""

    jaw: Text = Field(description="Jaw file, or name of a shipped jaw")
    camera: RigCamera = Field(description="Intrinsics")
    T_gripper_camera: Annotated[tuple[Number, ...], Field(min_length=7, max_length=7)] = Field(
        description="Pose of the camera: x, y, z [m], qx, qy, qz, qw"
    )
    half_opening: Length = Field(0.045, description="Half the distance of the jaws' origins when it was made [m]")
    likelihood_odds: Annotated[Number, Field(ge=1.0, le=20.0)] = Field(
        1.0, description="Factor on the odds of likelihoods, which are low on small or unusual fingers"
    )
    tag_family: Text = Field("4x4_50", description="Family of the tags")
    left: RigJaw | None = Field(None, description="The left jaw")
    right: RigJaw | None = Field(None, description="The right jaw")

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The camera."""
        entries = self.camera.model_dump()
        return CameraIntrinsics(**{**entries, "distortion": np.array(entries["distortion"], dtype=float)})

    def detector_parameters(self) -> dict[str, Any]:
        """Return the parameters of the detector that the rig sets, by their names."""
        jaws = {side: jaw for side in ("left", "right") if (jaw := getattr(self, side)) is not None}
        covered = [f"{side}/{name}" for side, jaw in jaws.items() for name in jaw.covered]
        tags = {side: jaw.tag for side, jaw in jaws.items() if jaw.tag is not None}
        return {
            "T_gripper_camera": list(self.T_gripper_camera),
            **{f"{side}_turn": list(jaw.turn) for side, jaw in jaws.items()},
            **{f"{side}_stddev": list(jaw.stddev) for side, jaw in jaws.items()},
            **{f"{side}_tag": [float(tag.id), *chain(*tag.corners)] for side, tag in tags.items()},
            "tag_family": self.tag_family,
            "covered": covered or [""],
            "likelihood_odds": self.likelihood_odds,
            "detector.opening_max": self.half_opening + WIDER,
        }


def read_rig(path: str | Path) -> Rig:
    """Return a rig; a jaw file is looked for next to it, too.

    Raises:
        RigError: the file cannot be read, or is no rig.
    """
    path = Path(path)

    def fail(text: str) -> RigError:
        return RigError(f"{path.name}: {text}")

    rig = read_model(path, Rig, fail)
    try:
        pose_from_quaternion(rig.T_gripper_camera[:3], rig.T_gripper_camera[3:])
    except PoseError as error:
        raise fail(f"T_gripper_camera: {error}") from error
    beside = path.parent / rig.jaw
    return rig.model_copy(update={"jaw": str(beside)}) if beside.is_file() else rig


def write_rig(rig: Rig, path: Path) -> None:
    """Write a rig as YAML; raises OSError where it cannot be."""
    content = rig.model_dump(mode="json", exclude_none=True)
    path.write_text(HEAD + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))
