"""The files of a network: checkpoints of its training, and what the product uses, written and read back.

`python -m lab.training.export RUN/checkpoint.pt -o FOLDER --dataset DATA`
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_keypoints.networks.side_network import (
    COARSE,
    COARSE_LAYOUT,
    FINE,
    FINE_LAYOUT,
    KIND,
    METADATA,
    SideNetwork,
)
from lab.training.commands import TrainingError, import_onnx, import_torch, one_line_errors, read_share
from lab.training.evaluate import detect, fit_factor, fit_shift
from lab.training.network import PIECE, ExportedCoarse, ExportedFine, FingerNetwork, NetworkShape, fold_batch_norm
from lab.training.pictures import VALIDATION, load_pictures
from lab.training.quantize import quantize_network

torch = import_torch()
OPSET = 17
BIAS = "part.judge.2.bias"  # of logit and log deviation, in the fine part's file
# where the parts are in what was exported, and in the network
_PLACES = {COARSE: ("network.coarse.", "coarse."), FINE: ("part.", "fine.")}


def main(arguments: Sequence[str] | None = None) -> None:
    """Export the averaged network of a checkpoint; validation pictures tell how its deviations are to be scaled."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.export", description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the two files")
    parser.add_argument("--dataset", type=Path, required=True, help="folder of shards val_*.npz")
    text = "share of the visible points that the threshold is to lose; without it likelihoods stay as they were learnt"
    parser.add_argument("--lost", type=read_share, help=text)
    options = parser.parse_args(arguments)
    with one_line_errors():
        network = build_averaged(load_checkpoint(options.checkpoint))
        pictures = load_pictures(options.dataset, VALIDATION)
        write_network(network, options.output, 1.0)
        factor = fit_factor(detect(SideNetwork(options.output, threads=1), pictures))
        write_network(network, options.output, factor)
        quantize_network(options.output, pictures)
        if options.lost is not None:
            found = detect(SideNetwork(options.output, threads=1), pictures)
            shift_likelihoods(options.output, fit_shift(found, options.lost))
    print(f"{options.output}: {COARSE}, {FINE}")


def write_network(network: FingerNetwork, folder: Path, factor: float) -> None:
    """Write both parts of a network.

    Args:
        network: in evaluation mode.
        folder: of the files.
        factor: ratio of standard deviations along an axis to the deviations of the network.
    """
    folder.mkdir(parents=True, exist_ok=True)
    folded = network if network.shape.folded else fold_batch_norm(network)
    said = {"kind": KIND, "stddev_factor": round(factor, 4), "network": asdict(folded.shape)}
    coarse, fine = make_examples(folded.shape)
    points = {name: {0: "batch", 1: "points"} for name in ("points", "guesses", "context")}
    write_onnx(ExportedCoarse(folded), coarse, COARSE_LAYOUT, folder / COARSE, said, points)
    write_onnx(ExportedFine(folded), fine, FINE_LAYOUT, folder / FINE, said, {})


def shift_likelihoods(folder: Path, shift: float) -> None:
    """Add a shift to the logits of visibility of an exported network; nothing else of it changes."""
    onnx = import_onnx()
    model = onnx.load(str(folder / FINE))
    (bias,) = (item for item in model.graph.initializer if item.name == BIAS)
    shifted = onnx.numpy_helper.to_array(bias) + np.array([shift, 0.0], dtype=np.float32)
    bias.CopyFrom(onnx.numpy_helper.from_array(shifted, BIAS))
    onnx.save(model, str(folder / FINE))


def make_examples(shape: NetworkShape, batch: int = 2, count: int = 5) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return inputs of both parts."""
    pieces, colours = torch.zeros(batch * count, PIECE, PIECE, 3, dtype=torch.uint8), torch.ones(batch * count, 3)
    coarse = (
        torch.zeros(batch, shape.height, shape.width, 3, dtype=torch.uint8),
        torch.zeros(batch, shape.height // 2, shape.width // 2, 3, dtype=torch.uint8),
        torch.zeros(batch, count, 2),
    )
    return coarse, (pieces, pieces, torch.zeros(batch * count, shape.coarse[1]), colours, colours)


def write_onnx(
    module: Any, inputs: tuple[Any, ...], layout: Any, path: Path, said: dict[str, Any], axes: dict[str, Any]
) -> None:
    """Write a module as ONNX, with what is said of it in the file's metadata.

    Args:
        module: of tensors to tensors.
        inputs: an example of each.
        layout: names of inputs and outputs; the first axis of each is free.
        path: of the file.
        said: as JSON has it.
        axes: further free axes, names by name and number.
    """
    onnx = import_onnx()
    free = {name: {0: "batch"} for names in layout for name in names} | axes
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the tracer, that sizes become constants: they are meant to
        torch.onnx.export(
            module.eval(),
            inputs,
            str(path),
            input_names=list(layout[0]),
            output_names=list(layout[1]),
            dynamic_axes=free,
            opset_version=OPSET,
            dynamo=False,
        )
    content = onnx.load(str(path))
    entry = content.metadata_props.add()
    entry.key, entry.value = METADATA, json.dumps(said)
    content.producer_name, content.producer_version, content.doc_string = "finforce", "", ""
    onnx.save(content, str(path))


def save_checkpoint(path: Path, content: Mapping[str, Any]) -> None:
    """Write what torch can; the file before it stays whole until the new one is complete."""
    part = path.with_suffix(".part")
    torch.save(dict(content), part)
    part.replace(path)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint: what `Training.save` has written.

    Raises:
        TrainingError: the file is missing, or no checkpoint.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        content["step"], content["elapsed"], content["network"], content["optimizer"]
        return content
    except Exception as error:  # torch raises whatever its unpickler does
        reason = str(error).partition("\n")[0]
        raise TrainingError(f"{path}: {reason}; expected a checkpoint written by training") from error


def shape_from(content: Mapping[str, Any]) -> NetworkShape:
    """Return the sizes of a network from what a file says of them."""
    return NetworkShape(**{name: tuple(value) if isinstance(value, list) else value for name, value in content.items()})


def build_averaged(content: Mapping[str, Any]) -> FingerNetwork:
    """Return the averaged network of a checkpoint, in evaluation mode.

    Raises:
        TrainingError: it is of another kind of network.
    """
    try:
        network = FingerNetwork(shape_from(content["shape"]))
        network.load_state_dict(content["averaged"])
    except (KeyError, RuntimeError) as error:
        raise TrainingError(f"{error!r}; expected a checkpoint of lab.training.train") from error
    return network.eval()


def read_network(folder: Path) -> tuple[FingerNetwork, float]:
    """Return the network of an exported folder, with biases where batch norm was, and its factor of deviations.

    Raises:
        TrainingError: files are missing, or of another network.
    """
    onnx, weights, said = import_onnx(), {}, {}
    for name, (there, here) in _PLACES.items():
        try:
            model = onnx.load(str(folder / name))
        except Exception as error:  # onnx raises whatever protobuf does
            raise TrainingError(f"{folder / name}: {error}; expected a network exported by training") from error
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
        raise TrainingError(f"{folder}: {error!r}; expected a network exported by training") from error
    own = network.state_dict()
    missing = [name for name, _ in network.named_parameters() if name not in weights]
    if missing:
        raise TrainingError(f"{folder}: no weights for {', '.join(missing[:3])}; expected an untouched export")
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


if __name__ == "__main__":
    main()
