"""Writes a DeepLabCut network in bytes: half the time on a processor, judged on recordings with images.

`python -m lab.training.quantize FOLDER RECORDING... --jaw FILE -o FOLDER`

Every twelfth picture that the detector shows the network in the recordings measures its activations; those half-way
between judge what became of it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shutil import copy
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from finforce_eval.evaluation.keypoint_source import KeypointSource
from finforce_eval.recordings.recording import read_recording
from finforce_keypoints.networks.metadata import METADATA_FILE
from finforce_keypoints.networks.model import KeypointModel
from lab.training.arguments import one_line_errors
from lab.training.errors import DatasetError
from lab.training.optional import import_onnx
from lab.training.quantization import find_ends, quantize_file

EVERY = 12  # batches, of which one counts
LIKELY = 0.5  # likelihood of the points that are compared
ROUNDS = 40  # of each network, in turn, to compare their times


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the network and print by how much its points have moved, and what time it takes."""
    options = build_parser().parse_args(arguments)
    with one_line_errors():
        run(options)


def build_parser() -> argparse.ArgumentParser:
    """Return the options of the command."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.quantize", description=__doc__)
    parser.add_argument("network", type=Path, help="folder of the network, with pytorch_config.yaml")
    parser.add_argument("recordings", nargs="+", help="recordings with images")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the network in bytes")
    parser.add_argument("--jaw", default="bench", help="jaw file, or the name of a shipped jaw")
    parser.add_argument("--finder", choices=("network", "frame"), default="network", help="what shows it pictures")
    return parser


def run(options: argparse.Namespace) -> None:
    """Quantize as the options say.

    Raises:
        DatasetError: the recordings showed the network too little.
    """
    before = KeypointModel(options.network)
    parameters = {"model": str(options.network), "finder": options.finder}
    with watch_batches() as batches:
        for path in options.recordings:
            recording = read_recording(path)
            KeypointSource(source="images", jaw_file=options.jaw, parameters=parameters).apply(recording)
    shown, judged = batches[::EVERY], batches[EVERY // 2 :: EVERY]
    if len(judged) < 2:
        raise DatasetError(f"{len(batches)} pictures were shown to the network, expected some {4 * EVERY} or more")
    name = import_onnx().load(str(before.path)).graph.input[0].name
    inputs = [{name: before.preprocess(batch[[row]]).copy()} for batch in shown for row in range(len(batch))]
    options.output.mkdir(parents=True, exist_ok=True)
    quantize_file(before.path, options.output / before.path.name, inputs, find_ends(before.path))
    copy(before.path.parent / METADATA_FILE, options.output / METADATA_FILE)
    print(compare(before, KeypointModel(options.output), judged))


@contextmanager
def watch_batches() -> Iterator[list[NDArray]]:
    """Give the batches of pictures (B, H, W, 3) uint8 that any network of key points is shown meanwhile."""
    batches: list[NDArray] = []
    locate = KeypointModel.locate

    def watched(model: KeypointModel, batch: NDArray):
        batches.append(batch.copy())
        return locate(model, batch)

    KeypointModel.locate = watched
    try:
        yield batches
    finally:
        KeypointModel.locate = locate


def compare(before: KeypointModel, after: KeypointModel, batches: Sequence[NDArray]) -> str:
    """Return in words by how much the points of some batches move from one network to the other, and their times."""
    moved = []
    for batch in batches:
        old, new = before.locate(batch), after.locate(batch)
        likely = (old.likelihood >= LIKELY) & (new.likelihood >= LIKELY)
        moved.append(np.linalg.norm(new.pixels - old.pixels, axis=-1)[likely])
    far = np.concatenate(moved)
    times = np.empty((ROUNDS, 2))
    for row in range(ROUNDS):
        for column, model in enumerate((before, after)):
            begin = perf_counter()
            model.run(batches[row % len(batches)])
            times[row, column] = perf_counter() - begin
    old_ms, new_ms = 1e3 * np.median(times, axis=0)
    return (
        f"{len(far)} points moved by {np.median(far):.3f} px (median), {np.percentile(far, 95):.3f} px (95 %)\n"
        f"{old_ms:.2f} ms -> {new_ms:.2f} ms a batch, {old_ms / new_ms:.2f} times as fast"
    )


if __name__ == "__main__":
    main()
