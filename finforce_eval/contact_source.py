"""Where the contact of an image comes from: given once, or estimated from mesh, pose and deformed jaw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finforce_contact.errors import PoseError
from finforce_eval.errors import RecordingError
from finforce_eval.objects import ObjectTrack
from finforce_ifea.estimator import Contact

Wrench = tuple[NDArray[np.float64], NDArray[np.float64]]


class ContactSource(Protocol):
    """Gives the contact for one image after the other.

    Attributes:
        name: what it is, for the report.
        estimate: what the contact estimator said last (a ContactEstimate); None for a contact that was given.
    """

    name: str
    estimate: Any

    def contact_at(self, stamp: int) -> Contact | None:
        """Return the contact for an image [ns]; None when nothing is known."""

    def learn(self, stamp: int, surface: NDArray[np.float64], wrench: Wrench | None) -> None:
        """Take what the solver made of that image.

        Args:
            stamp: of the image [ns].
            surface: deformed vertices (n, 3) [m], jaw frame.
            wrench: force (3,) [N] and torque (3,) [N m] about the jaw's origin; None when not trusted.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class GivenContact:
    """One contact for all images."""

    contact: Contact | None
    name: str = "given"
    estimate: None = None

    def contact_at(self, stamp: int) -> Contact | None:
        """Return it."""
        return self.contact

    def learn(self, stamp: int, surface: NDArray[np.float64], wrench: Wrench | None) -> None:
        """Learn nothing."""


class EstimatedContact:
    """The contact estimator, fed as its node is: poses as they come, then surface and wrench of the image before.

    Args:
        estimator: a fresh ContactEstimator.
        track: the object's poses in the jaw frame.
        name: for the report.
    """

    def __init__(self, estimator: Any, track: ObjectTrack, name: str) -> None:
        """Start before the first pose."""
        self.name = name
        self.estimate: Any = None
        self._estimator, self._track, self._next = estimator, track, 0

    def contact_at(self, stamp: int) -> Contact | None:
        """Give the poses up to an image to the estimator, and return what it said last.

        Raises:
            RecordingError: the estimator refuses a pose.
        """
        while self._next < len(self._track.stamps) and self._track.stamps[self._next] <= stamp:
            self._take_pose(self._next)
            self._next += 1
        if self.estimate is None:
            self.estimate = self._estimator.update(stamp * 1e-9)
        return self.estimate.contact

    def _take_pose(self, index: int) -> None:
        """Give one pose to the estimator."""
        time = float(self._track.stamps[index] * 1e-9)
        camera = None if self._track.cameras is None else self._track.cameras[index]
        try:
            self._estimator.take_pose(time, self._track.poses[index], camera=camera)
        except PoseError as error:
            raise RecordingError(f"object pose at {time:.3f} s: {error}") from error

    def learn(self, stamp: int, surface: NDArray[np.float64], wrench: Wrench | None) -> None:
        """Locate the contact on the deformed jaw, for the next image."""
        self.estimate = self._estimator.update(stamp * 1e-9, surface, wrench)
