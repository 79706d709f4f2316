"""The contact that belongs to an image: a fixed one, or the newest that came by message; estimates none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from finforce_ifea.errors import ObservationError
from finforce_ifea.messages import contact_from_cloud, outline_from_cloud
from finforce_ifea.observation import Contact
from finforce_ifea.outline import ObjectOutline

# Rows with which an image is still solved in time; a contact has a row every few millimetres, an outline some hundred.
MOST_ROWS, MOST_CORNERS = 500, 5000


class ContactFeed:
    """Keeps the newest contact and the object's newest outline, and gives them away while they are fresh.

    Args:
        frame: the jaw frame, in which contacts have to come.
        fixed: a contact that holds for ever, instead of messages.
        free: whether the solver may move a contact that came by message.
        max_age: greatest distance between the stamps of contact and image [ns].
    """

    def __init__(self, *, frame: str, fixed: Contact | None, free: bool, max_age: int) -> None:
        self._frame, self._fixed, self._free, self._max_age = frame, fixed, free, max_age
        self._contact: Contact | None = None
        self._outline: ObjectOutline | None = None
        self._cut: ObjectOutline | None = None
        self._stamp = self._outline_stamp = 0

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
