"""The weights of an exported network, to train it further."""

from __future__ import annotations

from pathlib import Path

from finforce_keypoints.networks.metadata import METADATA_FILE, read_metadata
from finforce_keypoints.networks.model import find_network
from training.errors import CheckpointError
from training.network import KeypointNetwork, NetworkShape
from training.optional import import_onnx, import_torch

torch = import_torch()

_PREFIX = "network."  # the place of the network in ExportedNetwork


def read_network(folder: str | Path) -> KeypointNetwork:
    """Return the network of an exported folder, with biases where batch norm was.

    Raises:
        ModelError: the folder has no network or no metadata.
        CheckpointError: it is a network of another architecture; only this package's own can be trained further here.
    """
    path = find_network(folder)
    kept = read_metadata(path.parent / METADATA_FILE).extra.get("network")
    if kept is None:
        raise CheckpointError(f"{path.name}: no `finforce: network` beside it; expected a network exported by training")
    shape = {name: tuple(value) if isinstance(value, list) else value for name, value in kept.items()}
    network = KeypointNetwork(NetworkShape(**shape | {"folded": True}))
    weights = _read_weights(path)
    missing = [name for name in network.state_dict() if name not in weights]
    if missing:
        raise CheckpointError(f"{path.name}: no weights for {', '.join(missing[:3])}; expected an untouched export")
    network.load_state_dict({name: weights[name] for name in network.state_dict()})
    return network


def _read_weights(path: Path) -> dict[str, torch.Tensor]:
    """Return the initialisers of an ONNX file by their names in the network; the exporter keeps equal ones once."""
    onnx = import_onnx()
    graph = onnx.load(str(path)).graph
    arrays = {item.name: onnx.numpy_helper.to_array(item) for item in graph.initializer}
    for node in graph.node:
        if node.op_type == "Identity" and node.input[0] in arrays:
            arrays[node.output[0]] = arrays[node.input[0]]
    return {name.removeprefix(_PREFIX): torch.from_numpy(array.copy()) for name, array in arrays.items()}
