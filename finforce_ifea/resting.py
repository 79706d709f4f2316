"""The contact of a grasp at rest, whose object may be hidden from whoever finds its pose."""

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
        self._x, self._since, self._until = float("nan"), 0.0, float("-inf")

    def complete(self, contact: Contact | None, stamp: float) -> Contact | None:
        """Return the contact of an image [s], the last one where there is none and the grasp was at rest."""
        if contact is not None:
            self._contact = contact
            return contact
        return self._contact if stamp <= self._until else None

    def note(self, solution: Solution) -> None:
        """Take what the solver made of an image with this contact."""
        x = float(solution.contact_point[0])
        if not abs(x - self._x) <= _REST_MOTION:  # neither is what is not a number
            self._x, self._since = x, solution.stamp
        if x == x and solution.stamp - self._since >= _REST_TIME:
            self._until = solution.stamp + _KEPT
