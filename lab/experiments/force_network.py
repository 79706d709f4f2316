"""A network that tells the grasp force from images alone: the letter's comparison."""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_cv2
from finforce_eval.errors import OptionError
from finforce_eval.recordings.images import StampedImage
from finforce_keypoints.networks.network import CPU, open_session
from finforce_keypoints.networks.side_network import METADATA

SHOWN = 10  # images that the network is given at a time
HEIGHT, WIDTH = 120, 160  # [px]
KIND = "force_from_images"
LAYOUT = (("images",), ("force",))
SHIPPED = Path(__file__).parents[1] / "data" / "force_network" / "force_network.onnx"


def reduce_image(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a colour image (h, w, 3) as the network is shown it, (120, 160, 3)."""
    return import_cv2().resize(np.ascontiguousarray(color), (WIDTH, HEIGHT), interpolation=import_cv2().INTER_AREA)


class ForceNetwork:
    """An end-to-end network that `lab.training.baseline` has written.

    Args:
        path: of the ONNX file.

    Raises:
        OptionError: it is another kind of network.
        ModelError: it cannot be loaded.
        MissingDependencyError: onnxruntime is not installed.
    """

    def __init__(self, path: str | Path = SHIPPED) -> None:
        self.path = Path(path)
        self._session = open_session(self.path, 1, (CPU,))
        text = self._session.get_modelmeta().custom_metadata_map.get(METADATA, "")
        try:
            self.about = json.loads(text)
            is_known = self.about["kind"] == KIND
        except (ValueError, TypeError, KeyError, RecursionError):
            is_known = False
        inputs, outputs = (tuple(self._session.get_inputs()), tuple(self._session.get_outputs()))
        names = (tuple(item.name for item in inputs), tuple(item.name for item in outputs))
        shape = list(inputs[0].shape)[1:]
        if not is_known or names != LAYOUT or shape != [SHOWN, HEIGHT, WIDTH, 3]:
            raise OptionError(
                f"{path}: got a network of {', '.join(names[0])} {shape} to {', '.join(names[1])} with metadata "
                f"{text[:120]!r}, expected one of lab.training.baseline.train"
            )

    @cached_property
    def sha256(self) -> str:
        """The SHA-256 of the file."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()

    def predict(self, images: NDArray[np.uint8]) -> NDArray:
        """Return the grasp force (b,) [N] in the last of each row of images (b, 10, 120, 160, 3)."""
        return self._session.run(None, {"images": np.asarray(images)})[0].astype(float)

    def follow(self, images: Iterable[StampedImage]) -> tuple[NDArray[np.int64], NDArray]:
        """Return stamps (n,) [ns] of images and the grasp force (n,) [N] in each; NaN before the tenth."""
        shown: deque[NDArray] = deque(maxlen=SHOWN)
        stamps, forces = [], []
        for stamp, image in images:
            shown.append(reduce_image(image.color))
            stamps.append(stamp)
            forces.append(float(self.predict(np.stack(shown)[None])[0]) if len(shown) == SHOWN else np.nan)
        return np.array(stamps, dtype=np.int64), np.array(forces)
