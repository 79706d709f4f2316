"""The contact that belongs to an image: a fixed one, or the newest that came by message; estimates none."""

from __future__ import annotations

from typing import Any

from finforce_ifea.messages import contact_from_cloud
from finforce_ifea.observation import Contact


class ContactFeed:
    """Keeps the newest contact and gives it away while it is fresh.

    Args:
        frame: the jaw frame, in which contacts have to come.
        fixed: a contact that holds for ever, instead of messages.
        free: whether the solver may move a contact that came by message.
        max_age: greatest distance between the stamps of contact and image [ns].
    """

    def __init__(self, *, frame: str, fixed: Contact | None, free: bool, max_age: int) -> None:
        self._frame, self._fixed, self._free, self._max_age = frame, fixed, free, max_age
        self._contact: Contact | None = None
        self._stamp = 0

    @property
    def is_fixed(self) -> bool:
        """Whether messages are needed at all."""
        return self._fixed is not None

    def take(self, cloud: Any, stamp: int) -> None:
        """Keep the contact of a sensor_msgs/PointCloud2; one that cannot be read leaves none.

        Raises:
            ObservationError: the frame, the height, the fields or the buffer are wrong.
            ContactError: a coordinate or a weight is not finite.
        """
        self._contact, self._stamp = None, stamp
        self._contact = contact_from_cloud(cloud, self._frame, free=self._free)

    def at(self, stamp: int) -> Contact | None:
        """Return the contact for an image [ns], None if none is known or the known one is too old."""
        if self._fixed is not None:
            return self._fixed
        return self._contact if abs(stamp - self._stamp) <= self._max_age else None
