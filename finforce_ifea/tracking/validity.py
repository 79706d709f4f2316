"""When a force must not be reported."""

import numpy as np

from finforce_ifea.tracking.track import Track, compute_magnitude_stddev

# Beyond these a force is not reported: misfit of the shape, stiffening, standard deviation [N], its share of the force.
_LARGEST_MISFIT = 2.0
_LARGEST_STIFFENING = 5.0
_VAGUE_FORCE, _VAGUE_SHARE = 1.0, 0.25
# Shapes so many times as far from the stored ones as they are good for.
_STRANGEST = 2.0
# Share of the key points: what no majority says is not believed.
_MAJORITY = 0.5
# A contact that is so surely another one, and at least so far from where it was said to be [m].
_MISTAKEN, _LEAST_AWAY = 0.99, 4e-3


def find_doubt(track: Track, *, settles: bool) -> str:
    """Returns why a track must not be believed, empty when it may.

    Args:
        track: of one frame.
        settles: whether the solver iterates until nothing changes, so that one that has not is in doubt.
    """
    if settles and not track.converged:
        return f"the shape has not settled within {track.iterations} iterations; is the contact's place right?"
    if track.extrapolation > _STRANGEST:
        return "the jaw's shape is too far from the stored ones; solver solid or frame knows any shape"
    if track.misfit > _LARGEST_MISFIT:
        return f"the key points do not fit this contact ({track.misfit:.1f} standard deviations); is its place right?"
    if track.stiffening > _LARGEST_STIFFENING:
        return f"the jaw seems {track.stiffening:.0f} times as stiff as at the given height; is the contact elsewhere?"
    if track.agreement <= _MAJORITY:
        return f"only {100 * track.agreement:.0f} % of the key points agree with the jaw's shape"
    if track.mistaken > _MISTAKEN and abs(track.away) > _LEAST_AWAY:
        return f"the contact is not where it was said to be: the key points have it {1e3 * track.away:+.0f} mm away"
    magnitude = float(np.linalg.norm(track.force))
    stddev = compute_magnitude_stddev(track.force, track.force_modes, track.covariance)
    if not stddev <= max(_VAGUE_FORCE, _VAGUE_SHARE * magnitude):
        return f"the visible key points tell the force only within {stddev:.2g} N"
    return ""
