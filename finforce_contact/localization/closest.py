"""The contact place as the nearest point of the undeformed jaw, the way before the paper."""

import numpy as np

from finforce_contact.localization.contact_patch import Rows
from finforce_contact.localization.gaps import compute_gaps, distances_to
from finforce_contact.localization.inner_face import InnerFace
from finforce_contact.localization.outline_localizer import ContactScene, Place
from finforce_ifea.jaw.jaw import Jaw


class ClosestLocalizer:
    """Takes the candidate nearest to the point of the undeformed inner surface that is nearest to the object.

    Where the object is in the undeformed jaw, the deepest point counts.
    """

    def __init__(self, jaw: Jaw, face: InnerFace) -> None:
        """Keeps the candidates and the inner face at rest."""
        self._candidates = jaw.candidates[:, 2]
        self._face = face
        self._line = face.deform(face.mesh.nodes)

    def reset(self) -> None:
        """Starts anew; nothing is remembered."""

    def locate(self, scene: ContactScene) -> Place | None:
        """Returns the place, None when the object does not stand before the inner surface."""
        gaps = compute_gaps(self._line, scene.section.edges)
        if not np.isfinite(gaps).any():
            return None
        nearest = gaps if gaps.min() < 0.0 else distances_to(self._line, scene.section.edges)
        height = self._face.heights[nearest.argmin()]
        height = self._candidates[np.abs(self._candidates - height).argmin()]
        rows = Rows(heights=np.array([height]), weights=np.ones(1))
        bend = float(np.interp(height, self._face.heights, self._face.x - scene.line[:, 0]))
        return Place(rows=rows, gap=float(gaps.min()) + bend, bend=bend)
