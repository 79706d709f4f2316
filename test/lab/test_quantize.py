"""Claims about networks of key points in bytes: which convolutions stay as they are, and what is refused."""

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")

from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from lab.training.quantize import find_ends, quantize_file  # noqa: E402


def write_chain(path):
    """A network of four convolutions: one that sees the picture, two in a row behind it, and two ends."""
    convolutions = [
        ("first", "picture", "a"),
        ("middle", "b", "c"),
        ("left", "c", "left_out"),
        ("right", "c", "right_out"),
    ]
    nodes = [
        helper.make_node("Conv", [given, f"{name}_weights"], [made], name=name, pads=[1, 1, 1, 1])
        for name, given, made in convolutions
    ]
    nodes.insert(1, helper.make_node("Relu", ["a"], ["b"]))
    nodes.append(helper.make_node("Sigmoid", ["left_out"], ["left_told"]))
    random = np.random.default_rng(0)
    shapes = {"first": (8, 3, 3, 3), "middle": (8, 8, 3, 3), "left": (2, 8, 3, 3), "right": (4, 8, 3, 3)}
    weights = [
        numpy_helper.from_array(random.normal(0.0, 0.1, shape).astype(np.float32), f"{name}_weights")
        for name, shape in shapes.items()
    ]
    given = [helper.make_tensor_value_info("picture", TensorProto.FLOAT, ["batch", 3, 16, 16])]
    told = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", count, 16, 16])
        for name, count in (("left_told", 2), ("right_out", 4))
    ]
    graph = helper.make_graph(nodes, "chain", given, told, weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))


def test_first_and_last_convolutions_stay_as_they_are(tmp_path):
    write_chain(tmp_path / "chain.onnx")
    assert find_ends(tmp_path / "chain.onnx") == ["first", "left", "right"]
    pictures = np.random.default_rng(1).normal(size=(8, 1, 3, 16, 16)).astype(np.float32)
    quantize_file(tmp_path / "chain.onnx", tmp_path / "bytes.onnx", [{"picture": one} for one in pictures])
    kinds = {item.name: item.data_type for item in onnx.load(str(tmp_path / "bytes.onnx")).graph.initializer}
    assert kinds["middle_weights_quantized"] == TensorProto.INT8
    assert all(kinds[f"{name}_weights"] == TensorProto.FLOAT for name in ("first", "left", "right"))
