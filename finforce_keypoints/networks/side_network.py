"""The network of any finger: pictures of side planes and the fingers' templates in, places of their points out.

It has two parts, each a file: a coarse one tells roughly where each point of the template has moved to, a fine one
compares small pieces of picture and template there. Between them stands what the finger's mechanics allow: the guesses
of all points are one shape of the finger.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce.errors import one_line
from finforce.optional import import_cv2
from finforce_keypoints.errors import DetectionError, ModelError
from finforce_keypoints.geometry.template import fit_motion, trust
from finforce_keypoints.networks.runtime import Helpers, open_session

METADATA = "finforce"  # key of the files' own metadata
KIND = "side plane"
COARSE, FINE = "coarse.onnx", "fine.onnx"
COARSE_LAYOUT = (("pictures", "templates", "points"), ("guesses", "context", "mean", "gain"))
GUESS, BLUR = 4.0, 1.0  # [px] by which the coarse part is off, and by which a finger differs from its shapes
ASTRAY = 12.0  # [px] off the coarse part: a shape of the picture before is not where one begins to look any more
NEAR = 1.0  # [px] within which a better guess is none: the fine part finds the same from both
FARTHEST = 4e3  # [px] that a piece can be from a picture's first pixel
FINE_LAYOUT = (("pieces", "templates", "context", "mean", "gain"), ("offsets", "likelihood", "spread"))


@dataclass(frozen=True, kw_only=True, eq=False)
class Template:
    """One finger as the network is told of it, made by `SideNetwork.prepare`.

    Attributes:
        half: (h / 2, w / 2, 3) uint8, what it looks like at rest.
        points: (K, 2) float32 its points in the template at full size [px].
        pieces: (K, p, p, 3) uint8, the template around them.
        shapes: (2 K, m) how they can move together, see `span_shapes`; None where nobody knows.
        wanted: (K,) bool, which are looked for, the others being covered; None: all.
    """

    half: NDArray
    points: NDArray
    pieces: NDArray
    shapes: NDArray | None = None
    wanted: NDArray | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Points found in B pictures.

    Attributes:
        pixels: (B, K, 2) column and row in the picture [px].
        likelihood: (B, K) from 0 to 1, that a point can be seen.
        stddev: (B, K) one standard deviation along a row or a column [px].
        moves: (B, K, 2) how the points have moved as one shape [px]; None where no shapes are known.
    """

    pixels: NDArray
    likelihood: NDArray
    stddev: NDArray
    moves: NDArray | None = None


class SideNetwork:
    """A network in two parts that compares pictures with templates; not for several threads at once.

    Attributes:
        path: the folder.
        height: of pictures and templates [px].
        width: of pictures and templates [px].
    """

    def __init__(self, path: str | Path, threads: int = 2) -> None:
        """Load a network.

        Args:
            path: the folder with `coarse.onnx` and `fine.onnx`.
            threads: that the pictures of a batch are shared among.

        Raises:
            ModelError: a file is missing, cannot be loaded, or is of another kind of network.
            MissingDependencyError: onnxruntime is not installed.
        """
        self.path = Path(path)
        missing = [name for name in (COARSE, FINE) if not (self.path / name).is_file()]
        if missing:
            raise ModelError(
                f"{path}: there is no {' and no '.join(missing)}; expected the folder of a network for side planes; a "
                "DeepLabCut network is used with detection_method frame"
            )
        self._coarse, self._fine = (open_session(self.path / name, 1) for name in (COARSE, FINE))
        self._helpers = Helpers(threads)
        for session, layout, name in ((self._coarse, COARSE_LAYOUT, COARSE), (self._fine, FINE_LAYOUT, FINE)):
            found = tuple(tuple(item.name for item in items) for items in (session.get_inputs(), session.get_outputs()))
            if found != layout:
                raise ModelError(
                    f"{self.path / name}: a network of {', '.join(found[0])} to {', '.join(found[1])}; expected "
                    f"{', '.join(layout[0])} to {', '.join(layout[1])}"
                )
        self.height, self.width = self._read_size(self._coarse, COARSE)
        self._piece, _ = self._read_size(self._fine, FINE)
        self._factor = self._read_factor()

    def _read_size(self, session, name: str) -> tuple[int, int]:
        """Return height and width of a part's pictures (batch, height, width, 3)."""
        shape = list(session.get_inputs()[0].shape)
        if (
            len(shape) != 4
            or not all(isinstance(size, int) and 8 <= size <= 2048 for size in shape[1:3])
            or shape[3] != 3
        ):
            raise ModelError(f"{self.path / name}: pictures {shape}; expected (batch, height, width, 3), of fixed size")
        return shape[1], shape[2]

    def _read_factor(self) -> float:
        """Return what the network's own deviations are multiplied with to be standard deviations."""
        text = self._coarse.get_modelmeta().custom_metadata_map.get(METADATA, "")
        try:
            content = json.loads(text)
            factor = float(content["stddev_factor"]) if content["kind"] == KIND else np.nan
        except (ValueError, TypeError, KeyError, RecursionError):
            factor = np.nan
        if not 0.0 < factor < 100.0:
            raise ModelError(
                f"{self.path / COARSE}: metadata {text[:200]!r}; expected JSON with kind '{KIND}' and stddev_factor "
                f"under '{METADATA}'"
            )
        return factor

    @cached_property
    def sha256(self) -> str:
        """The SHA-256 of both files, by which recordings tell what they were made with."""
        return hashlib.sha256(b"".join((self.path / name).read_bytes() for name in (COARSE, FINE))).hexdigest()

    def prepare(
        self, template: NDArray, points: NDArray, shapes: NDArray | None = None, wanted: NDArray | None = None
    ) -> Template:
        """Return what is told of a finger.

        Args:
            template: (height, width, 3) uint8, see `draw_template`.
            points: (K, 2) column and row of its points there [px].
            shapes: (2 K, m) how they can move together [px]; without them each point is found for itself.
            wanted: (K,) bool, which can be seen; None: all.
        """
        cv2, points = import_cv2(), np.asarray(points, dtype=np.float32)
        half = cv2.resize(template, (self.width // 2, self.height // 2), interpolation=cv2.INTER_AREA)
        return Template(half=half, points=points, pieces=self._cut(template, points), shapes=shapes, wanted=wanted)

    def locate(self, pictures: NDArray, templates: Sequence[Template], starts: Sequence[NDArray | None] = ()) -> Places:
        """Find points in pictures, as many of these at a time as there are threads.

        Args:
            pictures: (B, height, width, 3) uint8 RGB.
            templates: B, of fingers with the same number of points.
            starts: `moves` (K, 2) [px] in each one's picture before, where that is known; what the coarse part does not
                contradict is a better place to look than its own.

        Raises:
            DetectionError: the network cannot be computed for these.
        """
        starts = starts or [None] * len(pictures)
        found = self._helpers.share(
            lambda number: self._locate_one(pictures[number], templates[number], starts[number]), len(pictures)
        )
        layers = {entry.name: [getattr(places, entry.name) for places in found] for entry in fields(Places)}
        return Places(**{name: None if values[0] is None else np.stack(values) for name, values in layers.items()})

    def _locate_one(self, picture: NDArray, template: Template, start: NDArray | None) -> Places:
        """Return where the points are in one picture, all without its axis."""
        points, shapes, everywhere = template.points, template.shapes, np.ones(len(template.points), dtype=bool)
        wanted = everywhere if template.wanted is None else template.wanted
        seen = self._run(self._coarse, COARSE_LAYOUT[0], (picture[None], template.half[None], points[None]))
        guesses, *seen = (value[0] for value in seen)
        if shapes is None:
            return self._compare(picture, template, seen, guesses, wanted)
        moves = fit_motion(shapes, guesses - points, GUESS * everywhere, everywhere)
        if start is not None and np.linalg.norm(start - moves, axis=1).max() < ASTRAY:
            moves = start
        places = self._compare(picture, template, seen, points + moves, wanted)
        better = _fit(template, places)
        wrong = wanted & (np.linalg.norm(better - moves, axis=1) > NEAR)
        if wrong.any():
            again = self._compare(picture, template, seen, points + better, wrong)
            places = Places(
                pixels=np.where(wrong[:, None], again.pixels, places.pixels),
                likelihood=np.where(wrong, again.likelihood, places.likelihood),
                stddev=np.where(wrong, again.stddev, places.stddev),
            )
            better = _fit(template, places)
        believed = trust(places.pixels - points, better)
        return replace(places, likelihood=places.likelihood * np.nan_to_num(believed), moves=better)

    def _compare(
        self, picture: NDArray, template: Template, seen: Sequence[NDArray], guesses: NDArray, wanted: NDArray
    ) -> Places:
        """Return where points are that lie near guesses (K, 2) [px]; of those not wanted (K,) nothing is known.

        What was seen by the coarse part is context (K, C), and mean and gain of the colours (3,).
        """
        context, mean, gain = seen
        near = guesses[wanted]
        colours = (np.broadcast_to(value, (len(near), 3)) for value in (mean, gain))
        inputs = (self._cut(picture, near), template.pieces[wanted], context[wanted], *colours)
        offsets, likely, spread = self._run(self._fine, FINE_LAYOUT[0], inputs)
        places = near + offsets
        good = np.isfinite(places).all(axis=1) & np.isfinite(likely) & np.isfinite(spread)
        count = len(guesses)
        pixels, likelihood, stddev = np.full((count, 2), np.nan), np.zeros(count), np.full(count, np.inf)
        pixels[wanted] = np.where(good[:, None], places, np.nan)
        likelihood[wanted] = np.where(good, np.clip(likely, 0.0, 1.0), 0.0)
        stddev[wanted] = np.where(good, self._factor * spread, np.inf)
        return Places(pixels=pixels, likelihood=likelihood, stddev=stddev)

    def _run(self, session, names: tuple[str, ...], inputs: tuple[NDArray, ...]) -> list[NDArray]:
        try:
            return session.run(None, dict(zip(names, inputs, strict=True)))
        except Exception as error:  # onnxruntime has no base class of its errors
            shapes, text = [part.shape for part in inputs], one_line(error)
            raise DetectionError(f"the network cannot be computed for {shapes}: {text}") from error

    def _cut(self, picture: NDArray, centres: NDArray) -> NDArray[np.uint8]:
        """Return the pieces (K, p, p, 3) of a picture (h, w, 3) around places (K, 2) [px]."""
        return cut_pieces(picture, np.ascontiguousarray(centres, dtype=float), self._piece)


def _fit(template: Template, places: Places) -> NDArray:
    """Return how a finger's points (K, 2) [px] have moved by what was found of them in one picture, as one shape."""
    moves, stddev = places.pixels - template.points, np.hypot(BLUR, places.stddev)
    return fit_motion(template.shapes, moves, stddev, places.likelihood**2)


@njit(cache=True, error_model="numpy", nogil=True)
def cut_pieces(picture, centres, size):
    """Return pieces (K, size, size, 3) uint8 of a picture (h, w, 3) around places (K, 2) [px], its edge continued."""
    height, width = picture.shape[:2]
    pieces = np.empty((len(centres), size, size, 3), np.uint8)
    line = np.empty(3 * (size + 1), np.float32)
    upper, lower = np.empty(3 * size, np.float32), np.empty(3 * size, np.float32)
    for k in range(len(centres)):
        x, y = centres[k]
        if not (abs(x) < FARTHEST and abs(y) < FARTHEST):
            x = y = -FARTHEST
        left, top = x - 0.5 * (size - 1), y - 0.5 * (size - 1)
        column, row = int(np.floor(left)), int(np.floor(top))
        across, down = np.float32(left - column), np.float32(top - row)
        piece = pieces[k].reshape(size, 3 * size)
        for r in range(size + 1):
            here = min(max(row + r, 0), height - 1)
            for c in range(size + 1):
                there = min(max(column + c, 0), width - 1)
                for n in range(3):
                    line[3 * c + n] = picture[here, there, n]
            for n in range(3 * size):
                upper[n] = lower[n]
                lower[n] = line[n] + across * (line[n + 3] - line[n])
            if r > 0:
                for n in range(3 * size):
                    piece[r - 1, n] = np.uint8(upper[n] + down * (lower[n] - upper[n]) + np.float32(0.5))
    return pieces
