"""Exported networks in bytes: weights and activations of their convolutions, half the time on a processor."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce_keypoints.networks.side_network import COARSE, COARSE_LAYOUT, FINE, SideNetwork
from training.dataset import FingerPictures
from training.optional import import_onnx

PICTURES = 48  # by which the ranges of the activations are measured
# first and last convolutions, whose errors nothing evens out
KEPT = ("stem/stem.0", "votes", "moves")


def quantize_network(folder: Path, pictures: FingerPictures) -> None:
    """Rewrite both files of an exported network with bytes where there were floats.

    Args:
        folder: of the network.
        pictures: to measure the ranges of activations with.
    """
    from onnxruntime.quantization import QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    onnx = import_onnx()
    for name, inputs in zip((COARSE, FINE), _record_inputs(folder, pictures), strict=True):
        path = folder / name
        said = list(onnx.load(str(path)).metadata_props)
        with tempfile.TemporaryDirectory() as scratch:
            plain = str(Path(scratch) / name)
            quant_pre_process(str(path), plain, skip_symbolic_shape=True)
            nodes = [node.name for node in onnx.load(plain).graph.node if node.op_type == "Conv"]
            quantize_static(
                plain,
                str(path),
                _Inputs(inputs),
                quant_format=QuantFormat.QDQ,
                op_types_to_quantize=["Conv"],
                per_channel=True,
                reduce_range=True,  # of weights to 7 bits: sums of 8 saturate on processors without VNNI
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                nodes_to_exclude=[node for node in nodes if any(part in node for part in KEPT)],
            )
        content = onnx.load(str(path))
        del content.metadata_props[:]
        content.metadata_props.extend(said)
        content.producer_name, content.producer_version, content.doc_string = "finforce", "", ""
        onnx.save(content, str(path))


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


class _Inputs:
    """Inputs of one part, one after the other, as onnxruntime's quantization reads them."""

    def __init__(self, inputs: Sequence[dict[str, NDArray]]) -> None:
        self._left = iter(inputs)

    def get_next(self) -> dict[str, NDArray] | None:
        """Return the next ones, None at the end."""
        return next(self._left, None)
