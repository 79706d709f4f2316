"""Key points from square pictures of the jaws' sides, all jaws in one pass of a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.gripper_frames import OpeningRange
from finforce_keypoints.errors import ModelError
from finforce_keypoints.geometry.side_picture import PlaneGrid, find_side, map_picture, project_plane, take_picture
from finforce_keypoints.pixel_finder import REFERENCE, PixelFinding

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw
    from finforce_keypoints.images import RgbdImage
    from finforce_keypoints.networks.model import KeypointModel, Peaks

SAME_PLACE = 1e-3  # [m] by which a jaw may move before its picture is mapped anew; places are exact all the same
SEARCH_STEP = 20e-3  # [m] between the places where a lost jaw is looked for; a picture shows 79 mm
LEAST_SCORE = 0.35  # mean likelihood of a jaw's points, below which it is not there


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """One picture to be looked at: its jaw, where that is taken to be, and the map that makes the picture."""

    side: str
    T_camera_jaw: NDArray
    mapping: NDArray


class PlaneFinder:
    """Finds key points with a network for one jaw, in pictures that look the same from every camera.

    A jaw that was lost is looked for along the closing axis.

    Args:
        model: whose body parts are the jaw file's key points and "reference", with `finforce: plane` in its metadata.
        jaws: by side.
        T_gripper_camera: (4, 4).
        opening: where a jaw can be.

    Raises:
        ModelError: names or plane of the metadata do not fit.
    """

    def __init__(
        self,
        model: KeypointModel,
        jaws: Mapping[str, Jaw],
        T_gripper_camera: NDArray,
        opening: OpeningRange | None = None,
    ) -> None:
        self._model, self._T_gripper_camera, self._opening = model, T_gripper_camera, opening or OpeningRange()
        self._grid = grid_from_metadata(model.metadata.extra)
        self._order = {side: _order_names(model, jaw) for side, jaw in jaws.items()}
        self._side_y = {side: find_side(jaw) for side, jaw in jaws.items()}
        self._kept: dict[str, _View] = {}
        self._camera: CameraIntrinsics | None = None

    def find(self, image: RgbdImage, expected: Mapping[str, NDArray | None]) -> Mapping[str, PixelFinding]:
        """Return where the key points of each jaw are; see `PixelFinder`."""
        if image.camera is not self._camera:
            self._kept, self._camera = {}, image.camera
        views = [view for side, pose in expected.items() for view in self._views_of(side, pose)]
        if not views:
            return {}
        peaks = self._locate(image, views)
        found: dict[str, PixelFinding] = {}
        again: list[_View] = []
        for side, pose in expected.items():
            mine = [number for number, view in enumerate(views) if view.side == side]
            best = max(mine, key=lambda number: peaks.likelihood[number].mean())
            if pose is not None:
                found[side] = self._describe(views[best], peaks, best)
            elif peaks.likelihood[best].mean() >= LEAST_SCORE:
                again.append(self._view(side, self._centre(views[best], peaks, best)))
        if again:
            # the jaw lay near the border of the picture it was found in
            peaks = self._locate(image, again)
            found |= {view.side: self._describe(view, peaks, number) for number, view in enumerate(again)}
        return found

    def _locate(self, image: RgbdImage, views: Sequence[_View]) -> Peaks:
        return self._model.locate(np.stack([take_picture(image.color, view.mapping) for view in views]))

    def _views_of(self, side: str, pose: NDArray | None) -> list[_View]:
        """Return where to look for one jaw: where it is expected, or all along the closing axis."""
        if pose is None:
            poses = self._opening.place_jaw(self._T_gripper_camera, side, SEARCH_STEP)
            return [self._view(side, place) for place in poses]
        kept = self._kept.get(side)
        if kept is None or np.abs(kept.T_camera_jaw - pose).max() > SAME_PLACE:
            kept = self._kept[side] = self._view(side, pose)
        return [kept]

    def _view(self, side: str, pose: NDArray) -> _View:
        mapping = map_picture(self._grid, self._side_y[side], pose, self._camera)
        return _View(side=side, T_camera_jaw=pose, mapping=mapping)

    def _centre(self, view: _View, peaks: Peaks, number: int) -> NDArray:
        """Return the pose of a jaw whose reference point, or else base, was seen beside its place."""
        places = self._grid.places(peaks.pixels[number])
        order, jaw = self._order[view.side], view.T_camera_jaw.copy()
        at_rest = order.rest
        sure = peaks.likelihood[number] >= 0.5
        weight = np.where(sure, 1.0 / (at_rest[:, 1] - at_rest[:, 1].min() + 0.01), 0.0)
        if weight.sum() > 0.0:
            shift = np.nansum(weight * (places[:, 0] - at_rest[:, 0])) / weight.sum()
            jaw[:3, 3] += shift * jaw[:3, 0]
        return jaw

    def _describe(self, view: _View, peaks: Peaks, number: int) -> PixelFinding:
        """Return the finding of one picture, in pixels of the image and rows of the jaw file."""
        order = self._order[view.side].rows
        places = self._grid.places(peaks.pixels[number][order])
        side_y, camera = self._side_y[view.side], self._camera
        pixels = project_plane(places, side_y, view.T_camera_jaw, camera)
        beside = [project_plane(places + step, side_y, view.T_camera_jaw, camera) for step in np.eye(2) * 1e-3]
        # pixels of the image per pixel of the picture, both ways
        across = [np.hypot(*(other - pixels).T) * self._grid.scale / 1e-3 for other in beside]
        stddev = peaks.stddev[number][order] * np.sqrt(0.5 * (across[0] ** 2 + across[1] ** 2))
        known = np.isfinite(pixels).all(axis=1)
        return PixelFinding(
            pixels=pixels,
            likelihood=np.where(known, peaks.likelihood[number][order], 0.0),
            stddev=np.where(known, stddev, np.inf),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Order:
    """Which peak is which row (K + 1,), and where the peaks' points are at rest, x and z (K + 1, 2) [m]."""

    rows: NDArray
    rest: NDArray


def _order_names(model: KeypointModel, jaw: Jaw) -> _Order:
    """Return how the body parts of a network belong to a jaw's key points.

    Raises:
        ModelError: a name is missing, or there is one that the jaw does not have.
    """
    wanted = (*jaw.keypoint_names, REFERENCE)
    if set(model.names) != set(wanted):
        missing, more = sorted(set(wanted) - set(model.names)), sorted(set(model.names) - set(wanted))
        raise ModelError(
            f"{model.path.name}: body parts missing: {', '.join(missing) or 'none'}; not of the jaw '{jaw.name}': "
            f"{', '.join(more) or 'none'}; expected its key points and '{REFERENCE}' (another jaw file?)"
        )
    rows = np.array([model.names.index(name) for name in wanted])
    rest = np.empty((len(wanted), 2))
    rest[rows] = np.vstack((jaw.keypoints, jaw.reference_point))[:, [0, 2]]
    return _Order(rows=rows, rest=rest)


def grid_from_metadata(extra: Mapping[str, Any]) -> PlaneGrid:
    """Return the grid that stands as `plane` in a network's own section of its metadata.

    Raises:
        ModelError: there is none, or it is incomplete.
    """
    plane = extra.get("plane")
    names = [entry.name for entry in fields(PlaneGrid)]
    if not isinstance(plane, Mapping) or any(not isinstance(plane.get(name), (int, float)) for name in names):
        raise ModelError(
            f"finforce.plane: got {plane!r}, expected numbers {', '.join(names)} [m, px]; a network of whole images "
            "is used as a frame model"
        )
    return PlaneGrid(**{name: plane[name] for name in names})
