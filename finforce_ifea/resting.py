"""The contact of a grasp at rest, whose object may be hidden from whoever finds its pose."""

from math import inf, isfinite, nan

from finforce_ifea.observation import Contact, Solution

# A pressure centre that moves by no more than this along x [m] for so long [s] is that of a grasp at rest.
_REST_MOTION, _REST_TIME = 0.2e-3, 1.0
# A contact is kept for so long after the grasp has moved [s].
_KEPT = 1.0


class RestingContact:
    """Keeps the last contact of a grasp while no pose of the object comes and the jaw stays as it is bent."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the contact."""
        self._contact: Contact | None = None
        self._x, self._since, self._told, self._until = nan, 0.0, -inf, -inf

    def complete(self, contact: Contact | None, stamp: float) -> Contact | None:
        """Return the contact of an image [s], the last one where there is none and the grasp was at rest."""
        if contact is not None:
            self._contact, self._told = contact, stamp
            return contact
        return self._contact if stamp <= self._until else None

    def note(self, solution: Solution, stamp: float) -> None:
        """Take what the solver made of an image [s]."""
        x = float(solution.contact_point[0])
        if not abs(x - self._x) <= _REST_MOTION:  # no number, without contact, has moved
            self._x, self._since = x, stamp
        if isfinite(x) and self._told >= self._since and stamp - self._since >= _REST_TIME:
            self._until = stamp + _KEPT
