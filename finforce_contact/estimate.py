"""What a contact estimator says about one image; knows not how it was found."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.observation import Contact
from finforce_ifea.outline import ObjectOutline

STATUSES = ("touching", "apart", "no_object", "no_pose")


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactEstimate:
    """Where the object touches a jaw, or would touch first; without rows when nobody knows.

    Attributes:
        stamp: of the image [s].
        status: "touching", "apart", "no_object" or "no_pose".
        message: what to tell the user, empty when there is nothing to tell.
        points: (n, 3) [m] on the undeformed inner surface.
        candidates: (n,) the jaw's candidate nearest to each point.
        weights: (n,) shares of the force, sum 1.
        touching: whether object and jaw touch.
        skipped: why no new place was looked for, empty when one was.
        outline: of the object in the finger's plane, None when its pose is not known or the mode has no use for it.
        T_jaw_object: (4, 4), None when not known.
        probability: of contact, as far as the mode tells.
    """

    stamp: float
    status: str
    message: str
    points: NDArray
    candidates: NDArray
    weights: NDArray
    touching: bool
    skipped: str
    outline: ObjectOutline | None
    T_jaw_object: NDArray | None
    probability: float

    @property
    def contact(self) -> Contact | None:
        """The contact for the solver, None when there are no rows."""
        if not len(self.points):
            return None
        return Contact(points=self.points, weights=self.weights, touching=self.touching, outline=self.outline)


def blank_estimate(stamp: float, status: str, message: str, T_jaw_object: NDArray | None = None) -> ContactEstimate:
    """Returns an estimate without rows, for whatever is no known contact."""
    return ContactEstimate(
        stamp=stamp,
        status=status,
        message=message,
        points=np.empty((0, 3)),
        candidates=np.empty(0, np.int64),
        weights=np.empty(0),
        touching=False,
        skipped="",
        outline=None,
        T_jaw_object=T_jaw_object,
        probability=0.0,
    )
