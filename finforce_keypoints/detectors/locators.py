"""Networks that find the points of jaws in pictures of their sides: one for any finger, and one trained on a finger."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finforce_keypoints.detectors.side_plane import STRAIGHT, find_rest
from finforce_keypoints.errors import ModelError
from finforce_keypoints.geometry.shapes import find_motions, span_shapes
from finforce_keypoints.geometry.side_picture import PlaneGrid
from finforce_keypoints.geometry.template import draw_template, find_shape, fit_grid
from finforce_keypoints.networks.side_network import Places
from finforce_keypoints.pixel_finder import REFERENCE

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw
    from finforce_keypoints.networks.model import KeypointModel
    from finforce_keypoints.networks.side_network import SideNetwork, Template


# Where in its picture a point lies decides by how much a network of heat maps puts it beside its place: in pictures two
# pixels apart those errors are hardly alike, so that they average out over time.
SHIFTS = 6.0 * (np.outer(np.arange(8), [0.7549, 0.5698]) % 1.0) - 3.0  # [px]


class AnyFinger:
    """The network of any finger, which is told what a finger looks like at rest.

    Args:
        network: that compares pictures with templates.
        jaws: by side.
    """

    shifts = STRAIGHT

    def __init__(self, network: SideNetwork, jaws: Mapping[str, Jaw]) -> None:
        self._network = network
        shapes = {side: find_shape(jaw) for side, jaw in jaws.items()}
        self.grids = {side: fit_grid(shape, network.width, network.height) for side, shape in shapes.items()}
        self._templates: dict[str, Template] = {}
        for side, grid in self.grids.items():
            points = grid.pixels(find_rest(jaws[side]))
            together = span_shapes(find_motions(jaws[side]), points, grid.scale)
            self._templates[side] = network.prepare(draw_template(shapes[side], grid), points, together)

    def locate(self, pictures: NDArray, sides: Sequence[str], starts: Sequence[NDArray | None] = ()) -> Places:
        """Return where the points are; see `SideLocator`."""
        return self._network.locate(pictures, [self._templates[side] for side in sides], starts)


class OneFinger:
    """A network with a heat map for each point of one finger.

    Args:
        model: whose body parts are the jaw file's key points and "reference", with `finforce: plane` in its metadata.
        jaws: by side.

    Raises:
        ModelError: names or plane of the metadata do not fit.
    """

    shifts = SHIFTS

    def __init__(self, model: KeypointModel, jaws: Mapping[str, Jaw]) -> None:
        self._model = model
        self.grids = dict.fromkeys(jaws, grid_from_metadata(model.metadata.extra))
        self._rows = {side: _order_names(model, jaw) for side, jaw in jaws.items()}

    def locate(self, pictures: NDArray, sides: Sequence[str], starts: Sequence[NDArray | None] = ()) -> Places:
        """Return where the points are, wherever they were before; see `SideLocator`."""
        peaks = self._model.locate(pictures)
        rows = np.stack([self._rows[side] for side in sides])
        return Places(
            pixels=np.take_along_axis(peaks.pixels, rows[..., None], axis=1),
            likelihood=np.take_along_axis(peaks.likelihood, rows, axis=1),
            stddev=np.take_along_axis(peaks.stddev, rows, axis=1),
        )


def _order_names(model: KeypointModel, jaw: Jaw) -> NDArray:
    """Return which peak is which key point of a jaw, the reference point last, (K + 1,).

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
    return np.array([model.names.index(name) for name in wanted])


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
