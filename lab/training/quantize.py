"""Networks in bytes: weights and activations of their convolutions, half the time on a processor.

`python -m lab.training.quantize FOLDER RECORDING... --jaw FILE -o FOLDER` does it to a DeepLabCut network: every
twelfth picture that the detector shows it in the recordings measures its activations; those half-way between judge it.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shutil import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_eval.evaluation.keypoint_source import KeypointSource
from finforce_eval.recordings.recording import read_recording
from finforce_keypoints.networks.metadata import METADATA_FILE
from finforce_keypoints.networks.model import KeypointModel
from finforce_keypoints.networks.side_network import COARSE, COARSE_LAYOUT, FINE, SideNetwork
from lab.training.commands import TrainingError, import_onnx, one_line_errors
from lab.training.pictures import FingerPictures

PICTURES = 48  # by which the ranges of the activations are measured
EVERY = 12  # batches, of which one counts
LIKELY = 0.5  # likelihood of the points that are compared


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the network and print by how much its points have moved."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.quantize", description=__doc__)
    parser.add_argument("network", type=Path, help="folder of the network, with pytorch_config.yaml")
    parser.add_argument("recordings", nargs="+", help="recordings with images")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the network in bytes")
    parser.add_argument("--jaw", default="bench", help="jaw file, or name of an included jaw")
    parser.add_argument("--method", choices=("network", "frame"), default="network", help="what shows it pictures")
    options = parser.parse_args(arguments)
    with one_line_errors():
        run(options)


def run(options: argparse.Namespace) -> None:
    """Quantize as the options say.

    Raises:
        TrainingError: the recordings showed the network too little.
    """
    before = KeypointModel(options.network)
    parameters = {"model": str(options.network), "detection_method": options.method}
    with watch_batches() as batches:
        for path in options.recordings:
            recording = read_recording(path)
            KeypointSource(source="images", jaw_file=options.jaw, parameters=parameters).apply(recording)
    shown, judged = batches[::EVERY], batches[EVERY // 2 :: EVERY]
    if len(judged) < 2:
        raise TrainingError(f"{len(batches)} pictures were shown to the network, expected some {4 * EVERY} or more")
    name = import_onnx().load(str(before.path)).graph.input[0].name
    inputs = [{name: before.preprocess(batch[[row]]).copy()} for batch in shown for row in range(len(batch))]
    options.output.mkdir(parents=True, exist_ok=True)
    quantize_file(before.path, options.output / before.path.name, inputs)
    copy(before.path.parent / METADATA_FILE, options.output / METADATA_FILE)
    moved = measure_motion(before, KeypointModel(options.output), judged)
    print(f"{len(moved)} points moved by {np.median(moved):.3f} px (median), {np.percentile(moved, 95):.3f} px (95 %)")


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


def measure_motion(before: KeypointModel, after: KeypointModel, batches: Sequence[NDArray]) -> NDArray:
    """Return by how much the likely points of some batches move from one network to the other (n,) [px]."""
    moved = []
    for batch in batches:
        old, new = before.locate(batch), after.locate(batch)
        likely = (old.likelihood >= LIKELY) & (new.likelihood >= LIKELY)
        moved.append(np.linalg.norm(new.pixels - old.pixels, axis=-1)[likely])
    return np.concatenate(moved)


def quantize_network(folder: Path, pictures: FingerPictures) -> None:
    """Rewrite both files of an exported network with bytes where there were floats.

    Args:
        folder: of the network.
        pictures: to measure the ranges of activations with.
    """
    for name, inputs in zip((COARSE, FINE), _record_inputs(folder, pictures), strict=True):
        quantize_file(folder / name, folder / name, inputs)


def quantize_file(source: Path, target: Path, inputs: Sequence[dict[str, NDArray]]) -> None:
    """Write a network with bytes where another one has floats, but for its first and last convolutions.

    Nothing evens out the errors of those.

    Args:
        source: the network's file.
        target: that is written; may be the same.
        inputs: by which the ranges of the activations are measured, by the names of the network's inputs.
    """
    from onnxruntime.quantization import QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    onnx = import_onnx()
    said, left = list(onnx.load(str(source)).metadata_props), iter(inputs)
    with tempfile.TemporaryDirectory() as scratch:
        plain = str(Path(scratch) / source.name)
        quant_pre_process(str(source), plain, skip_symbolic_shape=True)
        quantize_static(
            plain,
            str(target),
            SimpleNamespace(get_next=lambda: next(left, None)),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            per_channel=True,
            reduce_range=True,  # of weights to 7 bits: sums of 8 saturate on processors without VNNI
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_exclude=find_ends(Path(plain)),
        )
    content = onnx.load(str(target))
    del content.metadata_props[:]
    content.metadata_props.extend(said)
    content.producer_name, content.producer_version, content.doc_string = "finforce", "", ""
    join_activations(content)
    onnx.save(content, str(target))


def join_activations(content: Any) -> None:
    """Leave out the rounding of what a convolution makes before its ReLU, so that onnxruntime computes both in one.

    Args:
        content: of a network in bytes, as `onnx.load` gives it.
    """
    nodes = content.graph.node
    maker = {name: node for node in nodes for name in node.output}
    readers = Counter(name for node in nodes for name in node.input)

    def before(node: Any, kind: str) -> Any:
        made = maker.get(node.input[0]) if node is not None else None
        return made if made is not None and made.op_type == kind and readers[made.output[0]] == 1 else None

    for relu in [node for node in nodes if node.op_type == "Relu"]:
        restored = before(relu, "DequantizeLinear")
        rounded = before(restored, "QuantizeLinear")
        if before(rounded, "Conv") is not None:
            relu.input[0] = rounded.input[0]
            nodes.remove(restored)
            nodes.remove(rounded)


def find_ends(path: Path) -> list[str]:
    """Return the names of a network's first and last convolutions: those with none before, or none after them."""
    graph = import_onnx().load(str(path)).graph
    nodes = list(graph.node)
    maker = {name: number for number, node in enumerate(nodes) for name in node.output}
    follows = {number: {maker[name] for name in node.input if name in maker} for number, node in enumerate(nodes)}
    convolutions = {number for number, node in enumerate(nodes) if node.op_type == "Conv"}
    below: dict[int, set[int]] = {}  # convolutions on the way to each node; nodes are sorted as they are computed
    for number in range(len(nodes)):
        before = follows[number]
        below[number] = set().union(*(below[other] for other in before), before & convolutions)
    inner = set().union(*(below[number] for number in convolutions)) if convolutions else set()
    return [nodes[number].name for number in sorted(convolutions) if not below[number] or number not in inner]


def _record_inputs(folder: Path, pictures: FingerPictures) -> tuple[list[dict[str, NDArray]], list[dict[str, NDArray]]]:
    """Return what goes into the coarse and the fine part for some of the pictures."""
    network = _RecordingNetwork(folder, threads=1)
    for row in np.random.default_rng(0).permutation(len(pictures))[:PICTURES]:
        rest = pictures.rest[row, : pictures.keypoints[row]]
        network.locate(pictures.middle[[row]], [network.prepare(pictures.template[pictures.finger[row]], rest)])
    return network.inputs


class _RecordingNetwork(SideNetwork):
    """A network that keeps what goes into its parts."""

    def __init__(self, path: Path, threads: int) -> None:
        super().__init__(path, threads)
        self.inputs: tuple[list[dict[str, NDArray]], list[dict[str, NDArray]]] = ([], [])

    def _run(self, session, names: tuple[str, ...], inputs: tuple[NDArray, ...]) -> list[NDArray]:
        self.inputs[names != COARSE_LAYOUT[0]].append(dict(zip(names, inputs, strict=True)))
        return super()._run(session, names, inputs)


if __name__ == "__main__":
    main()
