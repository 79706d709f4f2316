"""A trained network as the files that the product uses: `python -m training.finger_export CHECKPOINT -o FOLDER`."""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path

import numpy as np

from finforce_keypoints.networks.side_network import COARSE, COARSE_LAYOUT, FINE, FINE_LAYOUT, KIND, METADATA
from training.arguments import one_line_errors
from training.finger_dataset import VALIDATION, load_pictures
from training.finger_network import (
    PIECE,
    ExportedCoarse,
    ExportedFine,
    FingerNetwork,
    NetworkShape,
    fold_batch_norm,
)
from training.finger_trainer import detect
from training.optional import import_onnx, import_torch
from training.scoring import THRESHOLD

torch = import_torch()
OPSET = 17


def load_network(checkpoint: Path) -> FingerNetwork:
    """Return the averaged network of a checkpoint, ready to be asked."""
    content = torch.load(checkpoint, map_location="cpu", weights_only=True)
    shape = {name: tuple(value) if isinstance(value, list) else value for name, value in content["shape"].items()}
    network = FingerNetwork(NetworkShape(**shape))
    network.load_state_dict(content["averaged"])
    return network.eval()


def calibrate(network: FingerNetwork, data: Path) -> float:
    """Return what the network's deviations are to be multiplied with to be standard deviations along an axis.

    Two thirds of the visible points' distances lie within 1.52 standard deviations of a normal one in two dimensions;
    errors have longer tails, of which the largest tenth counts: 2.15 deviations.
    """
    detections, spread = detect(network, load_pictures(data, VALIDATION))
    good = detections.visible & (detections.likelihood >= THRESHOLD)
    ratio = detections.errors[good] / spread[good]
    return float(max(np.quantile(ratio, 0.683) / 1.52, np.quantile(ratio, 0.9) / 2.15))


def export(network: FingerNetwork, folder: Path, factor: float) -> None:
    """Write both parts to a folder."""
    onnx = import_onnx()
    folder.mkdir(parents=True, exist_ok=True)
    network = fold_batch_norm(network)
    shape, batch, count = network.shape, 2, 5
    pieces = torch.zeros(batch * count, PIECE, PIECE, 3, dtype=torch.uint8)
    colours = torch.ones(batch * count, 3)
    coarse = (
        torch.zeros(batch, shape.height, shape.width, 3, dtype=torch.uint8),
        torch.zeros(batch, shape.height // 2, shape.width // 2, 3, dtype=torch.uint8),
        torch.zeros(batch, count, 2),
    )
    fine = (pieces, pieces, torch.zeros(batch * count, shape.coarse[1]), colours, colours)
    jobs = ((COARSE, ExportedCoarse, coarse, COARSE_LAYOUT), (FINE, ExportedFine, fine, FINE_LAYOUT))
    for name, kind, inputs, layout in jobs:
        path = folder / name
        axes = {entry: {0: "batch"} for names in layout for entry in names}
        if name == COARSE:
            axes |= {entry: {0: "batch", 1: "points"} for entry in ("points", "guesses", "context")}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.onnx.export(
                kind(network).eval(),
                inputs,
                str(path),
                input_names=list(layout[0]),
                output_names=list(layout[1]),
                dynamic_axes=axes,
                opset_version=OPSET,
                dynamo=False,
            )
        content = onnx.load(path)
        entry = content.metadata_props.add()
        entry.key, entry.value = METADATA, json.dumps({"kind": KIND, "stddev_factor": round(factor, 3)})
        content.producer_name, content.producer_version, content.doc_string = "finforce", "", ""
        onnx.save(content, path)


def main() -> None:
    """Export a network."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True, help="data set whose validation part calibrates deviations")
    options = parser.parse_args()
    with one_line_errors():
        network = load_network(options.checkpoint)
        factor = calibrate(network, options.data)
        export(network, options.output, factor)
        print(f"{options.output}: stddev_factor {factor:.3f}")


if __name__ == "__main__":
    main()
