"""Networks read from files: the checkpoint of a training, to go on from or to export, and what was exported."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from finforce_keypoints.networks.side_network import COARSE, FINE, METADATA
from lab.training.commands import CheckpointError, import_onnx, import_torch
from lab.training.network import FingerNetwork, NetworkShape

torch = import_torch()
# where the parts are in what was exported, and in the network
_PLACES = {COARSE: ("network.coarse.", "coarse."), FINE: ("part.", "fine.")}


def save_checkpoint(path: Path, content: Mapping[str, Any]) -> None:
    """Write what torch can; the file before it stays whole until the new one is complete."""
    part = path.with_suffix(".part")
    torch.save(dict(content), part)
    part.replace(path)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint: what `Training.save` has written.

    Raises:
        CheckpointError: the file is missing, or no checkpoint.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        content["step"], content["elapsed"], content["network"], content["optimizer"]
        return content
    except Exception as error:  # torch raises whatever its unpickler does
        reason = str(error).partition("\n")[0]
        raise CheckpointError(f"{path}: {reason}; expected a checkpoint written by training") from error


def shape_from(content: Mapping[str, Any]) -> NetworkShape:
    """Return the sizes of a network from what a file says of them."""
    return NetworkShape(**{name: tuple(value) if isinstance(value, list) else value for name, value in content.items()})


def build_averaged(content: Mapping[str, Any]) -> FingerNetwork:
    """Return the averaged network of a checkpoint, in evaluation mode.

    Raises:
        CheckpointError: it is of another kind of network.
    """
    try:
        network = FingerNetwork(shape_from(content["shape"]))
        network.load_state_dict(content["averaged"])
    except (KeyError, RuntimeError) as error:
        raise CheckpointError(f"{error!r}; expected a checkpoint of lab.training.train") from error
    return network.eval()


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
