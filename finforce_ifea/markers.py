"""The jaw as it is seen in RViz and Foxglove: surface, key points, contact and force; computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from finforce_ros import points_marker

if TYPE_CHECKING:
    from finforce_ifea.estimator import JawEstimator
    from finforce_ifea.observation import Observation, Solution

SURFACE = (0.45, 0.55, 0.65, 0.6)
USED = (0.1, 0.8, 0.2, 1.0)
UNUSED = (0.9, 0.2, 0.1, 1.0)
CONTACT = (1.0, 0.8, 0.0, 1.0)
FORCE = (0.9, 0.1, 0.6, 1.0)
NEWTONS_PER_METRE = 200.0  # 5 N are drawn 25 mm long, a third of a bench finger
KEYPOINT_DIAMETER = 0.003
CONTACT_DIAMETER = 0.005
ARROW = (0.002, 0.004, 0.005)  # shaft, head, head length


def build_markers(header: Any, observation: Observation, solution: Solution, estimator: JawEstimator) -> list[Any]:
    """Return the markers of one image, in the jaw frame: contact and force only where they are trusted."""
    triangles = np.asarray(estimator.surface())[np.asarray(estimator.surface_triangles)].reshape(-1, 3)
    seen = np.isfinite(observation.points).all(axis=1)
    colors = [USED if used else UNUSED for used in np.asarray(solution.keypoints_used)[seen]]
    touched = solution.trusted and np.any(solution.force)
    place = np.asarray(solution.contact_point)
    # the arrow ends on the surface that the object presses on
    arrow = np.stack([place - np.asarray(solution.force) / NEWTONS_PER_METRE, place]) if touched else ()
    return [
        points_marker(header, "surface", "triangles", triangles, color=SURFACE, scale=(1.0, 1.0, 1.0)),
        points_marker(
            header,
            "keypoints",
            "spheres",
            observation.points[seen],
            color=USED,
            colors=colors,
            scale=(KEYPOINT_DIAMETER,) * 3,
        ),
        points_marker(
            header,
            "contact",
            "spheres",
            place if touched else (),
            color=CONTACT,
            scale=(CONTACT_DIAMETER,) * 3,
        ),
        points_marker(header, "force", "arrow", arrow, color=FORCE, scale=ARROW),
    ]
