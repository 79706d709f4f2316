"""An ONNX file looked at before it is loaded: what it consists of, that it ends, and that it stays in its folder.

Read is the file's structure alone, field by field as protobuf lays them down (onnx.proto of ONNX 1.x); nothing of it is
carried out, and no array of it is built.
"""

from __future__ import annotations

import mmap
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from finforce.files import raise_budget
from finforce_keypoints.errors import ModelError

LARGEST = 512 << 20  # bytes of a file
MOST_NODES, MOST_TENSORS, MOST_DIMENSIONS = 20_000, 20_000, 8
DEEPEST = 3  # graphs within graphs, as an If has them
# Operators of image networks and of what exporters put around them, in the domains "" and "ai.onnx"; none repeats.
OPERATORS = frozenset(
    """Abs Acos Add And ArgMax ArgMin Asin Atan AveragePool BatchNormalization Bernoulli BitShift Cast CastLike
    Ceil Celu CenterCropPad Clip Compress Concat Constant ConstantOfShape Conv ConvInteger ConvTranspose Cos
    CumSum DepthToSpace DequantizeLinear Div Dropout DynamicQuantizeLinear Einsum Elu Equal Erf Exp Expand
    EyeLike Flatten Floor Gather GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalLpPool GlobalMaxPool
    Greater GreaterOrEqual GridSample GroupNormalization HardSigmoid HardSwish Hardmax Identity If
    InstanceNormalization IsInf IsNaN LRN LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax
    LpNormalization LpPool MatMul MatMulInteger Max MaxPool Mean MeanVarianceNormalization Min Mish Mod Mul Neg
    NonMaxSuppression NonZero Not OneHot Or PRelu Pad Pow QLinearConv QLinearMatMul QuantizeLinear Range
    Reciprocal ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd
    ReduceSum ReduceSumSquare Relu Reshape Resize Round ScatterElements ScatterND Selu Shape Sigmoid Sign Sin
    Size Slice Softmax Softplus Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum Tan Tanh ThresholdedRelu Tile
    TopK Transpose Unsqueeze Upsample Where Xor""".split()  # noqa: SIM905 - words as a text read more easily
)
# What onnxruntime's optimiser makes of them.
FUSED = frozenset(
    """BiasGelu DynamicQuantizeMatMul FastGelu FusedConv FusedGemm FusedMatMul Gelu LayerNormalization
    MatMulIntegerToFloat NhwcMaxPool QAttention QGemm QLinearAdd QLinearAveragePool QLinearConcat
    QLinearGlobalAveragePool QLinearLeakyRelu QLinearMul QLinearSigmoid QuickGelu SkipLayerNormalization""".split()  # noqa: SIM905 - words as a text read more easily
)
DOMAINS = {"": OPERATORS, "ai.onnx": OPERATORS, "com.microsoft": FUSED | {"DequantizeLinear", "QuantizeLinear"}}

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # wire types
# Numbers of fields: of ModelProto, GraphProto, NodeProto, AttributeProto, TensorProto, StringStringEntryProto.
_MODEL_GRAPH, _MODEL_FUNCTIONS = 7, 25
_GRAPH_NODE, _GRAPH_INITIALIZER, _GRAPH_SPARSE = 1, 5, 15
_NODE_OPERATOR, _NODE_ATTRIBUTE, _NODE_DOMAIN = 4, 5, 7
_ATTRIBUTE_TENSOR, _ATTRIBUTE_GRAPH, _ATTRIBUTE_TENSORS, _ATTRIBUTE_GRAPHS = 5, 6, 10, 11
_TENSOR_DIMS, _TENSOR_EXTERNAL, _TENSOR_PLACE = 1, 13, 14
_ENTRY_KEY, _ENTRY_VALUE = 1, 2


def check_network(path: Path) -> None:
    """Refuse a network file that cannot be one, or does not end.

    Raises:
        ModelError: it is no plain file, too large or no ONNX; an operator is not known, repeats or calls others; there
            are more nodes, tensors or levels than a network has; a tensor is larger than memory, or its data lie
            outside the file's folder.
    """
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        try:
            state = os.fstat(handle)
            if not stat.S_ISREG(state.st_mode):
                raise ModelError(f"{path}: no plain file; expected an ONNX network")
            if not 0 < state.st_size <= raise_budget(LARGEST):
                raise ModelError(f"{path}: {state.st_size} bytes; expected 1 to {raise_budget(LARGEST)} of a network")
            with mmap.mmap(handle, 0, access=mmap.ACCESS_READ) as content:
                _Checker(path, content).check_model()
        finally:
            os.close(handle)
    except (OSError, ValueError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(f"{path}: {error}; expected an ONNX network") from error


class _Checker:
    """Goes through one file.

    Args:
        path: of the file.
        content: of it.
    """

    def __init__(self, path: Path, content: mmap.mmap) -> None:
        self._path, self._content = path, content
        self._nodes = self._tensors = 0

    def check_model(self) -> None:
        """Check the whole file."""
        graphs = 0
        for field, begin, end in self._fields(0, len(self._content)):
            if field == _MODEL_GRAPH:
                graphs += 1
                self._check_graph(begin, end, 0)
            elif field == _MODEL_FUNCTIONS:
                raise self._refuse("functions of its own, which may call each other", "operators alone")
        if graphs != 1 or not self._nodes:
            raise self._refuse(f"{graphs} graphs with {self._nodes} nodes", "an ONNX network")

    def _check_graph(self, begin: int, end: int, depth: int) -> None:
        if depth > DEEPEST:
            raise self._refuse(f"graphs within graphs, {depth} deep", f"{DEEPEST} at most")
        for field, first, last in self._fields(begin, end):
            if field == _GRAPH_NODE:
                self._check_node(first, last, depth)
            elif field == _GRAPH_INITIALIZER:
                self._check_tensor(first, last)
            elif field == _GRAPH_SPARSE:
                raise self._refuse("sparse tensors", "dense ones")

    def _check_node(self, begin: int, end: int, depth: int) -> None:
        self._nodes += 1
        if self._nodes > raise_budget(MOST_NODES):
            raise self._refuse(f"more than {raise_budget(MOST_NODES)} nodes", "fewer of a network")
        operator = domain = ""
        for field, first, last in self._fields(begin, end):
            if field == _NODE_OPERATOR:
                operator = self._text(first, last)
            elif field == _NODE_DOMAIN:
                domain = self._text(first, last)
            elif field == _NODE_ATTRIBUTE:
                self._check_attribute(first, last, depth)
        if operator not in DOMAINS.get(domain, ()):
            known = f"{domain}.{operator}" if domain else operator
            raise self._refuse(f"the operator {known[:80]!r}", "operators of image networks, none of which repeats")

    def _check_attribute(self, begin: int, end: int, depth: int) -> None:
        for field, first, last in self._fields(begin, end):
            if field in (_ATTRIBUTE_GRAPH, _ATTRIBUTE_GRAPHS):
                self._check_graph(first, last, depth + 1)
            elif field in (_ATTRIBUTE_TENSOR, _ATTRIBUTE_TENSORS):
                self._check_tensor(first, last)

    def _check_tensor(self, begin: int, end: int) -> None:
        self._tensors += 1
        if self._tensors > raise_budget(MOST_TENSORS):
            raise self._refuse(f"more than {raise_budget(MOST_TENSORS)} tensors", "fewer of a network")
        count, dimensions, is_external, where = 1, 0, False, ""
        for field, first, last in self._fields(begin, end):
            if field == _TENSOR_DIMS:
                for size in self._varints(first, last):
                    dimensions += 1
                    count *= size
            elif field == _TENSOR_PLACE:
                is_external = next(self._varints(first, last), 0) == 1
            elif field == _TENSOR_EXTERNAL:
                where = self._read_entry(first, last).get("location", where)
        if dimensions > MOST_DIMENSIONS or count > raise_budget(LARGEST):
            raise self._refuse(f"a tensor of {dimensions} dimensions and {count} values", "one that fits into the file")
        if is_external or where:
            self._check_place(where)

    def _check_place(self, where: str) -> None:
        """Refuse data beside the network that are anywhere but in its folder."""
        folder = self._path.resolve().parent
        place = folder / where
        if not where or Path(where).is_absolute() or place.resolve().parent != folder or place.is_symlink():
            raise self._refuse(f"data in {where[:80]!r}", "data in its own folder")
        if not place.is_file():
            raise self._refuse(f"data in {where[:80]!r}, where no file is", "a file in its own folder")

    def _read_entry(self, begin: int, end: int) -> dict[str, str]:
        words = {field: self._text(first, last) for field, first, last in self._fields(begin, end)}
        return {words.get(_ENTRY_KEY, ""): words.get(_ENTRY_VALUE, "")}

    def _fields(self, begin: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Yield the number of each field of a message, and where its content begins and ends."""
        while begin < end:
            tag, begin = self._varint(begin, end)
            kind, first = tag & 7, begin
            if kind == _VARINT:
                _, begin = self._varint(begin, end)
            elif kind == _EIGHT:
                begin += 8
            elif kind == _FOUR:
                begin += 4
            elif kind == _BYTES:
                length, first = self._varint(begin, end)
                begin = first + length
            else:
                raise self._refuse(f"a field of kind {kind} at byte {first}", "an ONNX network")
            if begin > end:
                raise self._refuse(f"a field at byte {first} that ends beyond what holds it", "an ONNX network")
            yield tag >> 3, first, begin

    def _varints(self, begin: int, end: int) -> Iterator[int]:
        """Yield the numbers of a field, packed or alone."""
        while begin < end:
            value, begin = self._varint(begin, end)
            yield value

    def _varint(self, begin: int, end: int) -> tuple[int, int]:
        value = shift = 0
        while begin < end and shift < 64:
            byte = self._content[begin]
            value |= (byte & 0x7F) << shift
            begin, shift = begin + 1, shift + 7
            if byte < 0x80:
                return value, begin
        raise self._refuse(f"a number at byte {begin} that does not end", "an ONNX network")

    def _text(self, begin: int, end: int) -> str:
        return self._content[begin : min(end, begin + 4096)].decode(errors="replace")

    def _refuse(self, got: str, expected: str) -> ModelError:
        return ModelError(f"{self._path}: has {got}; expected {expected}")
