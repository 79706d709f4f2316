"""Whether key points have a load that is held at a given height somewhere else."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.place_update import doubt_place
from finforce_ifea.tracking.rest_response import RestResponse

# A pressed object travels along the finger by this share of its depth, one standard deviation: 20 mm becomes 13.8 mm at
# 10 mm of a cylinder of 35 mm, less with smaller ones and higher up.
_TRAVEL = 0.3
# No averaging makes the place that key points ask for surer than this [m]: their answers are those of the unloaded jaw.
_SUREST = 2e-3


@dataclass(frozen=True, kw_only=True)
class PlaceDoubt:
    """What is to be thought of a given place.

    Attributes:
        away: how far the key points alone would have the load from there [m].
        mistaken: probability that it is not there.
        stddev: of the place [m].
        share: relative standard deviation of the force that follows.
    """

    away: float
    mistaken: float
    stddev: float
    share: float


def blank_doubt() -> PlaceDoubt:
    """Returns no doubt at all."""
    return PlaceDoubt(away=0.0, mistaken=0.0, stddev=0.0, share=0.0)


class PlaceWatch:
    """Averages where the key points would have the load, and says how far the given place can be believed.

    A load F at the height z moves the key points by F U(z). What is left of their residuals r once F has been fitted,
    and P takes U out,

        dz = (P U' . r) / (F P U' . P U'),      variance 1 / (F^2 P U' . P U'),

    is the way to the place that they ask for. A place that is off by dz changes the force by (U . U') / (U . U) dz F.
    """

    def __init__(self, response: RestResponse, settings: EstimatorSettings) -> None:
        """Keeps the answers of the unloaded jaw and how well heights are known."""
        self._response = response
        self._prior_variance = settings.height_stddev**2
        self._memory = float(settings.memory)
        self._height, self._spread = float(np.median(response.heights)), 0.0
        self.reset()

    def reset(self) -> None:
        """Forgets where the key points had the load."""
        self._away, self._information = 0.0, 0.0

    def follow(self, heights: NDArray, weights: NDArray) -> None:
        """Takes a load's heights (n,) [m] and their weights (n,) over; another mean height is another load.

        Shares of a spread load are hardly better known than that it is somewhere there.
        """
        height = float(np.average(heights, weights=weights))
        if abs(height - self._height) > _SUREST:
            self.reset()
        self._height = height
        self._spread = float(np.average((heights - height) ** 2, weights=weights))

    def doubt(self, residuals: NDArray, precision: NDArray, force: float) -> PlaceDoubt:
        """Returns what one frame and those before say of the place.

        Args:
            residuals: of the key points in the plane (K, 2) [m], measured minus modelled.
            precision: (K,) [1/m^2], 0 for what is not used.
            force: [N].
        """
        used = precision > 0.0
        motion, slope = self._response.at(self._height)[used], self._response.slope_at(self._height)[used]
        weights, left = precision[used, None], residuals[used]
        own = max(float((weights * motion**2).sum()), 1e-300)
        sensitivity = float((weights * motion * slope).sum()) / own
        beside = slope - sensitivity * motion
        information = force**2 * float((weights * beside**2).sum())
        asked = force * float((weights * beside * left).sum()) / max(information, 1e-300)
        self._average(asked, information)
        depth = force / self._response.stiffness_at(self._height)
        given = self._prior_variance + self._spread + (_TRAVEL * depth) ** 2
        spread = 1.0 / max(self._information, 1e-9) + _SUREST**2
        mistaken, beyond = doubt_place(self._away, spread, given, 0.0)
        stddev = float(np.sqrt(given + beyond))
        return PlaceDoubt(
            away=self._away, mistaken=float(mistaken), stddev=stddev, share=float(abs(sensitivity) * stddev)
        )

    def _average(self, asked: float, information: float) -> None:
        """Takes what a frame asks for [m] with its information [1/m^2] into the average."""
        kept = self._information * (1.0 - 1.0 / self._memory)
        if information > 0.0:
            self._away = (kept * self._away + information * asked) / (kept + information)
        self._information = kept + information
