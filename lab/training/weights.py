"""The weights of an exported network, to train it further."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from finforce_keypoints.networks.side_network import COARSE, FINE, METADATA
from lab.training.checkpoint import shape_from
from lab.training.errors import CheckpointError
from lab.training.network import FingerNetwork
from lab.training.optional import import_onnx, import_torch

torch = import_torch()
# where the parts are in what was exported, and in the network
_PLACES = {COARSE: ("network.coarse.", "coarse."), FINE: ("part.", "fine.")}


def read_network(folder: Path) -> tuple[FingerNetwork, float]:
    """Return the network of an exported folder, with biases where batch norm was, and its factor of deviations.

    Raises:
        CheckpointError: files are missing, or of another network.
    """
    onnx, weights, said = import_onnx(), {}, {}
    for name, (there, here) in _PLACES.items():
        try:
            model = onnx.load(str(folder / name))
        except Exception as error:  # onnx raises whatever protobuf does
            raise CheckpointError(f"{folder / name}: {error}; expected a network exported by training") from error
        said = {entry.key: entry.value for entry in model.metadata_props}
        arrays = {item.name: onnx.numpy_helper.to_array(item) for item in model.graph.initializer}
        arrays |= _read_bytes(model, arrays)
        for node in model.graph.node:  # the exporter keeps equal ones once
            if node.op_type == "Identity" and node.input[0] in arrays:
                arrays[node.output[0]] = arrays[node.input[0]]
        weights |= {
            here + key.removeprefix(there): torch.from_numpy(array.copy())
            for key, array in arrays.items()
            if key.startswith(there)
        }
    try:
        content = json.loads(said[METADATA])
        network = FingerNetwork(shape_from(content["network"] | {"folded": True}))
        factor = float(content["stddev_factor"])
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{folder}: {error!r}; expected a network exported by training") from error
    own = network.state_dict()
    missing = [name for name, _ in network.named_parameters() if name not in weights]
    if missing:
        raise CheckpointError(f"{folder}: no weights for {', '.join(missing[:3])}; expected an untouched export")
    network.load_state_dict(own | {name: weights[name] for name, _ in network.named_parameters()})
    return network, factor


def _read_bytes(model: Any, arrays: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Return the weights that an ONNX model keeps in bytes, by their names before, as floats again."""
    found = {}
    for node in model.graph.node:
        if node.op_type == "DequantizeLinear" and all(name in arrays for name in node.input):
            values, scale, zero = (arrays[name] for name in node.input)
            across = (-1, *([1] * (values.ndim - 1)))
            floats = (values.astype("f4") - zero.reshape(across).astype("f4")) * scale.reshape(across)
            found[node.input[0].removesuffix("_quantized")] = floats
    return found
