"""The parameters of a solver node, and the estimator that they ask for; knows no ROS."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from finforce_ifea.contact_feed import ContactFeed
from finforce_ifea.observation import Contact
from finforce_records import TimeParameters, parameter

if TYPE_CHECKING:
    from finforce_ifea.estimator import JawEstimator
    from finforce_ifea.jaw import Jaw
    from finforce_ifea.settings import EstimatorSettings


@dataclass(frozen=True, kw_only=True)
class NodeParameters(TimeParameters):
    """What a solver node is told beside the estimator's own settings; units stand in the metadata."""

    jaw_name: str = parameter("left", "the jaw that this node solves", choices=("left", "right"))
    jaw_file: str = parameter("bench", "jaw file, or the name of a shipped jaw")
    calibration_file: str = parameter("", "calibration file, or a shipped name; empty: the material of the jaw file")
    jaw_frame: str = parameter("", "frame of key points, contact and wrench; empty: <jaw_name>_jaw")
    gripper_frame: str = parameter("gripper_base", "frame of grasp_wrench and manipulation_wrench")
    contact_height: float = parameter(
        math.nan,
        "height of first touch above the clamped base; NaN: contacts come on <jaw_name>/contact",
        unit="m",
        min=0.0,
        max=1.0,
    )
    contact_free: bool = parameter(False, "the solver may move a contact that came on the topic")
    peer: str = parameter(
        "",
        "the other jaw, whose wrenches complete grasp_wrench and manipulation_wrench here; empty: none",
        choices=("", "left", "right"),
    )
    completes_grasp: bool = parameter(False, "without a peer: publish this jaw's force as grasp_wrench")
    publish_surface: bool = parameter(True, "publish the deformed mesh vertices with every solved image")
    skip_off: tuple[str, ...] = parameter(
        ("",), "rules that are not applied, by their names in the diagnostics after `skipped:`, or all"
    )
    marker_rate: float = parameter(
        10.0, "greatest rate of the markers, which are sent only to listeners", unit="Hz", min=0.1, max=60.0
    )

    @property
    def frame(self) -> str:
        """The frame of this jaw's messages."""
        return self.jaw_frame or f"{self.jaw_name}_jaw"


def load_parameter_jaw(parameters: NodeParameters) -> Jaw:
    """Load the jaw that the parameters name.

    Raises:
        JawFileError: the file cannot be a jaw.
    """
    from finforce_ifea.jaw import load_jaw

    return load_jaw(parameters.jaw_file, parameters.jaw_name)


def build_contact_feed(jaw: Jaw, parameters: NodeParameters) -> ContactFeed:
    """Return the source of contacts that the parameters ask for.

    Raises:
        ContactError: the fixed height is not on the jaw.
    """
    height = parameters.contact_height
    return ContactFeed(
        frame=parameters.frame,
        fixed=None if math.isnan(height) else Contact.fixed(jaw, height),
        free=parameters.contact_free,
        max_age=round(1e9 * parameters.max_age),
    )


def build_estimator(jaw: Jaw, parameters: NodeParameters, settings: EstimatorSettings) -> JawEstimator:
    """Build the estimator of a node, compiled and ready for the first image.

    Raises:
        FinforceError: the calibration or the settings do not fit the jaw.
    """
    from finforce_ifea.calibration import load_calibration
    from finforce_ifea.estimator import JawEstimator

    file = parameters.calibration_file
    calibration = load_calibration(file) if file else None
    estimator = JawEstimator(jaw, settings=settings, calibration=calibration)
    estimator.warm_up()
    return estimator
