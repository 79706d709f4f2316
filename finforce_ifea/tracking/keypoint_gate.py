"""Which key points of a frame may be used."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce.errors import ObservationError
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.observation import Observation
from finforce_ifea.settings import EstimatorSettings

_PRESENCE_GAIN = 0.1
_LEAST_PRESENCE = 0.5


class KeypointGate:
    """Switches key points off that are hidden, without depth, outside the workspace, ignored, or seen rarely.

    A hidden point comes through now and then with a high likelihood, on the surface of what hides it. A point that was
    not there in half of the last frames is therefore not believed when it appears.
    """

    def __init__(self, jaw: Jaw, settings: EstimatorSettings) -> None:
        """Keeps the key points at rest and the thresholds.

        Raises:
            ObservationError: A name to be ignored is no key point of the jaw.
        """
        self._rest = jaw.keypoints
        self._threshold = settings.likelihood_threshold
        self._margin = settings.workspace_margin
        self._allowed = np.ones(len(jaw.keypoints), bool)
        for name in filter(None, (part.strip() for part in settings.ignored_keypoints.split(","))):
            if name not in jaw.keypoint_names:
                raise ObservationError(f"ignored_keypoints: {name!r} is no key point of the jaw {jaw.name!r}")
            self._allowed[jaw.keypoint_names.index(name)] = False
        self.reset()

    def reset(self) -> None:
        """Forgets which points were seen."""
        self._presence: NDArray | None = None

    def accept(self, observation: Observation) -> NDArray:
        """Returns the points (K, 3) [m] with NaN in the rows that must not be used."""
        points = np.array(observation.points, float)
        likelihood = np.asarray(observation.likelihood, float)
        if self._presence is None:
            self._presence = (likelihood >= self._threshold).astype(float)
        _close(points, likelihood, self._rest, self._allowed, self._presence, self._threshold, self._margin)
        return points


@njit(cache=True)
def _close(points, likelihood, rest, allowed, presence, threshold, margin):
    """Updates the presence (K,) and makes the points (K, 3) [m] that must not be used NaN."""
    for k in range(len(points)):
        visible = likelihood[k] >= threshold
        presence[k] += _PRESENCE_GAIN * ((1.0 if visible else 0.0) - presence[k])
        far = np.abs(points[k] - rest[k]).max()
        if not (visible and presence[k] >= _LEAST_PRESENCE and allowed[k] and far <= margin):
            points[k] = np.nan
