"""The shipped key point network made smaller: 8-bit weights and sums, or fewer pixels.

It needs onnx, with which onnxruntime quantises; the product itself does without.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from finforce.optional import import_library
from finforce.transforms import pose_from_quaternion
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.build import SHIPPED
from finforce_keypoints.detectors.side_plane import grid_from_metadata
from finforce_keypoints.geometry.side_picture import find_side, map_picture, take_picture
from finforce_keypoints.networks.metadata import METADATA_FILE
from finforce_keypoints.networks.model import KeypointModel, find_network

CELLS = 16  # [px] of the coarsest maps of the network: heights and widths are multiples
# size of a pixel [m]: height and width [px] of about the same view
SIZES = {0.50e-3: (208, 160), 0.55e-3: (192, 144), 0.60e-3: (176, 128)}
CALIBRATED = 48  # pictures from which the ranges of the sums are taken


def require_onnx() -> Any:
    """Return the module onnx.

    Raises:
        MissingDependencyError: it is not installed.
    """
    return import_library("onnx", "another form of the network")


def write_dynamic(folder: Path) -> Path:
    """Write the network with weights of 8 bits, the ranges of the sums found anew for every picture; return where.

    Raises:
        MissingDependencyError: onnx is not installed.
    """
    require_onnx()
    from onnxruntime.quantization import QuantType, quantize_dynamic

    target = _prepare(folder)
    # onnxruntime has no convolution with signed 8-bit weights for this
    quantize_dynamic(find_network(SHIPPED), target, weight_type=QuantType.QUInt8)
    return folder


def write_static(folder: Path, pictures: Sequence[NDArray]) -> Path:
    """Write the network with weights and sums of 8 bits, their ranges those of some pictures; return where.

    Args:
        folder: to be made.
        pictures: inputs of the network (1, 3, h, w) float32.

    Raises:
        MissingDependencyError: onnx is not installed.
    """
    require_onnx()
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

    class Pictures(CalibrationDataReader):
        """Hands the pictures out, one after the other."""

        def __init__(self) -> None:
            self._left = iter(pictures)

        def get_next(self) -> dict[str, NDArray] | None:
            picture = next(self._left, None)
            return None if picture is None else {"input": picture}

    target = _prepare(folder)
    quantize_static(
        str(find_network(SHIPPED)),
        str(target),
        Pictures(),
        quant_format=QuantFormat.QDQ,
        op_types_to_quantize=["Conv", "Add", "Resize"],
        per_channel=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
    )
    return folder


def write_small(folder: Path, scale: float) -> Path:
    """Write the network for pictures with larger pixels than 0.45 mm, of about the same view; return where.

    What the network adds for the place in the picture is interpolated; nothing is trained again.

    Args:
        folder: to be made.
        scale: size of a pixel [m], one of `SIZES`.

    Raises:
        MissingDependencyError: onnx is not installed.
    """
    onnx = require_onnx()
    target = _prepare(folder, scale)
    network = onnx.load(find_network(SHIPPED))
    height, width = SIZES[scale]
    for axis, size in ((2, height), (3, width)):
        network.graph.input[0].type.tensor_type.shape.dim[axis].dim_value = size
        for output in network.graph.output:
            output.type.tensor_type.shape.dim[axis].dim_value = size // 4
    del network.graph.value_info[:]
    for tensor in network.graph.initializer:
        if tensor.name.endswith("places"):
            places = _resize_maps(onnx.numpy_helper.to_array(tensor), (height // CELLS, width // CELLS))
            tensor.CopyFrom(onnx.numpy_helper.from_array(places, tensor.name))
    onnx.save(network, target)
    return folder


def _resize_maps(maps: NDArray, size: tuple[int, int]) -> NDArray:
    """Return maps (1, k, h, w) float32 of another height and width, interpolated."""
    from scipy.ndimage import map_coordinates

    steps = [(np.arange(new) + 0.5) * old / new - 0.5 for new, old in zip(size, maps.shape[2:], strict=True)]
    places = np.meshgrid(*steps, indexing="ij")
    resized = [map_coordinates(plane, places, order=1, mode="nearest") for plane in maps[0]]
    return np.array(resized, dtype=np.float32)[None]


def _prepare(folder: Path, scale: float | None = None) -> Path:
    """Make the folder of a network with its metadata, of another scale [m] if one is given; return the file to be."""
    folder.mkdir(parents=True)
    source = find_network(SHIPPED)
    content = yaml.safe_load((source.parent / METADATA_FILE).read_text(encoding="utf-8"))
    if scale is not None:
        _rescale(content["finforce"], scale)
    (folder / METADATA_FILE).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return folder / source.name


def _rescale(own: dict[str, Any], scale: float) -> None:
    """Change a network's own section of its metadata to pixels of another size [m]; the middle of the view stays."""
    plane, (height, width) = own["plane"], SIZES[scale]
    share = plane["scale"] / scale
    plane["x"] += 0.5 * (plane["scale"] * (plane["width"] - 1) - scale * (width - 1))
    plane["z"] += 0.5 * (plane["scale"] * (plane["height"] - 1) - scale * (height - 1))
    plane |= {"scale": scale, "height": height, "width": width}
    own["likelihood_stddev"] = [[chance, stddev * share] for chance, stddev in own["likelihood_stddev"]]


def cut_pictures(recording: Recording, count: int = CALIBRATED) -> list[NDArray]:
    """Return inputs of the shipped network, cut out where the jaws of a synthetic recording truly are.

    Args:
        recording: with images and true poses of the jaws.
        count: of the pictures, evenly over the recording.
    """
    return list(_cut(recording, -(-len(recording.images) * len(recording.jaws) // count)))


def _cut(recording: Recording, every: int) -> Iterator[NDArray]:
    """Yield the inputs of every so-manieth image."""
    model = KeypointModel(SHIPPED, threads=1)
    grid = grid_from_metadata(model.metadata.extra)
    stamps = recording.images.stamps[::every]
    for stamp, image in replace(recording.images.at(stamps)):
        for side, track in recording.jaws.items():
            row = int(np.searchsorted(track.true_pose.stamps, stamp))
            pose = pose_from_quaternion(track.true_pose.position[row], track.true_pose.quaternion[row])
            mapping = map_picture(grid, find_side(load_jaw("bench", side)), pose, image.camera)
            yield model.preprocess(take_picture(image.color, mapping)[None]).copy()
