"""Networks in bytes: weights and activations of their convolutions, half the time on a processor."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_keypoints.networks.side_network import COARSE, COARSE_LAYOUT, FINE, SideNetwork
from lab.training.commands import import_onnx
from lab.training.pictures import FingerPictures

PICTURES = 48  # by which the ranges of the activations are measured


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
    network = _RecordingNetwork(folder)
    for row in np.random.default_rng(0).permutation(len(pictures))[:PICTURES]:
        rest = pictures.rest[row, : pictures.keypoints[row]]
        network.locate(pictures.middle[[row]], [network.prepare(pictures.template[pictures.finger[row]], rest)])
    return network.inputs


class _RecordingNetwork(SideNetwork):
    """A network that keeps what goes into its parts."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, threads=1)
        self.inputs: tuple[list[dict[str, NDArray]], list[dict[str, NDArray]]] = ([], [])

    def _run(self, session, names: tuple[str, ...], inputs: tuple[NDArray, ...]) -> list[NDArray]:
        self.inputs[names != COARSE_LAYOUT[0]].append(dict(zip(names, inputs, strict=True)))
        return super()._run(session, names, inputs)
