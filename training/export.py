"""Writes a trained network as the product runs it: `python -m training.export CHECKPOINT -o FOLDER --dataset DATASET`.

The folder holds `keypoints.onnx` and DeepLabCut's sidecar `pytorch_config.yaml`; knows no training.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import log
from pathlib import Path
from typing import Any

import yaml

from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.geometry.side_picture import PlaneGrid, find_side
from finforce_keypoints.networks.metadata import METADATA_FILE
from training.arguments import one_line_errors
from training.checkpoint import build_averaged, load_checkpoint
from training.dataset import VALIDATION, load_pictures
from training.errors import CheckpointError
from training.evaluate import detect_with_model
from training.network import LOCREF_STD, STRIDE, ExportedNetwork, KeypointNetwork, NetworkShape
from training.optional import import_onnx, import_torch
from training.scoring import THRESHOLD, fit_stddev, score_detections

torch = import_torch()

NETWORK_FILE = "keypoints.onnx"
OPSET = 17
UNMEASURED = ((0.05, 20.0), (0.6, 3.0), (0.95, 1.5))  # until the export has measured its own


def main(arguments: Sequence[str] | None = None) -> None:
    """Export a checkpoint, calibrate its standard deviations on the validation shards, and print its score."""
    parser = argparse.ArgumentParser(prog="python -m training.export", description=__doc__)
    parser.add_argument("checkpoint", type=Path, help="of a run")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the exported network")
    parser.add_argument("--dataset", type=Path, required=True, help="folder with the shards val_*.npz")
    parser.add_argument("--pooled", action="store_true", help="let the product average the places around each peak")
    parser.add_argument(
        "--operating-point",
        type=float,
        default=THRESHOLD,
        metavar="LIKELIHOOD",
        help=f"of the trained network that becomes {THRESHOLD}, the detector's threshold (no change)",
    )
    parser.add_argument("--jaw", default="bench", help="jaw whose side plane the pictures show")
    options = parser.parse_args(arguments)
    with one_line_errors():
        checkpoint = load_checkpoint(options.checkpoint)
        network = move_operating_point(build_averaged(checkpoint), options.operating_point)
        card = Sidecar(
            names=checkpoint.names,
            shape=network.shape,
            side_y=find_side(load_jaw(options.jaw)),
            pooled=options.pooled,
        )
        write_network(network, options.output, card)
        detections = detect_with_model(options.output, load_pictures(options.dataset, VALIDATION))
        measured = fit_stddev(detections)
        write_sidecar(options.output, replace(card, likelihood_stddev=measured or UNMEASURED))
    if not measured:
        print("too few validation pictures to measure standard deviations; those of a network never measured stay")
    print(score_detections(detections))
    print(f"{options.output / NETWORK_FILE}: {(options.output / NETWORK_FILE).stat().st_size / 1e6:.2f} MB")


@dataclass(frozen=True, kw_only=True)
class Sidecar:
    """What is written beside a network.

    Attributes:
        names: (K,) of the points.
        shape: of the network.
        side_y: of the plane that its pictures show, left jaw [m].
        pooled: whether the product averages the places around each peak; DeepLabCut takes the peak's own.
        likelihood_stddev: rows of likelihood and standard deviation [px].
    """

    names: Sequence[str]
    shape: NetworkShape
    side_y: float
    pooled: bool = False
    likelihood_stddev: Sequence[Sequence[float]] = UNMEASURED


def move_operating_point(network: KeypointNetwork, likelihood: float) -> KeypointNetwork:
    """Return the network with all likelihoods moved so that a given one becomes the detector's threshold.

    A shift of the heat maps' bias, logit p' = logit p + logit(threshold) - logit(likelihood): no peak moves.

    Raises:
        CheckpointError: the likelihood is not between 0 and 1.
    """
    if not 0.0 < likelihood < 1.0:
        raise CheckpointError(f"operating point {likelihood:g}: expected a likelihood between 0 and 1")
    with torch.no_grad():
        network.heatmap.bias += log(THRESHOLD / (1.0 - THRESHOLD)) - log(likelihood / (1.0 - likelihood))
    return network


def write_network(network: KeypointNetwork, folder: Path, sidecar: Sidecar) -> None:
    """Write network and sidecar.

    The ONNX file has the input `input` (B, 3, h, w) and the outputs `heatmap` and `locref`, float32, with any B.
    """
    import_onnx()
    folder.mkdir(parents=True, exist_ok=True)
    shape = network.shape
    names = ("input", "heatmap", "locref")
    exported = ExportedNetwork(network.to("cpu")).eval()
    torch.onnx.export(
        exported,
        (torch.zeros(2, 3, shape.height, shape.width),),
        str(folder / NETWORK_FILE),
        input_names=list(names[:1]),
        output_names=list(names[1:]),
        dynamic_axes={name: {0: "batch"} for name in names},
        opset_version=OPSET,
        dynamo=False,
    )
    write_sidecar(folder, sidecar)


def write_sidecar(folder: Path, sidecar: Sidecar) -> None:
    """Write the metadata beside a network."""
    (folder / METADATA_FILE).write_text(yaml.safe_dump(build_content(sidecar), sort_keys=False), encoding="utf-8")


def build_content(sidecar: Sidecar) -> dict[str, Any]:
    """Return the tables of a `pytorch_config.yaml`.

    Raises:
        CheckpointError: the network's size is not that of the jaws' pictures.
    """
    grid, shape, count = PlaneGrid(), sidecar.shape, len(sidecar.names)
    if (grid.width, grid.height) != (shape.width, shape.height):
        raise CheckpointError(
            f"a network for {shape.width}x{shape.height} pictures; expected {grid.width}x{grid.height}, the jaw's"
        )
    predictor = {
        "type": "HeatmapPredictor",
        "apply_sigmoid": False,
        "clip_scores": True,
        "location_refinement": True,
        "locref_std": LOCREF_STD,
    }
    head = {"type": "HeatmapHead", "predictor": predictor}
    for name, channels in (("heatmap_config", count), ("locref_config", 2 * count)):
        head[name] = {"channels": [shape.channels[1], channels], "kernel_size": [1], "strides": [1]}
    own = {
        "plane": asdict(grid) | {"side_y": sidecar.side_y},
        "pooled": sidecar.pooled,
        "likelihood_stddev": [[float(value) for value in row] for row in sidecar.likelihood_stddev],
        "network": {name: getattr(shape, name) for name in ("points", "height", "width")}
        | {name: list(getattr(shape, name)) for name in ("channels", "blocks")},
    }
    return {
        "data": {"colormode": "RGB", "inference": {"normalize_images": True}},
        "metadata": {"bodyparts": list(sidecar.names), "unique_bodyparts": [], "individuals": ["jaw"]},
        "method": "bu",
        "net_type": "finforce",
        "model": {"backbone": {"type": "finforce", "output_stride": STRIDE}, "heads": {"bodypart": head}},
        "finforce": own,
    }


if __name__ == "__main__":
    main()
