"""Shift an exported network's likelihoods so that the threshold loses a wanted share of the points that can be seen.

`python -m lab.training.calibrate FOLDER DATASET --lost 0.05 -o FOLDER`
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from finforce_keypoints.networks.side_network import COARSE, FINE, SideNetwork
from lab.training.commands import CheckpointError, import_onnx, one_line_errors, read_share
from lab.training.evaluate import detect, fit_shift, format_scores, score_detections
from lab.training.pictures import VALIDATION, load_pictures

BIAS = "part.judge.2.bias"  # of logit and log deviation, in the fine part's file


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a network whose likelihoods are shifted, and print its scores on the pictures before and after."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.calibrate", description=__doc__)
    parser.add_argument("network", type=Path, help="folder of an exported network")
    parser.add_argument("dataset", type=Path, help="folder of shards val_*.npz")
    parser.add_argument("--lost", type=read_share, required=True, help="share of the visible points to be lost")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the new network")
    options = parser.parse_args(arguments)
    with one_line_errors():
        pictures = load_pictures(options.dataset, VALIDATION)
        before = detect(SideNetwork(options.network, threads=1), pictures)
        shift_likelihoods(options.network, options.output, fit_shift(before, options.lost))
        after = detect(SideNetwork(options.output, threads=1), pictures)
    print(format_scores({"before": score_detections(before), "after": score_detections(after)}))


def shift_likelihoods(source: Path, target: Path, shift: float) -> None:
    """Write an exported network whose logits of visibility are larger by `shift`; nothing else of it changes.

    Raises:
        CheckpointError: its fine part is not one that training exports.
    """
    onnx = import_onnx()
    model = onnx.load(str(source / FINE))
    found = [item for item in model.graph.initializer if item.name == BIAS]
    if len(found) != 1:
        raise CheckpointError(f"{source / FINE}: no {BIAS}; expected a network exported by training")
    bias = onnx.numpy_helper.to_array(found[0]) + np.array([shift, 0.0], dtype=np.float32)
    found[0].CopyFrom(onnx.numpy_helper.from_array(bias, BIAS))
    target.mkdir(parents=True, exist_ok=True)
    if source.resolve() != target.resolve():
        shutil.copyfile(source / COARSE, target / COARSE)
    onnx.save(model, str(target / FINE))


if __name__ == "__main__":
    main()
