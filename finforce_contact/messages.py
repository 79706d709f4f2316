"""Messages into poses, surfaces and images, contacts into columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import ObservationError
from finforce.messages import check_cloud
from finforce.pointcloud import decode_keypoints

if TYPE_CHECKING:
    from finforce_contact.estimator import ContactEstimate


def surface_from_cloud(cloud: Any, frame: str) -> NDArray:
    """Return the deformed vertices (n, 3) [m] of a solver's surface.

    Raises:
        ObservationError: the frame or the fields are wrong, or a vertex is not finite.
    """
    check_cloud(cloud, frame, "the surface")
    points = decode_keypoints(cloud).points
    if not np.isfinite(points).all():
        raise ObservationError("the surface has vertices that are not finite")
    return points


def contact_columns(estimate: ContactEstimate) -> dict[str, NDArray]:
    """Return the columns of a contact cloud, one row per contact, none without an object."""
    points = np.asarray(estimate.points, dtype=np.float32).reshape(-1, 3)
    return {
        **dict(zip("xyz", points.T, strict=True)),
        "candidate": np.asarray(estimate.candidates, dtype=np.uint16),
        "touching": np.full(len(points), estimate.touching, dtype=np.uint8),
        "weight": np.asarray(estimate.weights, dtype=np.float32),
    }
