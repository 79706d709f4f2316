"""Write a trained network as the files that the product uses.

`python -m lab.training.export RUN/checkpoint.pt -o FOLDER --dataset DATA`
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from finforce_keypoints.networks.side_network import (
    COARSE,
    COARSE_LAYOUT,
    FINE,
    FINE_LAYOUT,
    KIND,
    METADATA,
    SideNetwork,
)
from lab.training.checkpoint import build_averaged, load_checkpoint
from lab.training.commands import import_onnx, import_torch, one_line_errors
from lab.training.evaluate import detect, fit_factor
from lab.training.network import PIECE, ExportedCoarse, ExportedFine, FingerNetwork, NetworkShape, fold_batch_norm
from lab.training.pictures import VALIDATION, load_pictures
from lab.training.quantize import quantize_network

torch = import_torch()
OPSET = 17


def main(arguments: Sequence[str] | None = None) -> None:
    """Export the averaged network of a checkpoint; validation pictures tell how its deviations are to be scaled."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.export", description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the two files")
    parser.add_argument("--dataset", type=Path, required=True, help="folder of shards val_*.npz")
    parser.add_argument("--floats", action="store_true", help="do not turn the convolutions into bytes")
    options = parser.parse_args(arguments)
    with one_line_errors():
        network = build_averaged(load_checkpoint(options.checkpoint))
        pictures = load_pictures(options.dataset, VALIDATION)
        write_network(network, options.output, 1.0)
        factor = fit_factor(detect(SideNetwork(options.output, threads=1), pictures))
        write_network(network, options.output, factor)
        if not options.floats:
            quantize_network(options.output, pictures)
    print(f"{options.output}: {COARSE}, {FINE}")


def write_network(network: FingerNetwork, folder: Path, factor: float) -> None:
    """Write both parts of a network.

    Args:
        network: in evaluation mode.
        folder: of the files.
        factor: what its deviations are multiplied with to be standard deviations along an axis.
    """
    folder.mkdir(parents=True, exist_ok=True)
    folded = network if network.shape.folded else fold_batch_norm(network)
    said = {"kind": KIND, "stddev_factor": round(factor, 4), "network": asdict(folded.shape)}
    coarse, fine = make_examples(folded.shape)
    points = {name: {0: "batch", 1: "points"} for name in ("points", "guesses", "context")}
    write_onnx(ExportedCoarse(folded), coarse, COARSE_LAYOUT, folder / COARSE, said, points)
    write_onnx(ExportedFine(folded), fine, FINE_LAYOUT, folder / FINE, said, {})


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


if __name__ == "__main__":
    main()
