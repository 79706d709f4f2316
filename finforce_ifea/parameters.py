"""The parameters of a solver node, and the estimator that they ask for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from finforce.settings import GripperParameters, setting

if TYPE_CHECKING:
    from finforce_ifea.estimator import ForceEstimator
    from finforce_ifea.jaw.jaw import Jaw
    from finforce_ifea.settings import EstimatorSettings


@dataclass(frozen=True, kw_only=True)
class NodeParameters(GripperParameters):
    """Parameters of a solver node, in addition to the settings of its estimator; metadata holds units."""

    jaw_name: str = setting("left", "Jaw of this node", choices=("left", "right"))
    jaw_file: str = setting("bench", "Jaw file, or name of an included jaw")
    calibration_file: str = setting("", "Calibration file, or name of an included one; empty: material of the jaw file")
    gravity_frame: str = setting("", "Upright frame on /tf for gravity, such as base_link; empty: from the topic")
    contact_height: float = setting(
        math.nan,
        "Height of first touch above the clamped base; NaN: contacts from <jaw_name>/contact",
        "m",
        0.0,
        1.0,
    )
    contact_free: bool = setting(False, "Whether the solver may move contacts from the topic")
    contact_timeout: float = setting(
        0.008,
        "Maximum wait for the contact of an image",
        "s",
        0.0,
        1.0,
    )
    peer: str = setting(
        "",
        "Other jaw, whose wrenches complete grasp_wrench and manipulation_wrench; empty: none",
        choices=("", "left", "right"),
    )
    paired: bool = setting(False, "Whether another jaw holds the same object, if there is no peer")
    completes_grasp: bool = setting(False, "Whether this jaw's force is published as grasp_wrench, if there is no peer")
    publish_surface: bool = setting(True, "Whether the deformed mesh vertices are published")
    skip_off: tuple[str, ...] = setting(("",), "Disabled skip rules, as named in the diagnostics, or all")
    marker_rate: float = setting(10.0, "Maximum rate of the markers", "Hz", 0.1, 60.0)

    @property
    def frame(self) -> str:
        """The frame of this jaw's messages."""
        return self.jaw_frame(self.jaw_name)


def build_estimator(jaw: Jaw, parameters: NodeParameters, settings: EstimatorSettings) -> ForceEstimator:
    """Build the estimator of a node, compiled and ready for the first image; see `ForceEstimator`.

    Raises:
        FinforceError: the calibration or the settings do not fit the jaw.
    """
    from finforce_ifea.estimator import ForceEstimator
    from finforce_ifea.jaw.calibration import load_calibration

    file = parameters.calibration_file
    calibration = load_calibration(file) if file else None
    estimator = ForceEstimator(jaw, settings=settings, calibration=calibration)
    estimator.warm_up()
    return estimator
