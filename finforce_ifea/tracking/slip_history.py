"""How far an object makes use of its friction, by the way that it has gone.

A second contact of the same jaw is pressed by the object alone, wherever it was found, with friction and its history.
Noise is no motion: the object moves there once it has left its last place by more than chance.
"""

from math import ceil, sqrt

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import DEPTH, HEIGHT, Indenter
from finforce_ifea.contact_mechanics.pressed_jaw import limit_step
from finforce_ifea.reduced.evaluation import ReducedContact

# Below this coefficient there is next to nothing to follow; the way is that of an object as rough as this.
_LEAST_COEFFICIENT = 0.15
# Chance, in standard deviations of the depth, at least [m]; and of a height [m].
_SIGMAS, _LEAST_PLAY, _PLAY_HEIGHT = 2.4, 0.03e-3, 1e-3
_ITERATIONS, _SETTLED = 12, 2e-3
# A way longer than this is no way but another contact; a shorter one than the second is left for later; along the way,
# steps of at most the third [m].
_LEAP, _SHORTEST, _LONGEST = 1.5e-3, 0.08e-3, 0.12e-3
# Corrections that turn round by this much of their length are halved: points of the contact stick and slide by turns.
_TURNED, _CALMER, _LEAST_CORRECTION = -0.3, 1.5, 0.1


class SlipHistory:
    """Follows one object.

    Attributes:
        mobilised: what friction bears over what it could, from -1 to 1.
    """

    def __init__(self, contact: ReducedContact) -> None:
        """Takes a contact with friction for its own."""
        self._contact = contact
        self.reset()

    def reset(self) -> None:
        """Forgets the way."""
        self.mobilised = 0.0
        self._place: NDArray | None = None
        self._contact.rubbing.reset()

    def set_indenter(self, indenter: Indenter) -> None:
        """Takes the object as it is pressed in from now on."""
        self._contact.set_indenter(indenter)

    def shift(self, change: float) -> None:
        """Counts the depth `change` [m] more, as of an object that was cut anew."""
        if self._place is not None:
            self._place[DEPTH] += change
            self._contact.rubbing.shift(-change)

    def follow(self, q: NDArray, place: NDArray, stddev: float, coefficient: float) -> float:
        """Returns how far friction is mobilised at a place.

        Args:
            q: shape of the jaw there, for a beginning (size,).
            place: depth [m], shape, height [m] of the object.
            stddev: of the depth [m].
            coefficient: of friction.
        """
        self._contact.rubbing.coefficient = max(coefficient, _LEAST_COEFFICIENT)
        if self._place is None or abs(place[DEPTH] - self._place[DEPTH]) > _LEAP:
            self.reset()
            self._q, self._place = q.copy(), place.copy()
            return self.mobilised
        play = max(_SIGMAS * stddev, _LEAST_PLAY)
        deeper = leave_play(place[DEPTH] - self._place[DEPTH], play)
        higher = leave_play(place[HEIGHT] - self._place[HEIGHT], _PLAY_HEIGHT)
        way = sqrt(deeper * deeper + higher * higher)
        if way < _SHORTEST:
            return self.mobilised
        aim, start, steps = place.copy(), self._place, ceil(way / _LONGEST)
        aim[DEPTH], aim[HEIGHT] = start[DEPTH] + deeper, start[HEIGHT] + higher
        for step in range(1, steps + 1):
            there = start + (aim - start) * (step / steps)
            if not (self._press(self._q, there) or self._press(q, there)):
                break
        return self.mobilised

    def _press(self, q: NDArray, place: NDArray) -> bool:
        """Presses the jaw of unknowns q (size,) at the next place; returns False, all as it was, where that fails."""
        contact, calm = self._contact, 1.0
        corrected = np.zeros(contact.model.size)
        for _ in range(_ITERATIONS):
            state = contact.linearize(q, place)
            if not state.touches:
                q = q + contact.approach(q, state.correction, place)
                continue
            correction = limit_step(contact.model, state.correction)
            calm = calm_down(correction, corrected, calm)
            q, corrected = q + calm * correction, correction
            if state.size < _SETTLED:
                self._q, self._place = q, place
                self.mobilised = contact.settle(q, place)
                return True
        return False


def leave_play(way: float, play: float) -> float:
    """Returns the part of a way that something makes which follows with play."""
    return way - min(max(way, -play), play)


def calm_down(correction: NDArray, before: NDArray, calm: float) -> float:
    """Returns the share of a correction (size,) to be made after another one of which a share `calm` was made."""
    size = np.sqrt((correction @ correction) * (before @ before))
    if size > 0.0 and correction @ before < _TURNED * size:
        return max(_LEAST_CORRECTION, 0.5 * calm)
    return min(1.0, _CALMER * calm)
