"""The parameters of a solver node, the estimator that they ask for, and the contact that belongs to an image."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from finforce.errors import ObservationError
from finforce.messages import direction_from_message, stamp_of
from finforce.settings import TimeParameters, setting
from finforce_ifea.grasp_force import R_GRIPPER_JAW
from finforce_ifea.messages import contact_from_cloud, outline_from_cloud
from finforce_ifea.observation import Contact, ObjectOutline

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from finforce_ifea.estimator import JawEstimator
    from finforce_ifea.jaw.jaw import Jaw
    from finforce_ifea.settings import EstimatorSettings


@dataclass(frozen=True, kw_only=True)
class NodeParameters(TimeParameters):
    """Parameters of a solver node, in addition to the settings of its estimator; metadata holds units."""

    jaw_name: str = setting("left", "Jaw that this node solves", choices=("left", "right"))
    jaw_file: str = setting("bench", "Jaw file, or name of a shipped jaw")
    calibration_file: str = setting(
        "", "Calibration file, or name of a shipped one; empty for the material of the jaw file"
    )
    jaw_frame: str = setting("", "Frame of key points, contact and wrench; empty for <jaw_name>_jaw")
    gripper_frame: str = setting("gripper_base", "Frame of grasp_wrench and manipulation_wrench")
    contact_height: float = setting(
        math.nan,
        "Height of first touch above the clamped base; NaN when contacts come on <jaw_name>/contact",
        "m",
        0.0,
        1.0,
    )
    contact_free: bool = setting(False, "Whether the solver may move a contact that came on the topic")
    contact_timeout: float = setting(
        0.008,
        "Maximum wait for the contact of an image, while contacts keep up with images",
        "s",
        0.0,
        1.0,
        alias="contact_patience",
    )
    peer: str = setting(
        "",
        "Other jaw, whose wrenches complete grasp_wrench and manipulation_wrench here; empty for none",
        choices=("", "left", "right"),
    )
    paired: bool = setting(False, "Whether another jaw holds the same object, without a peer")
    completes_grasp: bool = setting(False, "Whether this jaw's force is published as grasp_wrench, without a peer")
    publish_surface: bool = setting(True, "Whether the deformed mesh vertices are published with every solved image")
    skip_off: tuple[str, ...] = setting(("",), "Skip rules that are not applied, as named in the diagnostics, or all")
    marker_rate: float = setting(10.0, "Maximum rate of the markers", "Hz", 0.1, 60.0)

    @property
    def frame(self) -> str:
        """The frame of this jaw's messages."""
        return self.jaw_frame or f"{self.jaw_name}_jaw"


def load_parameter_jaw(parameters: NodeParameters) -> Jaw:
    """Load the jaw that the parameters name.

    Raises:
        JawFileError: the file cannot be a jaw.
    """
    from finforce_ifea.jaw.jaw import load_jaw

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
        timeout=parameters.contact_timeout,
    )


def build_estimator(jaw: Jaw, parameters: NodeParameters, settings: EstimatorSettings) -> JawEstimator:
    """Build the estimator of a node, compiled and ready for the first image; see `JawEstimator`.

    Raises:
        FinforceError: the calibration or the settings do not fit the jaw.
    """
    from finforce_ifea.estimator import JawEstimator
    from finforce_ifea.jaw.calibration import load_calibration

    file = parameters.calibration_file
    calibration = load_calibration(file) if file else None
    estimator = JawEstimator(jaw, settings=settings, calibration=calibration)
    estimator.warm_up()
    return estimator


# Rows with which an image is still solved in time; a contact has a row every few millimetres, an outline some hundred.
MOST_ROWS, MOST_CORNERS = 500, 5000
IN_STEP = 2  # images in a row whose contacts came in time, after which the next one waits for its own


class ContactFeed:
    """Keeps the newest contact and the object's newest outline, and gives them away while they are fresh.

    Args:
        frame: the jaw frame, in which contacts have to come.
        fixed: a contact that holds for ever, instead of messages.
        free: whether the solver may move a contact that came by message.
        max_age: greatest distance between the stamps of contact and image [ns].
        timeout: after an image, in which its contact comes in time [s].
    """

    def __init__(self, *, frame: str, fixed: Contact | None, free: bool, max_age: int, timeout: float = 0.0) -> None:
        self._timeout = timeout
        self._frame, self._fixed, self._free, self._max_age = frame, fixed, free, max_age
        self._contact: Contact | None = None
        self._outline: ObjectOutline | None = None
        self._cut: ObjectOutline | None = None
        self._stamp = self._outline_stamp = 0
        self._image, self._seen, self._in_time = 0, -math.inf, 0

    def expect(self, stamp: int, now: float) -> bool:
        """Note that an image [ns] has come at a time [s]; return whether its contact will, and is worth waiting for."""
        if self._is_there(self._image) is False:
            self._in_time = 0
        self._image, self._seen = stamp, now
        return not (self.is_fixed or self._is_there(stamp)) and self._in_time >= IN_STEP

    def completes(self, now: float) -> bool:
        """Say whether the contact of the last image is there, at a time [s]; outlines come before their contacts."""
        is_there, is_next = self._is_there(self._image), self._is_there(self._image + 1)
        self._in_time = self._in_time + 1 if is_next or (is_there and now - self._seen <= self._timeout) else 0
        return is_there

    def _is_there(self, stamp: int) -> bool:
        return min(self._stamp, self._outline_stamp) >= stamp

    @property
    def is_fixed(self) -> bool:
        """Whether messages are needed at all."""
        return self._fixed is not None

    def take(self, cloud: Any, stamp: int) -> None:
        """Keep the contact of a sensor_msgs/PointCloud2; one that cannot be read leaves none.

        Raises:
            ObservationError: the frame, the height, the fields, the buffer or the number of rows are wrong.
            ContactError: a coordinate or a weight is not finite.
        """
        self._contact, self._stamp = None, stamp
        _check_size(cloud, MOST_ROWS, "the contact")
        self._contact = contact_from_cloud(cloud, self._frame, free=self._free)

    def take_outline(self, cloud: Any, stamp: int) -> None:
        """Keep the object's outline of a sensor_msgs/PointCloud2; one that cannot be read leaves none.

        Raises:
            ObservationError: the frame, the height, the fields, the buffer or the number of rows are wrong.
            ContactError: the corners are no outline.
        """
        self._outline, self._outline_stamp = None, stamp
        _check_size(cloud, MOST_CORNERS, "the outline")
        self._outline = outline_from_cloud(cloud, self._frame, self._cut)
        self._cut = self._outline or self._cut

    def at(self, stamp: int) -> Contact | None:
        """Return the contact for an image [ns], None if none is known or the known one is too old.

        It carries the object's outline while that is fresh; the same messages give the same object again.
        """
        if self._fixed is not None:
            return self._fixed
        if self._contact is None or abs(stamp - self._stamp) > self._max_age:
            return None
        fresh = abs(stamp - self._outline_stamp) <= self._max_age and len(self._contact.points)
        outline = self._outline if fresh else None
        if outline is not self._contact.outline:
            self._contact = replace(self._contact, outline=outline)
        return self._contact


def _check_size(cloud: Any, most: int, what: str) -> None:
    """Refuse a cloud of more than `most` rows, or with fields of several numbers each."""
    rows = cloud.width * cloud.height
    if rows > most:
        raise ObservationError(f"{what} came with {rows} rows; expected {most} at most")
    wide = [field.name for field in cloud.fields if field.count > 1]
    if wide:
        raise ObservationError(f"{what} came with several numbers in the field {', '.join(wide)}; expected one each")


class GravityFeed:
    """Keeps which way things fall, and gives it away while it is fresh.

    Args:
        parameters: of the node.
    """

    def __init__(self, parameters: NodeParameters) -> None:
        self._frame, self._R = parameters.gripper_frame, R_GRIPPER_JAW[parameters.jaw_name]
        self._max_age = round(1e9 * parameters.max_age)
        self._direction: NDArray | None = None
        self._stamp = 0

    def take(self, message: Any) -> None:
        """Keep a direction in the gripper's frame (geometry_msgs/Vector3Stamped), of any length.

        Raises:
            ObservationError: it is in another frame, or no direction.
        """
        self._direction = direction_from_message(message, self._frame, "gravity") @ self._R
        self._stamp = stamp_of(message)

    def at(self, stamp: int) -> NDArray | None:
        """Return the direction (3,) in the jaw's frame, None where it is farther from an image [ns] than `max_age`."""
        return self._direction if abs(stamp - self._stamp) <= self._max_age else None
