"""Which key points of a frame may be used; knows no mechanics."""

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.errors import ObservationError
from finforce_ifea.jaw import Jaw
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
        likelihood = np.asarray(observation.likelihood)
        visible = likelihood >= self._threshold
        if self._presence is None:
            self._presence = visible.astype(float)
        self._presence += _PRESENCE_GAIN * (visible - self._presence)
        far = np.abs(points - self._rest).max(axis=1, initial=0.0)
        usable = visible & (self._presence >= _LEAST_PRESENCE) & self._allowed & (far <= self._margin)
        points[~usable] = np.nan
        return points
