"""The contact place of this package: where the object's outline overlaps the deformed inner face."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from finforce_contact.localization.contact_patch import (
    Rows,
    cross_line_of_action,
    overlap_of,
    rows_from_overlap,
    tilt_rows,
)
from finforce_contact.localization.gaps import compute_gaps
from finforce_contact.localization.inner_face import InnerFace
from finforce_contact.localization.section import Section
from finforce_contact.settings import ContactSettings


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactScene:
    """What a localizer looks at.

    Attributes:
        T: T_jaw_object (4, 4).
        section: the object's outline there.
        surface: (n, 3) [m] of the jaw's vertices, deformed or at rest.
        line: (h, 2) [m] of the inner face on that surface.
        wrench: force (3,) [N] and torque (3,) [N m] about the jaw's origin; None when nobody knows.
    """

    T: NDArray
    section: Section
    surface: NDArray
    line: NDArray
    wrench: tuple[NDArray, NDArray] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """Where the object touches, or would touch first.

    Attributes:
        rows: heights and weights on the undeformed inner surface.
        gap: from the surface to the object along x [m], negative when they overlap.
        bend: how far the surface has given way where the object is nearest [m].
        touching: what the localizer says itself; None when gap and bend are to decide.
    """

    rows: Rows
    gap: float
    bend: float
    touching: bool | None = None


class Localizer(Protocol):
    """Finds the place in a scene."""

    def reset(self) -> None:
        """Starts anew, apart."""

    def locate(self, scene: ContactScene) -> Place | None:
        """Returns the place, None when the object does not stand before the inner surface."""


class OutlineLocalizer:
    """Brings the object along x into slight overlap with the deformed surface, whatever its pose errs along x.

    The overlap is where it touches. Once a force is known, its line of action cuts the surface in the pressure centre;
    the rows are weighted so that it is their mean when it agrees with the overlap.
    """

    def __init__(self, face: InnerFace, settings: ContactSettings) -> None:
        """Keeps the inner face and the settings."""
        self._face, self._settings = face, settings

    def reset(self) -> None:
        """Starts anew; nothing is remembered."""

    def locate(self, scene: ContactScene) -> Place | None:
        """Returns the place, None when the object does not stand before the inner surface."""
        gaps = compute_gaps(scene.line, scene.section.edges)
        nearest = int(gaps.argmin())
        if not np.isfinite(gaps[nearest]):
            return None
        heights, settings = self._face.heights, self._settings
        overlap = overlap_of(gaps, settings.overlap)
        rows = rows_from_overlap(heights, overlap, settings.row_spacing, settings.narrow)
        if scene.wrench is not None:
            rows = self._follow_wrench(rows, gaps - gaps[nearest] - settings.overlap, scene)
        bend = float(np.interp(rows.mean, heights, self._face.x - scene.line[:, 0]))
        return Place(rows=rows, gap=float(gaps[nearest]), bend=bend)

    def _follow_wrench(self, rows: Rows, gaps: NDArray, scene: ContactScene) -> Rows:
        """Returns the rows with their mean moved towards the pressure centre, if that agrees with the gaps left (h,).

        A pose that is a little off along z closes the gap at one end of a wrapped surface and opens it at the other.
        """
        force, torque = scene.wrench
        settings, heights = self._settings, self._face.heights
        if np.hypot(force[0], force[2]) < settings.wrench_force:
            return rows
        centre = cross_line_of_action(scene.line, heights, force, torque, rows.mean)
        touched = heights[gaps < 0.0]
        near = touched[0] - settings.wrench_reach <= centre <= touched[-1] + settings.wrench_reach
        if not (near or np.interp(centre, heights, gaps) < settings.wrench_slack):
            return rows
        mean = rows.mean + settings.wrench_gain * (centre - rows.mean)
        return tilt_rows(rows, mean)
